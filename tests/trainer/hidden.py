"""Small virtual benches with hidden defects, and the commands run on them as a user would run them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from trainer.cli import main
from trainer.effects import effect_catalogue

BENCH = """
name = "bench"
[panel]
width = {width}
height = {height}
pitch_um = 8
levels = 256
fill_factor = {fill_factor}
[[channel]]
name = "green"
wavelength_nm = 520
[propagation]
distance_mm = {distance_mm}
[iris]
shape = "{iris[0]}"
half_width = {iris[1]}
[camera]
width = {width}
height = {height}
pixel_um = 8
registered = true
bit_depth = 12
black_level = 64
full_well_e = 10500
read_noise_e = 5
"""


# Where 96 x 80 pixels are too few to tell what is asked.
LARGER = {"width": 160, "height": 128, "distance_mm": 15}


def bench_text(
    width: int = 96,
    height: int = 80,
    distance_mm: float = 9,
    iris: tuple[str, float] = ("square", 1.0),
    fill_factor: float = 1.0,
) -> str:
    """The TOML tables of a bench as its data sheet has it; of the iris, shape and half width."""
    return BENCH.format(
        width=width, height=height, distance_mm=distance_mm, iris=iris, fill_factor=fill_factor
    )


def bench_file(folder: Path, *defects: str, **sizes: Any) -> Path:
    """A virtual bench's TOML file with defects given as TOML lines after [[defect]]; `sizes` go to `bench_text`."""
    path = folder / "bench-with-secrets.toml"
    path.write_text(bench_text(**sizes) + "".join(f"\n[[defect]]\n{d}\n" for d in defects))
    return path


def ran(capsys: pytest.CaptureFixture[str], *argv: object) -> dict[str, Any]:
    """What a command of hololoop-trainer printed with --json."""
    capsys.readouterr()
    code = main([*map(str, argv), "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    return json.loads(out)


def captured(
    capsys: pytest.CaptureFixture[str],
    folder: Path,
    *defects: str,
    options: tuple[object, ...] = (),
    **sizes: Any,
) -> Path:
    """A capture set taken from a bench with these defects; `sizes` go to `bench_text`."""
    where = folder / "captures"
    ran(capsys, "capture", "--bench", bench_file(folder, *defects, **sizes), "--out", where, *options)
    return where


def state(captures: Path, key: str, value: float) -> None:
    """Make bench.toml state another value of a key."""
    path = captures / "bench.toml"
    text, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", path.read_text())
    assert count == 1
    path.write_text(text)


def with_few_effects(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let commands know some of the built-in effects only, for tests of what all of them would only make longer."""
    few = tuple(effect for effect in effect_catalogue.BUILT_IN if effect.name in names)
    monkeypatch.setattr(effect_catalogue, "BUILT_IN", few)


def without_probes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let diagnoses leave out the stages' free-form probes, which take most of their time, for tests of the rest."""
    monkeypatch.setattr("trainer.diagnosis.diagnosis.probe_all", lambda *_: [])
