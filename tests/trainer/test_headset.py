"""Real devices as the trainer's commands see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tomlkit

from firmware_iface.errors import InputError
from firmware_iface.virtual import open_headset
from runtime.headset.open_devices import open_devices
from tests.campaigns.headset import hardware, write_configuration
from tests.trainer.fringed_bench import SHAPE, fringed, known
from tests.trainer.hidden import ran
from trainer.captures.acquire import acquire_captures
from trainer.captures.bench_file import bench_tables
from trainer.captures.capture_set import read_captures
from trainer.captures.open_bench import RealHeadset, nominal_bench, open_bench
from trainer.cli import main

pytestmark = pytest.mark.usefixtures("real_time")


def test_real_lasers_stay_within_the_power_that_is_set(tmp_path: Path) -> None:
    """Asked for full power, they get what the configuration allows; a capture set is taken all the same."""
    virtual = fringed()
    real = RealHeadset(virtual.panel, virtual.lasers, virtual.camera, {"green": 0.25}, 6.0)
    real.lasers.set_power("green", 1.0)
    assert virtual.lasers.power("green") == 0.25
    taken = acquire_captures(real, known(virtual), tmp_path / "captures", patterns=2)
    assert taken.simulated is False
    assert {c.extra["simulated"] for c in read_captures(taken.folder).captures} == {"no"}
    assert taken.captures == 3 and taken.saturated < 0.02
    assert virtual.lasers.power("green") == 0


def test_a_fixed_focus_is_not_asked_to_move() -> None:
    virtual = fringed()
    real = RealHeadset(virtual.panel, virtual.lasers, virtual.camera, {}, 6.0)
    real.move_to_plane(6.0)
    with pytest.raises(InputError, match="run of its own"):
        real.move_to_plane(7.0)
    focused = RealHeadset(virtual.panel, virtual.lasers, virtual.camera, {}, 6.0, virtual.move_to_plane)
    focused.move_to_plane(7.0)
    assert virtual.plane_mm == 7.0


def test_a_real_headset_needs_a_description_of_its_bench(tmp_path: Path) -> None:
    path = tmp_path / "headset.toml"
    path.write_text(
        'bundle = "bundle"\n[panel]\n[camera]\n[lasers]\nbus = "virtual:x"\npower = { green = 0.5 }\n'
    )
    with pytest.raises(InputError, match="--model"), open_bench(str(path)):
        pass
    with open_bench("virtual:mixed", 1) as opened:
        assert opened.bench.panel.shape == (96, 128) == opened.headset.panel.shape
        assert np.prod(SHAPE) < 96 * 128


def test_a_set_is_captured_through_the_drivers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """USB panel and I2C lasers, emulated down to their bytes: what comes out is a set of that bench."""
    configuration = write_configuration(tmp_path)
    described = tmp_path / "known.toml"
    described.write_text(
        tomlkit.dumps(bench_tables(nominal_bench(open_headset(str(tmp_path / "bench.toml")))))
    )
    captures = tmp_path / "captures"
    with hardware(tmp_path) as remote:
        options = ["--known", described, "--out", captures, "--patterns", 4]
        taken = ran(capsys, "capture", "--bench", configuration, *options)
        light = [power for _, power in remote.light()]
    assert taken["captures"] == 5 and taken["simulated"] is True
    assert {c.extra["simulated"] for c in read_captures(captures).captures} == {"yes"}
    assert light[-1] == 0 and max(light) == pytest.approx(
        50, rel=0.02
    )  # the configuration's half of full power
    assert ran(capsys, "compare", captures)["heldout"]["excess"] < 0.01


def test_a_headset_that_is_not_there_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration = write_configuration(tmp_path)
    described = tmp_path / "known.toml"
    described.write_text(
        tomlkit.dumps(bench_tables(nominal_bench(open_headset(str(tmp_path / "bench.toml")))))
    )
    words = ["capture", "--bench", configuration, "--known", described, "--out", tmp_path / "captures"]
    assert main([*map(str, words)]) == 2
    said = capsys.readouterr().err
    assert "there is no emulated hardware" in said and said.count("\n") == 1
    assert not (tmp_path / "captures").exists()


def test_a_data_sheet_is_not_taken_for_a_bench(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The bench.toml of a set, where the configuration of a headset is meant."""
    sheet = tmp_path / "bench.toml"
    sheet.write_text(tomlkit.dumps(bench_tables(nominal_bench(fringed()))))
    for spec in (str(sheet), f"{tmp_path}/./bench.toml"):
        assert main(["capture", "--bench", spec, "--out", str(tmp_path / "captures")]) == 2
        said = capsys.readouterr().err
        assert "is the bench.toml of a capture set" in said and "--known" in said and said.count("\n") == 1
    with pytest.raises(InputError, match="is the bench.toml of a capture set"), open_devices(str(sheet)):
        pass
    sheet.write_text(sheet.read_text() + "\n[simulation]\n")
    assert ran(capsys, "capture", "--bench", sheet, "--out", tmp_path / "captures", "--patterns", 1)[
        "simulated"
    ]
    assert (
        main(["capture", "--bench", "virtual:demo", "--known", str(sheet), "--out", str(tmp_path / "none")])
        == 2
    )
    assert "leave --known out" in capsys.readouterr().err
