"""Scenes: one colour and one plane of a bench, and its four stages as the bench file has them.

A `Scene` holds what is fixed for one colour and one plane; `Stages` are its drive, panel, pupil and sensor as effects
receive them. `trainer.model.model_stages` applies the effects of a model to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from runtime.lightpath.grid import FINE, Grid, band_frequencies, grid_for, image_frequencies
from runtime.lightpath.propagation import Aperture, check_sampling
from trainer.captures.bench_file import Bench
from trainer.kept_results import kept_by_device
from trainer.prediction.stages import Drive, Panel, Pupil, Sensor


@dataclass(frozen=True)
class Scene:
    """One colour and one plane of a bench.

    Attributes
    ----------
    bench : Bench
    channel : str
    plane_mm : float, mm
        Panel to image plane.
    method : str
        Of propagation.
    grid : Grid
    dtype : torch.dtype
        Of all real tensors of the scene.
    """

    bench: Bench
    channel: str
    plane_mm: float
    method: str
    grid: Grid
    dtype: torch.dtype

    @property
    def wavelength(self) -> float:
        """Metres."""
        return self.bench.channel(self.channel).wavelength

    def channel_row(self) -> int:
        """Index of the colour in per-channel parameters."""
        return [c.name for c in self.bench.channels].index(self.channel)


@lru_cache(maxsize=64)
def scene_at(
    bench: Bench,
    channel: str,
    plane_mm: float,
    method: str,
    opened: float,
    dtype: torch.dtype,
    reach_mm: float | None = None,
    closed: float = 1.0,
) -> Scene:
    """The scene of a bench at one colour and plane.

    Parameters
    ----------
    opened : float
        Room for effects that open or move the iris, as a factor on what the bench states.
    reach_mm : float, optional, mm
        Room for light that goes farther than to the stated plane.
    closed : float
        Room for the wider figure of an iris that effects close to this share of what the bench states.

    Raises
    ------
    InputError
        Where the propagation method's sampling does not hold.
    """
    wavelength = bench.channel(channel).wavelength
    panel = bench.panel
    half_width = min(bench.iris.half_width * opened, 1.95)
    distance = plane_mm * 1e-3
    # In the far field nothing walks out of the grid: the image has its own, and the panel needs no room.
    spread = 0.0 if method == "fraunhofer" else max(abs(distance), 1e-3 * (reach_mm or 0.0))
    narrowest = min(bench.iris.half_width * closed, half_width)
    grid = grid_for(
        panel.shape,
        panel.pitch,
        wavelength,
        spread,
        half_width,
        narrowest=narrowest,
        stated=bench.iris.half_width,
    )
    if method == "fraunhofer":  # the panel's extent is the band there, and not the iris
        grid = replace(grid, fine=max(grid.fine, FINE))
    check_sampling(
        method,
        Aperture(panel.shape, grid.padded, panel.pitch),
        wavelength,
        distance,
        half_width / (2 * panel.pitch),
    )
    return Scene(bench, channel, plane_mm, method, grid, dtype)


@dataclass(frozen=True)
class Stages:
    """The four stages of a scene."""

    drive: Drive
    panel: Panel
    pupil: Pupil
    sensor: Sensor


@kept_by_device(32)
def bare_stages(scene: Scene) -> Stages:
    """The stages as the bench file has them."""
    bench, grid, dtype = scene.bench, scene.grid, scene.dtype
    height, width = bench.panel.shape
    panel_y, panel_x = _coordinates(height, width, dtype)
    camera_y, camera_x = _coordinates(*bench.camera.shape, dtype)
    like = torch.zeros((), dtype=dtype)
    reference = bench.channels[0].wavelength
    level = torch.arange(256, dtype=dtype) / bench.panel.levels
    drive = Drive(
        scene.channel,
        scene.wavelength,
        reference,
        bench.panel.phase_sign,
        panel_y,
        panel_x,
        level,
        bench.panel.phase_sign * 2 * math.pi * level,
    )
    side = torch.full((2,), math.sqrt(bench.panel.fill_factor), dtype=dtype)
    # One value in memory, as many scenes are kept.
    source = torch.ones((), dtype=dtype.to_complex()).expand(height, width)
    panel = Panel(
        scene.channel, scene.wavelength, reference, bench.panel.pitch, panel_y, panel_x, source, None, side
    )
    fy, fx = band_frequencies(grid, like)
    iy, ix = image_frequencies(grid, like)
    edge = 1 / (2 * bench.panel.pitch)
    zero = torch.zeros((), dtype=dtype)
    pupil = Pupil(
        scene.channel,
        scene.wavelength,
        reference,
        bench.panel.pitch,
        fy[:, None],
        fx[None, :],
        fy[:, None] / edge,
        fx[None, :] / edge,
        iy[:, None],
        ix[None, :],
        torch.tensor(scene.plane_mm * 1e-3, dtype=dtype),
        torch.tensor(bench.iris.half_width, dtype=dtype),
        (zero, zero),
        torch.tensor(1.0 if bench.iris.shape == "circle" else 0.0, dtype=dtype),
        zero,
        zero,
        zero,
    )
    sensor = Sensor(
        scene.channel,
        bench.camera.full_scale,
        camera_y,
        camera_x,
        iy[:, None] * bench.panel.pitch,
        ix[None, :] * bench.panel.pitch,
    )
    return Stages(drive, panel, pupil, sensor)


def _coordinates(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    y = (torch.arange(height, dtype=dtype) - (height - 1) / 2) / (height / 2)
    x = (torch.arange(width, dtype=dtype) - (width - 1) / 2) / (width / 2)
    return torch.broadcast_tensors(y[:, None], x[None, :])
