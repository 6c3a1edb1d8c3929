"""Predicted camera counts for a scene's stages and a set of patterns: the trainer's use of the light path.

A prediction has three results that can be used again when only a later stage has changed: the panel's spectrum,
irradiance, counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from runtime.lightpath.gray_levels import shown_as
from runtime.lightpath.host_arrays import unit_phasor
from runtime.lightpath.light_path import LightPath, panel_phase
from runtime.lightpath.modulation import Modulation
from runtime.lightpath.propagation import far_field_matrix
from trainer.device import array_of
from trainer.prediction.camera_light import light_on_camera
from trainer.prediction.other_beam import same, spectra_of_other_beam
from trainer.prediction.panel_gradient import has_panel_gradient, image_with_panel_gradient
from trainer.prediction.panel_spectra import BESIDE, NOMINAL, irradiance_of, panel_spectra
from trainer.prediction.pupil_modes import phase_scales, pupil_modes
from trainer.prediction.scene import Scene, Stages, bare_stages
from trainer.prediction.source_extent import Aside, extent_transfer, lit_by_extent
from trainer.prediction.stages import Drive, Pupil

MODULATION_SAMPLES = 512  # over phase: a linear step between them errs by 1e-5


def light_path(scene: Scene, stages: Stages) -> LightPath:
    """Drive, panel and pupil as arrays, ready for `runtime.lightpath.light_path`."""
    transfers, weights = pupil_modes(scene, stages.pupil)
    for amplitude, dy, dx in stages.panel.copies:
        # A displaced copy of a field is a linear phase over its spectrum.
        angle = -2 * math.pi * scene.bench.panel.pitch * (stages.pupil.fy * dy + stages.pupil.fx * dx)
        transfers = transfers * (1 + amplitude * torch.polar(torch.ones_like(angle), angle))
    source, offset = stages.panel.source, stages.drive.offset
    if offset is not None:
        source = source * torch.polar(torch.ones_like(offset), offset)
    response, panel = stages.drive.response, scene.bench.panel
    if panel.gray_levels:
        response = response[shown_as(panel.gray_levels, panel.levels)]
    return LightPath(
        grid=scene.grid,
        response=response,
        source=source,
        transfers=transfers,
        weights=weights,
        gain=stages.drive.gain,
        crosstalk=stages.drive.crosstalk,
        leak=stages.panel.unmodulated,
        aperture=(stages.panel.aperture[0], stages.panel.aperture[1]),
        irradiance_filter=display_filter(stages),
        far_field=_far_field(scene, stages.pupil) if scene.method == "fraunhofer" else None,
        modulation=_modulation(stages.drive),
        modulation_by_phase=stages.drive.components is not None,
        gray_levels=panel.gray_levels,
    )


def _modulation(drive: Drive) -> Modulation | None:
    """What the drive does besides the phase, over the phase that a level is driven to, or over that on the panel.

    Components turn with the light's own phase, wherever a map scales it. A level's factor is taken at the phase that it
    is driven to, and beside components at the phase on the panel, which is another one by the map's few percent.
    """
    if drive.factor is None and drive.components is None:
        return None
    phases, order = torch.sort(drive.response.detach())
    ends = phases[[0, -1]]
    if drive.components is not None and drive.gain is not None:
        scaled = ends[:, None] * torch.stack((drive.gain.detach().min(), drive.gain.detach().max()))
        ends = torch.stack((scaled.min(), scaled.max()))
    at = ends[0] + torch.linspace(0, 1, MODULATION_SAMPLES, dtype=phases.dtype) * (ends[1] - ends[0])
    one = torch.ones((1, 1), dtype=phases.dtype)
    plain = (torch.complex(one, 0 * one), 0 * one, one[0])
    amplitudes, turns, shares = plain if drive.components is None else drive.components
    table = (amplitudes[:, :, None] * unit_phasor(turns[:, :, None] * at)).sum(1)
    if drive.factor is not None:
        factor = drive.factor[order]
        above = torch.clamp(torch.searchsorted(phases, at), 1, len(phases) - 1)
        gap = torch.clamp(phases[above] - phases[above - 1], min=1e-9)
        way = torch.clamp((at - phases[above - 1]) / gap, 0, 1)
        table = table * (factor[above - 1] + way * (factor[above] - factor[above - 1]))
    return ends, table, shares


def driven_phase(path: LightPath, stages: Stages, gray: Tensor, earlier: Tensor | None) -> Tensor:
    """Phase (rad) of each pixel while a pattern is shown, with what is left of the patterns before it.

    Parameters
    ----------
    gray : int Tensor [B, H, W]
    earlier : int Tensor [B, n, H, W] or None
        Patterns shown before each, the last one first; None where nothing is known of them.
    """
    phase = panel_phase(path, gray)
    left = stages.drive.persistence
    if left is None or earlier is None:
        return phase
    before = panel_phase(path, earlier[:, -1])
    for k in reversed(range(earlier.shape[1] - 1)):
        before = panel_phase(path, earlier[:, k]) * (1 - left) + before * left
    return phase * (1 - left) + before * left


def _far_field(scene: Scene, pupil: Pupil) -> tuple[Tensor, Tensor]:
    """Matrices, rows and columns, from the band to the fine image grid, about the panel's axis.

    A laser line is represented by its centre here.
    """
    grid = scene.grid
    matrices = []
    for axis in (0, 1):
        count = grid.shape[axis]
        sample = torch.arange(grid.image_shape[axis], dtype=scene.dtype) / grid.fine - grid.margin
        position = (sample - (count - 1) / 2) * grid.pitch
        band = grid.frequency_index(axis)
        matrices.append(
            far_field_matrix(
                band, grid.padded[axis], count, grid.pitch, position, scene.wavelength, pupil.distance
            )
        )
    return matrices[0], matrices[1]


def bare_irradiance(scene: Scene, gray: np.ndarray) -> np.ndarray:
    """What the bench file alone predicts for one pattern.

    Parameters
    ----------
    gray : uint8 array [H, W]
        Gray levels as sent to the panel.

    Returns
    -------
    float32 array [h, w]
        In camera pixels, of arbitrary scale.
    """
    stages = bare_stages(scene)
    with torch.no_grad():
        patterns = torch.as_tensor(gray.astype(np.int64))[None]
        return array_of(light_on_camera(scene, stages, trace(scene, stages, patterns).image)[0])


def display_filter(stages: Stages) -> Tensor | None:
    """The irradiance filter that applies to the eye too: source extent and ghosts.

    What the iris's edge takes of light from aside is left out: the headset computes one picture, not five.
    """
    pupil, found = stages.pupil, None
    extent = None if pupil.extent is None else extent_transfer(pupil)
    for part in (extent, pupil.irradiance_filter, stages.sensor.irradiance_filter):
        if part is not None:
            found = part if found is None else found * part
    return found


@dataclass(frozen=True)
class Trace:
    """Results of a prediction that can be used again.

    Attributes
    ----------
    spectra : complex Tensor [B, states, 1 or 3, n, m]
        The panel's, as from `panel_spectra`; empty where only what happens at the panel has a gradient.
    image : Tensor
        Irradiance before filters, of the source with its extent.
    paths : tuple of LightPath
        Of each capture.
    asides : tuple of tuple of Aside
        Of each capture: what light of the extent beside the axis does to the image.
    of_point : Tensor or None
        Irradiance before filters, of a source that is a point; None where the source is one.
    """

    spectra: Tensor
    image: Tensor
    paths: tuple[LightPath, ...]
    asides: tuple[tuple[Aside, ...], ...]
    of_point: Tensor | None

    def of(self, k: int) -> Trace:
        """The results of capture k alone."""
        one = slice(k, k + 1)
        of_point = None if self.of_point is None else self.of_point[one]
        return Trace(self.spectra[one], self.image[one], self.paths[one], self.asides[one], of_point)

    @classmethod
    def joined(cls, parts: Sequence[Trace]) -> Trace:
        """The results of captures one after the other."""
        if len(parts) == 1:
            return parts[0]
        of_point = None
        if any(p.of_point is not None for p in parts):
            of_point = torch.cat([p.image if p.of_point is None else p.of_point for p in parts])
        return cls(
            torch.cat([p.spectra for p in parts]),
            torch.cat([p.image for p in parts]),
            tuple(path for p in parts for path in p.paths),
            tuple(aside for p in parts for aside in p.asides),
            of_point,
        )


def trace(
    scene: Scene,
    stages: Stages,
    gray: Tensor,
    start: str = "drive",
    before: Trace | None = None,
    earlier: Tensor | None = None,
    nearby: bool = False,
) -> Trace:
    """Spectrum and irradiance of patterns.

    Parameters
    ----------
    scene : Scene
    stages : Stages
    gray : int Tensor [B, H, W]
        Gray levels of the patterns.
    start : str
        The first stage that has changed since `before`.
    before : Trace, optional
        What earlier stages gave.
    earlier : int Tensor [B, n, H, W], optional
        Patterns shown before, as in `driven_phase`.
    nearby : bool
        The stages are a small step from those of `before`, for a derivative: a changed beam may be taken so roughly as
        `spectra_of_other_beam` does, and behind the same pupil light beside the axis as `lit_by_extent` does.

    Returns
    -------
    Trace
    """
    if before is not None and start == "sensor":
        return before
    path, scales = light_path(scene, stages), phase_scales(scene, stages.pupil)
    known = before.spectra if before is not None and start == "pupil" else None
    if nearby and before is not None and start == "panel":
        known = spectra_of_other_beam(before.paths[0], path, before.spectra)
    if known is None or (scales is not None and known.shape[2] == 1):
        phase = driven_phase(path, stages, gray, earlier)
        if scales is None and has_panel_gradient(path, phase):
            lit = _lit(scene, stages, path, lambda p: image_with_panel_gradient(p, phase))
            return _traced(torch.empty(0), lit, path, len(gray))
        known = panel_spectra(path, phase, NOMINAL) if known is None else known
        if scales is not None:
            known = torch.cat((known, panel_spectra(path, phase, BESIDE)), 2)
    spectra = known
    near: tuple[Aside, ...] = ()
    of_point = None
    if before is not None and same(before.paths[0].transfers, path.transfers):
        near = before.asides[0] if nearby else ()
        if start == "pupil" and scales is None and not torch.is_grad_enabled():
            of_point = _of_point(before, path)
    lit = _lit(scene, stages, path, lambda p: irradiance_of(p, spectra, scales), near, of_point)
    return _traced(spectra, lit, path, len(gray))


def _of_point(before: Trace, path: LightPath) -> Tensor | None:
    """A point source's irradiance, from a path with the same spectra and transfers; None where it is another."""
    old = before.paths[0]
    if not same(old.weights, path.weights) or path.far_field is not None:
        return None
    return before.image if before.of_point is None else before.of_point


class _Lit(NamedTuple):
    """Irradiance of a source that has its extent and of one that is a point, and what light beside the axis does."""

    image: Tensor
    of_point: Tensor
    asides: tuple[Aside, ...]


def _traced(spectra: Tensor, lit: _Lit, path: LightPath, count: int) -> Trace:
    asides = tuple(tuple(a.of(k) for a in lit.asides) for k in range(count))
    return Trace(
        spectra, lit.image, (path,) * count, asides, None if lit.of_point is lit.image else lit.of_point
    )


def _lit(
    scene: Scene,
    stages: Stages,
    path: LightPath,
    image: Callable[[LightPath], Tensor],
    near: Sequence[Aside] = (),
    of_point: Tensor | None = None,
) -> _Lit:
    """Irradiance with the source's extent, of a function that gives that of a light path of a point's light.

    Parameters
    ----------
    of_point : Tensor, optional
        What the function gives for `path`, where it is known.
    """
    on_axis = image(path) if of_point is None else of_point

    def image_of(pupil: Pupil) -> Tensor:
        own = pupil is stages.pupil
        return on_axis if own else image(light_path(scene, replace(stages, pupil=pupil)))

    lit, asides = lit_by_extent(stages.pupil, image_of, near)
    return _Lit(lit, on_axis, asides)
