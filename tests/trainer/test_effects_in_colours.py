"""Effects that differ from colour to colour, hidden in simulated benches of three colours."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file, ran, with_few_effects
from tests.trainer.test_effects import bench
from trainer.captures.batches import load
from trainer.captures.capture_set import read_captures
from trainer.effects import catalogue
from trainer.fitting import refit
from trainer.fitting.gauss_newton import fit
from trainer.model.model import Model, instance_with
from trainer.model.model_file import read_model, write_model

GREEN = '[[channel]]\nname = "green"\nwavelength_nm = 520\n'
RED, BLUE = (
    GREEN.replace("green", name).replace("520", nm) for name, nm in (("red", "638"), ("blue", "450"))
)


def in_three_colours(
    capsys: pytest.CaptureFixture[str], folder: Path, defect: str, distance_mm: float = 9
) -> Path:
    """A capture set of a bench of three colours with a defect."""
    file = bench_file(folder, defect, width=128, height=96, distance_mm=distance_mm)
    file.write_text(file.read_text().replace(GREEN, RED + GREEN + BLUE))
    ran(capsys, "capture", "--bench", file, "--out", folder / "captures", "--patterns", 4)
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


def test_each_laser_has_a_line_width_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """4, 7.2 and 10.4 nm: with one width for all, 0.0006 of 0.002 is left, outside the catalogue."""
    with_few_effects(monkeypatch, "temporal_coherence", "wavelength", "spatial_coherence")
    line = 'kind = "temporal_coherence"\nlinewidth_nm = 4\nspread = 0.8'
    captures = in_three_colours(capsys, tmp_path, line, distance_mm=12)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "temporal_coherence"]
    assert found["steps"][-1]["excess"] < 2e-4
    (effect,) = found["effects"]
    width = effect["parameters"]["line_width_nm"]
    for name, expected in (("red", 4.0), ("green", 7.2), ("blue", 10.4)):
        assert abs(width["value"][name] - expected) < 4 * width["error"][name] + 0.1


def test_a_laser_that_no_capture_shows_stays_as_the_bench_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with_few_effects(monkeypatch, "temporal_coherence")
    captures = in_three_colours(capsys, tmp_path, 'kind = "temporal_coherence"\nlinewidth_nm = 6', 12)
    table = captures / "captures.csv"
    head, *rows = table.read_text().splitlines(keepends=True)
    table.write_text(head + "".join(row for row in rows if ",blue," not in row))
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "temporal_coherence"]
    width = found["effects"][0]["parameters"]["line_width_nm"]
    assert width["value"]["red"] == pytest.approx(6, abs=0.3)
    assert width["value"]["blue"] == 0
    assert width["error"]["blue"] is None


def test_each_laser_has_lines_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Apart by 6, 2.4 and -1.2 nm, so that no start serves all: with one separation, a wavelength is named."""
    with_few_effects(monkeypatch, "source_lines", "wavelength", "temporal_coherence")
    captures = in_three_colours(capsys, tmp_path, 'kind = "source_lines"\nspread = -0.6', distance_mm=12)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "source_lines"]
    assert found["steps"][-1]["excess"] < 2e-4
    (effect,) = found["effects"]
    apart, share = (effect["parameters"][name]["value"] for name in ("separation_nm", "share"))
    for name, expected in (("red", 6.0), ("green", 2.4), ("blue", -1.2)):
        # Of lines that are near together, only the mean and its distance from the nominal line are certain.
        assert apart[name][0] * share[name][0] == pytest.approx(0.3 * expected, abs=0.15)


def test_a_model_file_with_one_line_width_for_all_lasers_is_read(tmp_path: Path) -> None:
    of_two, file = bench(True), tmp_path / "model.toml"
    effect = instance_with(catalogue()["temporal_coherence"], of_two, {"line_width": [2.0, 3.0]})
    write_model(file, Model(of_two).having(effect))
    text, rows = file.read_text(), "value.red = 2.0\nvalue.green = 3.0"
    assert rows in text
    older = [line for line in text.replace(rows, "value = 2.5").splitlines() if not line.startswith("apart")]
    file.write_text("\n".join(older))
    (read,) = read_model(file, catalogue()).present
    assert read.values["line_width"].tolist() == 2.5


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
