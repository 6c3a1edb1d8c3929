"""Effects that differ from colour to colour, hidden in simulated benches of three colours."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file, ran, with_few_effects
from trainer.captures.batches import load
from trainer.captures.capture_set import read_captures
from trainer.effects import catalogue
from trainer.fitting import refit
from trainer.fitting.gauss_newton import fit
from trainer.model.model import Model, instance_with

GREEN = '[[channel]]\nname = "green"\nwavelength_nm = 520\n'
RED, BLUE = (
    GREEN.replace("green", name).replace("520", nm) for name, nm in (("red", "638"), ("blue", "450"))
)


def in_three_colours(
    capsys: pytest.CaptureFixture[str], folder: Path, defect: str, distance_mm: float = 9
) -> Path:
    """A capture set of a bench of three colours with a defect."""
    bench = bench_file(folder, defect, width=128, height=96, distance_mm=distance_mm)
    bench.write_text(bench.read_text().replace(GREEN, RED + GREEN + BLUE))
    ran(capsys, "capture", "--bench", bench, "--out", folder / "captures", "--patterns", 4)
    return folder / "captures"


@pytest.mark.parametrize("phase_deg", [120, -200])
def test_a_coherent_ghost_is_late_by_one_path_for_all_colours(
    phase_deg: float, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one phase for all colours, a tenth of what the ghost makes is left, outside the catalogue."""
    with_few_effects(monkeypatch, "coherent_ghost", "distance")
    ghost = f'kind = "coherent_ghost"\namplitude = 0.2\nphase_deg = {phase_deg}'
    captures = in_three_colours(capsys, tmp_path, ghost)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "coherent_ghost"]
    assert found["steps"][-1]["excess"] < 3e-4
    (effect,) = found["effects"]
    value = {name: p["value"] for name, p in effect["parameters"].items()}
    assert math.hypot(value["real"], value["imaginary"]) == pytest.approx(0.2, abs=0.002)
    assert value["path_difference_nm"] == pytest.approx(phase_deg / 360 * 520, abs=3)


def test_a_fit_of_the_iris_goes_on_until_every_edge_is_in_its_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An edge goes one frequency sample a step, and the colours' samples differ: after 12 steps, 0.0023 is left."""
    iris = 'kind = "iris"\nhalf_width = 0.84\ncentre_x_share = 0.064\ncentre_y_share = -0.04'
    captures = read_captures(in_three_colours(capsys, tmp_path, iris, distance_mm=12))
    batches = load(captures, captures.captures)
    ideal = fit(Model(captures.bench), [], batches).model
    values = {
        "half_width": 0.9,
        "centre_y": 0.075,
        "centre_x": 0.06,
        "roundness": 0.075,
        "stretch": -0.06,
        "edge": 0.015,
    }
    start = instance_with(catalogue()["iris"], captures.bench, values)
    monkeypatch.setattr(
        refit, "pattern_search", lambda model, predictors, points, start: start
    )  # as if it ended here
    assert refit.fit_from(ideal, start, batches).errors.excess < 1e-4
