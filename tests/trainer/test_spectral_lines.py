"""A laser's line is a sum of wavelengths."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.trainer.hidden import LARGER, bench_file, ran
from tests.trainer.test_effects import moved, predicted, present, scene_of
from trainer.model.model_stages import stages_for


def test_a_line_has_the_width_that_it_says() -> None:
    lines = stages_for(scene_of(), (present("temporal_coherence", line_width=4.0),)).pupil.lines
    assert lines is not None
    offsets, weights = lines
    assert float(weights.sum()) == pytest.approx(1)
    spread = math.sqrt(float((weights * offsets**2).sum()))
    assert spread * 2 * math.sqrt(2 * math.log(2)) == pytest.approx(4e-9)


def test_a_broad_line_is_as_smooth_as_many_wavelengths() -> None:
    """Far from the panel the wavelengths of a broad line displace fine detail by pixels, and five show apart."""
    width, plane = 15.0, 15.0
    scene = scene_of(plane=plane)

    def of_lines(count: int) -> Tensor:
        nodes = torch.linspace(-3.5, 3.5, count, dtype=torch.float64)
        weights = torch.exp(-0.5 * nodes**2)
        bare = stages_for(scene, ())
        lines = bare.pupil.emitting(nodes * 1e-9 * width / 2.3548, weights / weights.sum())
        return predicted(scene, replace(bare, pupil=lines))

    smooth = of_lines(41)
    found = predicted(scene, stages_for(scene, (present("temporal_coherence", line_width=width),)))
    off, five = (float(((c - smooth) ** 2).mean() / smooth.var()) for c in (found, of_lines(5)))
    assert off < 1e-5
    assert five > 30 * off


@pytest.mark.parametrize("apart_nm", [-30.0, 12.0, 45.0])
@pytest.mark.parametrize("beside", [(), ("crosstalk",), ("amplitude_modulation",)])
def test_a_line_sees_the_panel_s_delay_at_its_own_wavelength(
    apart_nm: float, beside: tuple[str, ...]
) -> None:
    """The same light comes from a laser of that wavelength on a panel whose response is that much shorter."""
    others = tuple(moved(name) for name in beside)
    scene = scene_of(*others)
    stages = stages_for(scene, others)
    lines = stages.pupil.emitting(
        torch.tensor([1e-9 * apart_nm], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    )
    found = predicted(scene, replace(stages, pupil=lines))

    (colour,) = scene.bench.channels
    colour = replace(colour, wavelength_nm=colour.wavelength_nm + apart_nm)
    there = replace(scene, bench=replace(scene.bench, channels=(colour,)))
    scale = scene.wavelength / there.wavelength
    # What a pixel absorbs depends on its gray level, which the response over it is not a part of.
    drive = replace(stages.drive, response=scale * stages.drive.response)
    expected = predicted(there, replace(stages, drive=drive))
    same = predicted(there, stages)
    off, unscaled = (float(((c - expected) ** 2).mean() / expected.var()) for c in (found, same))
    assert off < 1e-4
    assert unscaled > 100 * off


def test_a_wavelength_that_is_stated_wrong_leaves_the_panel_s_response() -> None:
    """It was measured with the very laser; a line beside that one sees it scaled."""
    wrong = present("wavelength", offset=12.0)
    scene = scene_of()
    (colour,) = scene.bench.channels
    there = replace(scene, bench=replace(scene.bench, channels=(replace(colour, wavelength_nm=532.0),)))
    beside = present("source_lines", separation=15.0, share=0.4)
    for others in ((), (beside,)):
        found = predicted(scene, stages_for(scene, (wrong, *others)))
        expected = predicted(there, stages_for(there, others))
        assert float(((found - expected) ** 2).mean() / expected.var()) < 1e-5


def test_two_lines_far_apart_are_one_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With one panel for both lines, a third as much as nothing is left, and phase_response is named beside them."""
    bench = bench_file(tmp_path, 'kind = "source_lines"\nseparation_nm = 15\nshare = 0.4', **LARGER)
    captures = tmp_path / "captures"
    ran(capsys, "capture", "--bench", bench, "--out", captures, "--patterns", 8)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "source_lines"]
    assert found["steps"][-1]["excess"] < 1e-4
