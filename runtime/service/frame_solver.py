"""Patterns for a picture by a deadline: the only place where the service calls the solver."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from firmware_iface.configured_devices import (
    MOST_LASERS,
    check_budget,
    laser_numbers,
    mrad_per_pixel,
    panel_fields,
)
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import SIZES_MRAD, spot_shares
from runtime.bundle.bundle_folder import INITIALISER, Bundle, read_bundle
from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, slow_response_share
from runtime.lightpath.light_path import LightPath
from runtime.lightpath.overdrive import overdrive_tables
from runtime.networks.onnx_approximator import approximator_of
from runtime.service.configuration import Configuration
from runtime.solver import Solution, Solver, shown
from runtime.solver.block_motion import Change, change_between

Result = TypeVar("Result")

NO_LIGHT = (1e-9,) * len(SIZES_MRAD)  # shares of a colour that is dark


@dataclass(frozen=True)
class Pattern:
    """Gray levels of a picture's pattern, or of all its patterns, and what the calibrated model predicts for them.

    Attributes
    ----------
    gray : uint8 array [C N, H, W]
        Gray levels of each field: of all colours in turn, N times.
    psnr_db : float, dB
        Amplitude PSNR, of N patterns that of the mean of their irradiances; of several colours, the lowest.
    final : bool
        No better pattern follows by the deadline.
    dark : bool
        The picture is black, which no pattern can show.
    shares : tuple of float
        Shares of the light in its brightest spots (eye_safety.spot_shares), colour after colour, each the largest of
        the colour's patterns, and raised by 1 / (1 - s) on a panel that keeps the share s of the phase before; empty
        where they were not asked for.
    brightness : tuple of float
        Light of each colour, as a share of what a white picture has in the colour that needs most; empty for a picture
        of one field, which has all.
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
    frames : int
        N, the patterns for each colour of a picture.
    slow_share : float
        Of the phase before that the panel keeps until a pattern's time is over.
    **options
        Of `Solver`.

    Attributes
    ----------
    overdrive : uint8 array [C, 3, 256, 256] or None
        `overdrive_tables` of each colour, where the panel is slow.
    colours : tuple of str
    shape : tuple of int
        Of a picture: (C, H, W).
    fields : int
        Of a frame: C N.
    """

    def __init__(
        self,
        paths: dict[str, LightPath],
        mrad_per_pixel: float = 0.0,
        frames: int = 1,
        slow_share: float = 0.0,
        **options: Any,
    ) -> None:
        self.colours = tuple(paths)
        self._paths, self._mrad, self._frames = list(paths.values()), mrad_per_pixel, frames
        self._slow_share = slow_share
        self.shape = (len(paths), *self._paths[0].grid.shape)
        self.fields = len(paths) * frames
        tables = [overdrive_tables(path.response, slow_share, path.gray_levels) for path in self._paths]
        self.overdrive = np.stack(tables) if slow_share else None
        self._solvers = [Solver(path, frames=frames, **options) for path in self._paths]
        # What one colour's solver does on one core alone, another's is computed beside.
        several = len(paths) > 1 and self._solvers[0].on.host_cores > 1
        self._pool = ThreadPoolExecutor(len(paths), "colours") if several else None
        # The picture before, of which lit colours, so that they look for its motion only once.
        self._before: Any = None
        self._lit: list[int] = []
        self._white = 0.0  # what a white picture gets in the colour that gets least, once that is known

    def rehearse(self) -> None:
        """Set up what the first use sets up, and measure this machine: on a large panel, seconds for each colour."""
        white = self._each(lambda k: self._solvers[k].rehearse(), range(len(self._solvers)))
        self._white = min(one.given[0] for one in white)
        for _ in self.patterns(np.ones(self.shape, np.float32), time.monotonic_ns()):
            pass

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
            dark = (0.0,) * len(target) if self.fields > 1 else ()
            gray = np.zeros((self.fields, *self.shape[1:]), np.uint8)
            yield Pattern(gray, 0.0, final=True, dark=True, brightness=dark)
            return
        if self.fields > 1 and not self._white:
            self.rehearse()
        began = time.monotonic_ns()
        there = self._solvers[0].on.xp.asarray(target)
        change = self._change(there, lit)
        firsts = self._each(lambda k: self._solvers[k].frame(there[k], 0, change=change), lit)
        solved, self._lit = dict(zip(lit, firsts, strict=True)), lit
        now = time.monotonic_ns()
        enough = deadline_ns - now > now - began  # as much as another start costs
        yield self._pattern(solved, final=not enough)
        if enough:

            def improve(k: int) -> Solution:
                first, left_ms = solved[k], (deadline_ns - time.monotonic_ns()) * 1e-6
                share_ms = left_ms / (1 if self._pool else len(lit) - lit.index(k))
                if share_ms <= 0:
                    return first
                better = self._solvers[k].solve(there[k], deadline_ms=share_ms, start=first.phase)
                # with a panel's few levels in the loop, a descent that time cuts short can end below its start
                return better if better.expected_psnr_db >= first.expected_psnr_db else first

            yield self._pattern(dict(zip(lit, self._each(improve, lit), strict=True)), final=True)

    def _each(self, work: Callable[[int], Result], colours: Sequence[int]) -> list[Result]:
        """What `work` returns for each colour, all at the same time where there are several cores."""
        if self._pool is None:
            return [work(k) for k in colours]
        return list(self._pool.map(work, colours))

    def _change(self, target: Any, lit: list[int]) -> Change | None:
        """What has become of the picture before, of all lit colours together; None where each has to find that."""
        if len(self._paths) == 1:
            return None
        before, followed = self._before, self._lit
        self._before, self._lit = target[lit].sum(0), []  # until all of them are solved
        return change_between(before, self._before, self._solvers[0].on) if followed == lit else None

    def _pattern(self, solved: dict[int, Solution], final: bool) -> Pattern:
        """What is known of the colours' patterns; colours without a solution are dark."""
        gray = np.empty((self._frames, *self.shape), np.uint8)
        for k in range(len(self.colours)):
            gray[:, k] = solved[k].gray if k in solved else 0
        shares: tuple[float, ...] = ()
        if self._mrad:
            for k, path in enumerate(self._paths):
                spots = brightest_spots(path, gray[:, k], self._mrad) if k in solved else NO_LIGHT
                shares += raised(spots, self._slow_share)
        brightness = self._brightness(solved) if self.fields > 1 else ()
        lowest_db = min(solution.expected_psnr_db for solution in solved.values())
        fields = gray.reshape(self.fields, *self.shape[1:])
        return Pattern(fields, lowest_db, final, shares=shares, brightness=brightness)

    def _brightness(self, solved: dict[int, Solution]) -> tuple[float, ...]:
        """For how much of its light's time each colour is lit.

        However bright a picture is, its pattern puts the same light somewhere. The time makes the picture right, so it
        goes with what a target of 1 gets: of a dark picture, more light goes where it is not wanted.
        """
        needed = [self._white / solved[k].given[0] if k in solved else 0.0 for k in range(len(self.colours))]
        most = max(1.0, *needed)
        return tuple(share / most for share in needed)


def brightest_spots(path: LightPath, grays: np.ndarray, mrad_per_pixel: float) -> tuple[float, ...]:
    """The largest shares of light in a spot of each size, of any of a picture's patterns, uint8 [N, H, W].

    So they hold for each pulse, and for any pulses together: the mean of several patterns' light is nowhere brighter
    than the brightest of them.
    """
    each = [spot_shares(shown(path, gray), mrad_per_pixel) for gray in grays]
    return tuple(map(max, zip(*each, strict=True)))


def raised(spots: Sequence[float], slow_share: float) -> tuple[float, ...]:
    """Predicted shares of light in bright spots, with room for a slow panel, which is on its way to the pattern."""
    return tuple(min(1.0, spot / (1 - slow_share)) for spot in spots)


def shown_colours(configuration: Configuration, bundle: Bundle) -> list[str]:
    """The colours that the service shows: one, or all of a bundle's in turn.

    Raises
    ------
    InputError
        Where the bundle, the panel and the lasers do not fit, or the power exceeds the Class 1 budget.
    """
    channels, fields = bundle_channels(bundle), panel_fields(configuration.devices["panel"])
    channel = configuration.timing.channel
    shown = [channel] if channel else channels
    if len(shown) > 1 and fields == 1:
        raise InputError(
            f'{configuration.bundle} has several colours and one is shown: write channel = "NAME" in [service], '
            f"one of {', '.join(channels)}, or fields = {len(channels)} in [panel] to show them in turn"
        )
    if len(shown) > MOST_LASERS:
        raise InputError(
            f"{configuration.bundle} has {len(shown)} colours and a board has {MOST_LASERS} lasers: write channel = "
            f'"NAME" in [service], one of {", ".join(channels)}, or export a bundle of fewer'
        )
    if fields % len(shown):
        raise InputError(
            f"[panel] has fields = {fields} and {len(shown)} colours are shown ({', '.join(shown)}): write fields = "
            f"{len(shown)}, or a multiple of it for several patterns of each colour"
        )
    laser_numbers(configuration.devices["lasers"], shown if fields > 1 else [])
    check_budget(configuration.devices, fields // len(shown))
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
        panel_fields(configuration.devices["panel"]) // len(colours),
        slow_response_share(bundle),
        grid="panel",  # before a deadline, more iterations gain more than the finer grid
        approximator=approximator,
        initialiser=bundle.networks.get(INITIALISER),
    )
