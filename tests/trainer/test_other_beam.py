"""The panel's spectrum under a changed beam, against the whole panel drawn anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from runtime.lightpath.light_path import LightPath
from tests.trainer.test_effects import gray, present, scene_of
from trainer.model.model import EffectInstance
from trainer.model.model_stages import stages_for
from trainer.prediction.other_beam import spectra_of_other_beam
from trainer.prediction.panel_spectra import BESIDE, NOMINAL, panel_spectra
from trainer.prediction.predict import driven_phase, light_path

CROSSTALK = present("crosstalk", width_y=0.4, width_x=0.6)
BEAM = present("illumination", log_amplitude=[0.1, -0.2, -0.3, 0.05, -0.3])
FURTHER = present("illumination", log_amplitude=[0.13, -0.2, -0.33, 0.08, -0.3])
WAVEFRONT = present("panel_wavefront", wavefront=[0.0, 0.0, 0.3, 0.0, 0.2])
LEAK = present("zero_order", leak_real=0.1, fill_factor=1.0)
MORE_LEAK = present("zero_order", leak_real=0.1, leak_imaginary=0.1, fill_factor=1.0)
OPEN = present("iris", half_width=1.2)
ROUND = present("iris", half_width=0.6, roundness=1.0)
GHOST = present("coherent_ghost", real=0.1, shift_x=3.0)


def spectra_of(*effects: EffectInstance) -> tuple[LightPath, Tensor]:
    scene = scene_of(*effects)
    stages = stages_for(scene, effects)
    path = light_path(scene, stages)
    phase = driven_phase(path, stages, gray(), None)
    return path, panel_spectra(path, phase, (*NOMINAL, *BESIDE))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ([BEAM], [FURTHER]),
        ([], [BEAM]),
        ([BEAM], [BEAM, WAVEFRONT]),
        ([LEAK, BEAM], [LEAK, FURTHER]),
        ([LEAK, BEAM], [MORE_LEAK, BEAM]),
        ([BEAM, ROUND], [FURTHER, ROUND]),
        ([BEAM, present("polarisation_leak", real=0.2)], [FURTHER, present("polarisation_leak", real=0.2)]),
    ],
)
def test_a_beam_s_change_is_nearly_right(
    before: Sequence[EffectInstance], after: Sequence[EffectInstance]
) -> None:
    """On a panel so small that the beam changes much from pixel to pixel."""
    (old, spectra), (new, expected) = spectra_of(CROSSTALK, *before), spectra_of(CROSSTALK, *after)
    found = spectra_of_other_beam(old, new, spectra)
    assert found is not None
    change = torch.linalg.vector_norm(expected - spectra)
    assert float(change) > 0.01 * float(torch.linalg.vector_norm(spectra))
    assert float(torch.linalg.vector_norm(found - expected)) < 0.1 * float(change)


@pytest.mark.parametrize(("iris", "exact"), [([OPEN], True), ([], False)])
def test_it_is_exact_where_pixels_are_even_and_the_band_holds_nothing_back(
    iris: list[EffectInstance], exact: bool
) -> None:
    (old, spectra), (new, expected) = spectra_of(LEAK, BEAM, *iris), spectra_of(MORE_LEAK, FURTHER, *iris)
    alone = torch.ones((2, 1), dtype=spectra.real.dtype)
    drawn = [replace(path, crosstalk=(alone, alone)) for path in (old, new)]
    found = spectra_of_other_beam(*drawn, spectra)
    assert found is not None
    off = torch.linalg.vector_norm(found - expected) / torch.linalg.vector_norm(spectra - expected)
    assert (float(off) < 1e-5) is exact
    assert float(off) < 0.1


def test_a_beam_that_is_the_same_changes_nothing() -> None:
    (old, spectra), (new, _) = spectra_of(CROSSTALK, BEAM), spectra_of(CROSSTALK, BEAM, GHOST)
    assert spectra_of_other_beam(old, new, spectra) is spectra


def test_other_pixels_are_drawn_anew() -> None:
    narrow = present("zero_order", fill_factor=0.8)
    (old, spectra), (new, _) = spectra_of(CROSSTALK, LEAK), spectra_of(CROSSTALK, narrow)
    assert spectra_of_other_beam(old, new, spectra) is None
    (plain, spectra), (brighter, _) = spectra_of(BEAM), spectra_of(FURTHER)
    assert spectra_of_other_beam(plain, brighter, spectra) is None  # as quick without
