"""The configuration: what is read, and the error for everything that cannot be."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from runtime.cli import main
from runtime.service.configuration import read_configuration
from tests.campaigns.headset import write_configuration

GREEN = """[[lasers.channel]]
name = "green"
wavelength_nm = 520.0
full_power_uw = 100.0
threshold_ma = 40.0
slope_uw_per_ma = 4.0
"""


def test_what_is_written_is_read(tmp_path: Path) -> None:
    read = read_configuration(write_configuration(tmp_path, refresh_hz=72.0))
    assert read.timing.refresh_hz == 72 and read.timing.metrics_port == 0
    assert read.bundle == tmp_path / "bundle" and read.socket == tmp_path / "service.sock"
    assert read.users == {0, os.getuid()}
    assert set(read.devices) == {"panel", "lasers", "camera"}


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("schema = 1", "schema = 2", "schema = 1"),
        ('bundle = "bundle"', "", "names no bundle"),
        ("[service]", "[servise]", "did you mean 'service'"),
        ("refresh_hz = 50.0", "refresh_hz = 0", "from 1 to 2000"),
        ("solve_ms = 12.0", 'solve_ms = "12"', "'solve_ms' in [service]"),
        ("[service]", "[service]\nusers = [-1]", "'users' in [service]"),
        ("[service]", "[service]\nrefresh = 60", "did you mean 'refresh_hz'"),
        ("green = 0.5", "green = 1.5", "give a fraction"),
        ("green = 0.5", "gren = 0.5", "did you mean 'green'"),
        ("[panel]", "[panel]\nkind = 'slm'", "'kind' in [panel]"),
        ("[lasers]", "[lasers]\nbuss = 1", "did you mean 'bus'"),
        ('kind = "virtual"', 'kind = "webcam"', "'kind' in [camera]"),
        (
            "power = { green = 0.5 }",
            "power = { hot = 1 }\nchannel = [{ name = 'hot', wavelength_nm = 450.0, full_power_uw = 50.0, "
            "threshold_ma = 30.0, slope_uw_per_ma = 4.0 }]",
            "1.28 of the Class 1 budget",  # 50 of 39 microwatts at 450 nm
        ),
        ("[panel]", "[panel", "is not TOML"),
        ("solve_ms = 12.0", "solve_ms = 500.0", "solve_ms = 500 in [service]"),
        (
            "power = { green = 0.5 }",
            "power = { green = 0.5 }\n" + 2 * GREEN,
            "[[lasers.channel]] 0 and 1 are both name = 'green'",
        ),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], before: str, after: str, message: str
) -> None:
    file = write_configuration(tmp_path)
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after, 1))
    with pytest.raises(InputError) as found:
        read_configuration(file)
    assert message in str(found.value)
    assert main(["serve", str(file)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and message in err


def test_a_missing_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", str(tmp_path / "none.toml")]) == 2
    assert "none.toml is missing" in capsys.readouterr().err
