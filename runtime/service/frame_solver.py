"""Patterns for a picture by a deadline: the only place where the service calls the solver."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface.configured_devices import mrad_per_pixel
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import spot_shares
from runtime.bundle.bundle_folder import INITIALISER, read_bundle
from runtime.bundle.light_path_arrays import bundle_channels, load_light_path
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import approximator_of
from runtime.service.configuration import Configuration
from runtime.solver import Solution, Solver, shown


@dataclass(frozen=True)
class Pattern:
    """Gray levels of a pattern, and what the calibrated model predicts for it.

    Attributes
    ----------
    gray : uint8 array [C, H, W]
        Gray levels of each colour.
    psnr_db : float, dB
        Amplitude PSNR.
    final : bool
        No better pattern follows by the deadline.
    dark : bool
        The picture is black, which no pattern can show.
    shares : tuple of float
        Shares of the light in its brightest spots (eye_safety.spot_shares); empty where they were not asked for.
    """

    gray: np.ndarray
    psnr_db: float
    final: bool
    dark: bool = False
    shares: tuple[float, ...] = ()


class PatternSolver:
    """Solves for one light path, frame after frame.

    Parameters
    ----------
    path : LightPath
    mrad_per_pixel : float, mrad
        Angle of a pixel at the eye, for predicting the brightest spots of each pattern; 0: they are not predicted.
    **options
        Of `Solver`.

    Attributes
    ----------
    shape : tuple of int
        (1, H, W).
    """

    def __init__(self, path: LightPath, mrad_per_pixel: float = 0.0, **options: Any) -> None:
        self.shape = (1, *path.grid.shape)
        self._path, self._mrad = path, mrad_per_pixel
        self._solver = Solver(path, **options)

    def patterns(self, target: np.ndarray, deadline_ns: int) -> Iterator[Pattern]:
        """Patterns for a target, each better than the one before.

        The first is always made, and starts from the pattern of the previous frame.

        Parameters
        ----------
        target : float32 array [1, H, W]
            Irradiance.
        deadline_ns : int, ns
            When the last pattern has to be ready (CLOCK_MONOTONIC).

        Yields
        ------
        Pattern

        Raises
        ------
        InputError
            For a target that cannot be shown.
        """
        if not target.any():
            yield Pattern(np.zeros(self.shape, np.uint8), 0.0, final=True, dark=True)
            return
        first = self._solver.frame(target[0], 0)
        left_ms = (deadline_ns - time.monotonic_ns()) * 1e-6
        enough = left_ms > first.milliseconds  # as much as another start costs
        yield self._pattern(first, final=not enough)
        if enough:
            better = self._solver.solve(target[0], deadline_ms=left_ms, start=first.phase)
            yield self._pattern(better, final=True)

    def _pattern(self, solution: Solution, final: bool) -> Pattern:
        shares: tuple[float, ...] = ()
        if self._mrad:
            shares = spot_shares(shown(self._path, solution.gray), self._mrad)
        return Pattern(solution.gray[None], solution.expected_psnr_db, final, shares=shares)


def open_solver(configuration: Configuration) -> PatternSolver:
    """The solver for a configuration's bundle and colour.

    Raises
    ------
    InputError
        Where the bundle and the colour do not fit.
    """
    bundle = read_bundle(configuration.bundle)
    channels = bundle_channels(bundle)
    channel = configuration.timing.channel or None
    if channel is None and len(channels) > 1:
        raise InputError(
            f'{configuration.bundle} has several colours and one is shown: write channel = "NAME" in [service], '
            f"one of {', '.join(channels)}"
        )
    path = load_light_path(bundle, channel)
    approximator = approximator_of(bundle, (len(channels), *path.grid.shape))
    if approximator is not None and len(channels) > 1:
        raise InputError(
            f"{configuration.bundle} has an approximator that sees {len(channels)} colours and one is shown: "
            "export a bundle of that colour alone"
        )
    return PatternSolver(
        path,
        mrad_per_pixel(configuration.devices["lasers"]),
        grid="panel",  # before a deadline, more iterations gain more than the finer grid
        approximator=approximator,
        initialiser=bundle.networks.get(INITIALISER),
    )
