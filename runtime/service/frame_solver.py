"""Patterns for a picture by a deadline: the only place where the service calls the solver."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface.configured_devices import laser_numbers, mrad_per_pixel, panel_fields
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import SIZES_MRAD, spot_shares
from runtime.bundle.bundle_folder import INITIALISER, Bundle, read_bundle
from runtime.bundle.light_path_arrays import bundle_channels, load_light_path
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import approximator_of
from runtime.service.configuration import Configuration
from runtime.solver import Solution, Solver, shown

MOST_COLOURS = 3  # lasers of a board
NO_LIGHT = (1e-9,) * len(SIZES_MRAD)  # shares of a colour that is dark


@dataclass(frozen=True)
class Pattern:
    """Gray levels of a pattern, and what the calibrated model predicts for it.

    Attributes
    ----------
    gray : uint8 array [C, H, W]
        Gray levels of each colour.
    psnr_db : float, dB
        Amplitude PSNR; of several colours, the lowest.
    final : bool
        No better pattern follows by the deadline.
    dark : bool
        The picture is black, which no pattern can show.
    shares : tuple of float
        Shares of the light in its brightest spots (eye_safety.spot_shares), colour after colour; empty where they were
        not asked for.
    brightness : tuple of float
        Light of each colour, as a share of what a white picture has; empty for a picture of one colour, which has all.
    """

    gray: np.ndarray
    psnr_db: float
    final: bool
    dark: bool = False
    shares: tuple[float, ...] = ()
    brightness: tuple[float, ...] = ()


class PatternSolver:
    """Solves for the light path of each colour, frame after frame.

    Parameters
    ----------
    paths : mapping of str to LightPath
        By colour.
    mrad_per_pixel : float, mrad
        Angle of a pixel at the eye, for predicting the brightest spots of each pattern; 0: they are not predicted.
    **options
        Of `Solver`.

    Attributes
    ----------
    colours : tuple of str
    shape : tuple of int
        (C, H, W).
    """

    def __init__(self, paths: dict[str, LightPath], mrad_per_pixel: float = 0.0, **options: Any) -> None:
        self.colours = tuple(paths)
        self._paths, self._mrad = list(paths.values()), mrad_per_pixel
        self.shape = (len(paths), *self._paths[0].grid.shape)
        self._solvers = [Solver(path, **options) for path in self._paths]

    def patterns(self, target: np.ndarray, deadline_ns: int) -> Iterator[Pattern]:
        """Patterns for a target, each better than the one before.

        The first is always made, and starts from the pattern of the previous frame.

        Parameters
        ----------
        target : float32 array [C, H, W]
            Irradiance, 0 to 1.
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
        lit = [k for k, colour in enumerate(target) if colour.any()]
        if not lit:
            dark = (0.0,) * len(target) if len(target) > 1 else ()
            yield Pattern(np.zeros(self.shape, np.uint8), 0.0, final=True, dark=True, brightness=dark)
            return
        solved = {k: self._solvers[k].frame(target[k], 0) for k in lit}
        left_ms = (deadline_ns - time.monotonic_ns()) * 1e-6
        enough = left_ms > sum(one.milliseconds for one in solved.values())  # as much as another start costs
        yield self._pattern(solved, target, final=not enough)
        if enough:
            for done, k in enumerate(lit):
                share_ms = (deadline_ns - time.monotonic_ns()) * 1e-6 / (len(lit) - done)
                if share_ms > 0:
                    start = solved[k].phase
                    solved[k] = self._solvers[k].solve(target[k], deadline_ms=share_ms, start=start)
            yield self._pattern(solved, target, final=True)

    def _pattern(self, solved: dict[int, Solution], target: np.ndarray, final: bool) -> Pattern:
        gray = np.zeros(self.shape, np.uint8)
        for k, solution in solved.items():
            gray[k] = solution.gray
        shares: tuple[float, ...] = ()
        if self._mrad:
            for k, path in enumerate(self._paths):
                shares += spot_shares(shown(path, gray[k]), self._mrad) if k in solved else NO_LIGHT
        # a pattern puts all of its light into the picture, however bright that is: the light's time makes it right
        brightness = tuple(float(c.mean()) for c in target) if len(target) > 1 else ()
        lowest_db = min(solution.expected_psnr_db for solution in solved.values())
        return Pattern(gray, lowest_db, final, shares=shares, brightness=brightness)


def shown_colours(configuration: Configuration, bundle: Bundle) -> list[str]:
    """The colours that the service shows: one, or all of a bundle's in turn.

    Raises
    ------
    InputError
        Where the bundle, the panel and the lasers do not fit.
    """
    channels, fields = bundle_channels(bundle), panel_fields(configuration.devices["panel"])
    channel = configuration.timing.channel
    shown = [channel] if channel else channels
    if len(shown) > 1 and fields == 1:
        raise InputError(
            f'{configuration.bundle} has several colours and one is shown: write channel = "NAME" in [service], '
            f"one of {', '.join(channels)}, or fields = {len(channels)} in [panel] to show them in turn"
        )
    if fields not in (1, len(shown)) or len(shown) > MOST_COLOURS:
        raise InputError(
            f"[panel] has fields = {fields} and {len(shown)} colours are shown ({', '.join(shown)}): the two must be "
            f"equal, up to {MOST_COLOURS}; change fields, or leave it out for one colour"
        )
    laser_numbers(configuration.devices["lasers"], shown if fields > 1 else [])
    return shown


def open_solver(configuration: Configuration) -> PatternSolver:
    """The solver for a configuration's bundle and colours.

    Raises
    ------
    InputError
        Where the bundle and the colours do not fit.
    """
    bundle = read_bundle(configuration.bundle)
    channels, colours = bundle_channels(bundle), shown_colours(configuration, bundle)
    paths = {colour: load_light_path(bundle, colour) for colour in colours}
    shape = next(iter(paths.values())).grid.shape
    approximator = approximator_of(bundle, (len(channels), *shape))
    if approximator is not None and len(channels) > 1:
        raise InputError(
            f"{configuration.bundle} has an approximator that sees {len(channels)} colours at once, and the service "
            "solves each by itself: export a bundle of one colour, or one without a network"
        )
    return PatternSolver(
        paths,
        mrad_per_pixel(configuration.devices["lasers"]),
        grid="panel",  # before a deadline, more iterations gain more than the finer grid
        approximator=approximator,
        initialiser=bundle.networks.get(INITIALISER),
    )
