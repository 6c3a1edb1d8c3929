"""The configuration that the help and the guide show lights the emulated headset that they name."""

from __future__ import annotations

import json
import re
import textwrap
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.virtual import load_bench
from firmware_iface.virtual.remote_hardware import running
from runtime.bundle.bundle_folder import write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.cli import main
from runtime.commands import serve
from runtime.service.client import RefusedError
from runtime.service.protocol import LaserState
from tests.campaigns.headset import connected, picture, served
from tests.runtime.benches import converted, ideal_path

pytestmark = pytest.mark.usefixtures("real_time")

GUIDE = Path(serve.__file__).parents[1] / "service" / "README.md"
BENCH = "virtual:demo"
GREEN_ALONE = """channel = [
    { name = "green", wavelength_nm = 520.0, full_power_uw = 100.0, threshold_ma = 40.0, slope_uw_per_ma = 4.0 },
]
"""


def of_the_help() -> str:
    lines = serve.DESCRIPTION.partition("CONFIG is one TOML file:\n")[2].partition("\nWithout hardware")[0]
    return textwrap.dedent(lines)


def of_the_guide() -> str:
    return re.findall(r"```toml\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)[0]


def write_headset(folder: Path, example: str) -> Path:
    """The example, changed only as the text next to it says; with a bundle of its bench."""
    bus = f'bus = "virtual:{folder}/hardware.sock"'
    for before, after in (
        ('bus = "/dev/i2c-1"', bus),
        ('kind = "board"', f'{bus}\nkind = "board"'),
        ('kind = "oak"', f'{bus}\nkind = "virtual"'),
        ("metrics_port = 9464", "metrics_port = 0"),
        (
            "solve_ms = 12.0",
            "solve_ms = 12.0\nsocket = 'service.sock'\nstale_limit_ms = 800.0  # a busy machine",
        ),
    ):
        assert before in example
        kept = [line for line in example.splitlines() if not re.match(r" *(socket|stale_limit_ms) =", line)]
        example = "\n".join(kept).replace(before, after)
    bench = load_bench(BENCH)
    distance = bench.propagation.distance_mm
    path = converted(ideal_path((bench.panel.height, bench.panel.width), distance * 1e-3), np.float32)
    records, arrays = pack_light_paths([("green", distance, 520.0, path)])
    write_bundle(folder / "bundle", arrays, {"paths": records, "distance_mm": distance}, {})
    file = folder / "headset.toml"
    file.write_text(example)
    return file


def findings(capsys: pytest.CaptureFixture[str], file: Path) -> list[str]:
    main(["devices", str(file), "--json"])
    return [problem for one in json.loads(capsys.readouterr().out)["devices"] for problem in one["problems"]]


@pytest.mark.parametrize("example", [of_the_help, of_the_guide])
def test_it_lights_after_clear_and_arm(
    example: Callable[[], str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"firmware_iface.virtual.served SOCKET --bench {BENCH}" in serve.DESCRIPTION
    assert f"firmware_iface.virtual.served /tmp/headset.sock --bench {BENCH}" in GUIDE.read_text(
        encoding="utf-8"
    )
    file = write_headset(tmp_path, example())
    with running(tmp_path / "hardware.sock", BENCH) as remote:
        assert findings(capsys, file) == []
        with served(file), connected(file) as client:
            end = time.monotonic() + 60
            while remote.light()[-1][1] != pytest.approx(50, rel=0.02):
                assert time.monotonic() < end, client.status()
                if client.status().lasers in (LaserState.OFF, LaserState.FAULT):
                    with suppress(RefusedError):
                        client.clear()
                        client.arm()
                for k in range(5):
                    client.show(picture(client, k))
                    list(client.outcomes())


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        (
            r"channel = \[.*?\n *\]\n",
            GREEN_ALONE,
            "output 1 of the board is red, 638 nm, and [[lasers.channel]] 0 is",
        ),
        ("threshold_ma = 40.0", "threshold_ma = 30.0", "correct threshold_ma (the board's is 40)"),
        ("green = 0.5", "red = 0.5", "write power = { green = 0.5 } in [lasers]"),
        ("green = 0.5", "green = 0.0", "write power = { green = 0.5 } in [lasers]"),
    ],
)
def test_a_laser_that_cannot_light_is_a_problem(
    before: str, after: str, problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example, count = re.subn(before, after, of_the_guide(), count=1, flags=re.DOTALL)
    assert count == 1
    file = write_headset(tmp_path, example)
    with running(tmp_path / "hardware.sock", BENCH) as remote:
        [found] = findings(capsys, file)
        assert problem in found
        assert remote.light()[-1][1] == 0
