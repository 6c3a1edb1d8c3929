"""Transfer functions of the pupil: iris, free space, aberration and transmission, one for each line of the laser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from runtime.lightpath.grid import beyond_edge, passed_share
from runtime.lightpath.propagation import band_limit, transfer_function
from trainer.kept_results import kept_by_device, kept_for_same
from trainer.prediction.scene import Scene, bare_stages
from trainer.prediction.stages import Pupil


def pupil_modes(scene: Scene, pupil: Pupil) -> tuple[Tensor, Tensor]:
    """The pupil's modes; kept where no effect changes the pupil, and for the last pupils.

    Returns
    -------
    transfers : complex Tensor [M, n, m]
        Transfer functions.
    weights : Tensor [M]
    """
    return _bare_modes(scene) if pupil is bare_stages(scene).pupil else _last_modes(scene, pupil)


def phase_scales(scene: Scene, pupil: Pupil) -> Tensor | None:
    """By how much each mode's line sees the panel's phase scaled, [M]; None where there is one line, the nominal one.

    A delay is as many waves more as the wavelength is shorter.
    """
    if pupil.lines is None or (pupil.nominal_offset is not None and len(pupil.lines[0]) == 1):
        return None
    offsets, _ = _lit(*pupil.lines)
    nominal = 0.0 if pupil.nominal_offset is None else pupil.nominal_offset
    return (scene.wavelength + nominal) / (scene.wavelength + offsets)


@kept_by_device(16)
def _bare_modes(scene: Scene) -> tuple[Tensor, Tensor]:
    return _modes(scene, bare_stages(scene).pupil)


@kept_for_same(10)  # of a fit's model and of its trial, each with the four further places of an extent's iris
def _last_modes(scene: Scene, pupil: Pupil) -> tuple[Tensor, Tensor]:
    return _modes(scene, pupil)


def _modes(scene: Scene, pupil: Pupil) -> tuple[Tensor, Tensor]:
    if pupil.lines is None:
        offsets, weights = torch.zeros(1, dtype=scene.dtype), torch.ones(1, dtype=scene.dtype)
    else:
        offsets, weights = _lit(*pupil.lines)
    opening = iris_opening(scene, pupil)
    if pupil.transmission is not None:
        opening = opening * pupil.transmission
    modes = []
    for offset in offsets:
        mode = opening
        if scene.method != "fraunhofer":
            mode = opening * _free_space(scene, pupil, offset)
        if pupil.path_difference is not None:
            angle = 2 * math.pi / (scene.wavelength + offset) * pupil.path_difference
            mode = mode * torch.polar(torch.ones_like(angle), angle)
        modes.append(mode)
    return torch.stack(modes), weights


def _lit(offsets: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Lines of the laser without those that have no light: a picture of each costs as much as any."""
    if weights.requires_grad:
        return offsets, weights
    lit = weights != 0
    return (offsets[lit], weights[lit]) if bool(lit.any()) else (offsets, weights)


def _free_space(scene: Scene, pupil: Pupil, offset: Tensor) -> Tensor:
    """Transfer function from the pupil's place to its distance, for a laser line at an offset (m)."""
    bare = bare_stages(scene).pupil
    if (
        pupil.distance.requires_grad
        or offset.requires_grad
        or pupil.fy is not bare.fy
        or pupil.fx is not bare.fx
    ):
        return _transfer(scene, pupil, scene.wavelength + offset, pupil.distance)
    return _known_transfer(scene, float(pupil.distance), float(offset))


@kept_by_device(4)  # most effects change neither distance nor line
def _known_transfer(scene: Scene, distance: float, offset: float) -> Tensor:
    return _transfer(
        scene, bare_stages(scene).pupil, scene.wavelength + offset, torch.tensor(distance, dtype=scene.dtype)
    )


def _transfer(scene: Scene, pupil: Pupil, wavelength: Any, distance: Tensor) -> Tensor:
    grid = scene.grid
    limits = [band_limit(scene.wavelength, float(distance.detach()), n * grid.pitch) for n in grid.padded]
    return transfer_function(pupil.fy, pupil.fx, wavelength, distance, (limits[0], limits[1]), scene.method)


def iris_opening(scene: Scene, pupil: Pupil) -> Tensor:
    """What the iris passes of each frequency.

    A frequency sample passes by the share of its width that lies inside (`passed_share`). A rectangle passes a little
    more than its half widths (`beyond_edge`), an ellipse what they say.

    Returns
    -------
    Tensor [n, m]
        0 to 1.
    """
    panel = scene.bench.panel.shape
    beyond = [(1 - pupil.roundness) * beyond_edge(n) for n in panel]
    bins = [2 / n for n in scene.grid.padded]  # width of a frequency sample, share of the band
    v, u = pupil.v - pupil.centre[0], pupil.u - pupil.centre[1]
    rows = pupil.half_width * (1 - pupil.stretch) + beyond[0]
    columns = pupil.half_width * (1 + pupil.stretch) + beyond[1]
    if not any(bool(x != 0) for x in (pupil.roundness, pupil.rotation, pupil.edge)):
        opening: Tensor = passed_share(v, rows, bins[0]) * passed_share(u, columns, bins[1])
        return opening
    across, along = v, u
    if bool(pupil.rotation != 0) or pupil.rotation.requires_grad:
        cosine, sine = torch.cos(pupil.rotation), torch.sin(pupil.rotation)
        across, along = cosine * v - sine * u, cosine * u + sine * v
    y, x = torch.broadcast_tensors(torch.abs(across) / rows, torch.abs(along) / columns)
    if y.requires_grad or any(t.requires_grad for t in (pupil.roundness, pupil.edge)):
        return _passed_by_rounded(y, x, pupil, (rows, columns), bins)
    # Without derivatives only what the edge can cut is computed: the outline lies between a circle and a square.
    reach = float((math.hypot(*bins) + pupil.edge) / (2 * torch.minimum(rows, columns))) + 1e-5
    farther = torch.maximum(y, x)
    cut = (farther < 1 + reach) & (y**2 + x**2 > max(1 - reach, 0) ** 2)
    passed = (farther < 1).to(y.dtype)
    passed[cut] = _passed_by_rounded(y[cut], x[cut], pupil, (rows, columns), bins)
    return passed


def _passed_by_rounded(
    y: Tensor, x: Tensor, pupil: Pupil, sides: tuple[Tensor, Tensor], bins: Sequence[float]
) -> Tensor:
    """Share of samples that a rounded rectangle passes: `y` and `x` from its centre in half sides, `bins` wide."""
    rows, columns = sides
    # Signed distance to a rounded square of half side 1, in units of the iris's own sides.
    corner = torch.clamp(pupil.roundness, 1e-6, 1)
    beyond_y, beyond_x = torch.clamp(y - 1 + corner, min=0), torch.clamp(x - 1 + corner, min=0)
    reach = torch.sqrt(beyond_y**2 + beyond_x**2 + 1e-12)
    inside = torch.clamp(torch.maximum(y, x) - 1 + corner, max=0)
    outside = reach + inside - corner
    # One unit is as long as the iris's half side where the nearest edge is, and a sample as wide as it is there.
    slope_y = torch.where(reach > 2e-6, beyond_y / reach, (y > x).to(y.dtype))
    slope_x = torch.where(reach > 2e-6, beyond_x / reach, (y <= x).to(y.dtype))
    unit = 1 / torch.sqrt((slope_y / rows) ** 2 + (slope_x / columns) ** 2 + 1e-12)
    width = torch.sqrt((slope_y * bins[0]) ** 2 + (slope_x * bins[1]) ** 2) + pupil.edge
    return torch.clamp(0.5 - outside * unit / width, 0, 1)
