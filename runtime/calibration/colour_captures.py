"""What a calibration shows of one colour (`ColourPatterns`), and what it captures of it (`ColourCaptures`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from runtime.calibration.drift import Drift, drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.response import best_period, swept, thinned
from runtime.calibration.shown_patterns import GRAINS, HELD_OUT, grains, grating, proof_picture
from runtime.calibration.taking import Noise, Taker
from runtime.camera.registration import dot_pattern
from runtime.camera.view import View, on_panel, sampler
from runtime.solver import quality, solve

SOLVING = 30  # iterations a picture


@dataclass(frozen=True)
class ColourPatterns:
    """The patterns of one colour, uint8 arrays [H, W].

    Attributes
    ----------
    dots : array
        Where the camera looks.
    gratings : list of array
        For the phase response.
    fitted : list of array
        Random grains.
    heldout : list of array
        Random grains that no fit sees, and the test picture through the light path as it was, which is the last.
    """

    dots: np.ndarray
    gratings: list[np.ndarray]
    fitted: list[np.ndarray]
    heldout: list[np.ndarray]


@dataclass(frozen=True)
class ColourCaptures:
    """What was captured of one colour.

    Attributes
    ----------
    dots : Shot
    sweep, fitted, heldout : lists of Shot
        Of the gratings (of their pictures the rows that are used), the random grains, and the held-out patterns.
    exposure_ms : float, ms
    noise : Noise
        The camera's.
    """

    dots: Shot
    sweep: list[Shot]
    fitted: list[Shot]
    heldout: list[Shot]
    exposure_ms: float
    noise: Noise


def colour_patterns(bases: Mapping[str, ColourLightPath], seed: int) -> dict[str, ColourPatterns]:
    """The patterns of each colour, solved through the light path as it was; `seed` says which random grains.

    The grains are the same arrays for all colours, which saves their memory.
    """
    shape = next(iter(bases.values())).path.grid.shape
    fitted = [grains(shape, size, seed + k) for k, size in enumerate(GRAINS)]
    kept = [grains(shape, size, seed + 1000 + k) for k, size in enumerate(HELD_OUT)]
    dots = np.maximum(dot_pattern(shape, dot_spacing(shape)), 1e-3)
    still = Estimate(Drift(), View(shape))
    patterns = {}
    for channel, base in bases.items():
        path = base.path
        period = best_period(base, channel, still, sampler(still.view, path.grid, 1))
        patterns[channel] = ColourPatterns(
            solve(path, dots, SOLVING).gray,
            [grating(shape, period, g) for g in swept(path)],
            fitted,
            [*kept, proof_pattern(base, channel, Drift())],
        )
    return patterns


def proof_pattern(base: ColourLightPath, channel: str, drift: Drift) -> np.ndarray:
    """The pattern of the test picture through a drifted light path, uint8 [H, W]."""
    path = drifted(base.path, channel, base.wavelength_nm, drift)
    return solve(path, proof_picture(path.grid.shape), SOLVING).gray


def colour_captures(
    taker: Taker, channel: str, patterns: ColourPatterns, black: float, floor: float
) -> ColourCaptures:
    """Every capture of one colour, at an exposure that suits it.

    Parameters
    ----------
    taker : Taker
    channel : str
    patterns : ColourPatterns
    black : float, counts
    floor : float, counts^2
        Variance of a picture without light.
    """
    taker.light(channel)
    exposure = taker.expose(patterns.fitted[0], black)
    noise = taker.noise(patterns.fitted[0], black, floor)
    return ColourCaptures(
        taker.shot(channel, patterns.dots, noise, f"{channel}, dots"),
        taker.shots(channel, patterns.gratings, noise, f"{channel}, grating", thinned),
        taker.shots(channel, patterns.fitted, noise, f"{channel}, pattern"),
        taker.shots(channel, patterns.heldout, noise, f"{channel}, held-out pattern"),
        exposure,
        noise,
    )


def dot_spacing(shape: tuple[int, int]) -> float:
    """Spacing of the dots, panel pixels: six or seven along the shorter side."""
    return min(max(16.0, min(shape) / 7), min(shape) / 4.5)


def proof_pictures(
    taker: Taker, channel: str, gray: np.ndarray, captures: ColourCaptures, view: View
) -> dict[str, tuple[np.ndarray, float]]:
    """The test picture before and after, as the camera saw it.

    Parameters
    ----------
    taker : Taker
    channel : str
    gray : uint8 array [H, W]
        The pattern after; the one before is the last of the held-out ones.
    captures : ColourCaptures
        From before.
    view : View

    Returns
    -------
    dict of str to (float32 array [H, W], float)
        By "before" and "after": irradiance on the panel's pixels, and amplitude PSNR in dB.
    """
    taker.light(channel)
    taker.devices.camera.exposure_ms = captures.exposure_ms
    after = taker.shot(channel, gray, captures.noise, f"{channel}, picture")
    target = proof_picture(gray.shape)
    inside = tuple(slice(n // 16, n - n // 16) for n in gray.shape)
    seen = {}
    for name, shot in (("before", captures.heldout[-1]), ("after", after)):
        light = on_panel(shot.signal, view, gray.shape)
        seen[name] = (light, quality(np.maximum(light[inside], 0), target[inside]).psnr_db)
    return seen
