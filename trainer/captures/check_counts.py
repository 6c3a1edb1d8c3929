"""Looks for what is wrong with the counts: the bits they sit in, saturation, missing light, and the black level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import RepeatNoise, black_estimate, noise_variance
from trainer.captures.problems import Problem
from trainer.captures.signal_present import DARK, fault_of

SATURATED_SHARE = 0.03  # of the pixels at the top count
PILE_FACTOR, PILE_LEAST = 10, 8  # pixels at a top count: times those at each count just below, and at least
DULL = 0.75  # of the brightest quarter's light: what less is, in every capture, has a colour filter before it
ALIKE = 0.05  # difference of such shares
DARK_SHARE = 1e-3  # of the pixels that lie well below the stated black level


def check_bits(counts: np.ndarray, camera: Camera, name: str) -> tuple[int, list[Problem]]:
    """How far the counts must be shifted down to be what bit_depth says.

    Parameters
    ----------
    counts : uint16 array [h, w], raw counts
    camera : Camera
    name : str
        The capture's id.

    Returns
    -------
    int
        Bits.
    list of Problem
        What is wrong; empty where nothing is.
    """
    top = int(counts.max())
    used = int(np.bitwise_or.reduce(counts, axis=None))
    empty = (used & -used).bit_length() - 1 if used else 0
    spare = 16 - camera.bit_depth
    values = len(np.unique(counts[::3, ::3]))
    # some cameras copy the top bits into the empty ones
    repeated = (counts & ((1 << spare) - 1)) == counts >> camera.bit_depth
    filled = top > camera.saturation and bool(repeated.all())
    justified = spare > 0 and values >= 8 and (empty >= spare or filled)
    if not justified and values >= 8 and top >> empty <= camera.saturation < top:
        spare, justified = empty, True
    if justified:
        return spare, [
            Problem(
                "error",
                "left_justified",
                name,
                f"the image of capture {name} holds its counts shifted up "
                f"by {spare} bits (up to {top}, in steps of {1 << spare}): divide them by {1 << spare}",
            )
        ]
    if top > camera.saturation:
        return 0, [
            Problem(
                "error",
                "bit_depth",
                name,
                f"the image of capture {name} has counts up to {top}, but "
                f"camera.bit_depth = {camera.bit_depth} ends at {camera.saturation}: correct bit_depth, or save "
                "raw counts",
            )
        ]
    if empty and values >= 16:
        return 0, [
            Problem(
                "warning",
                "bit_depth",
                name,
                f"every count in the image of capture {name} is a multiple of "
                f"{1 << empty}: state the bits that the camera really gives, and save raw counts",
            )
        ]
    return 0, []


def check_top(camera: Camera, counts: np.ndarray) -> list[Problem]:
    """Whether the pixels pile up at the top count of fewer bits than bit_depth says.

    Parameters
    ----------
    camera : Camera
    counts : int array [65536]
        How many unsaturated pixels of all captures have each count.
    """
    used = np.flatnonzero(counts)
    top = int(used[-1]) if used.size else 0
    bits = top.bit_length()
    if top != 2**bits - 1 or bits >= camera.bit_depth or top <= camera.black_level:
        return []
    near = float(counts[max(top - 16, 0) : top].mean())
    if counts[top] < max(PILE_LEAST, PILE_FACTOR * near):
        return []
    return [
        Problem(
            "error",
            "bit_depth",
            "",
            f"{counts[top]} pixels pile up at {top}, the top count of {bits} bits, and none is above, but "
            f"camera.bit_depth = {camera.bit_depth}: write bit_depth = {bits}",
        )
    ]


def quarters(counts: np.ndarray, camera: Camera) -> np.ndarray:
    """Mean light of the four pixels of each 2 x 2, as shares of the brightest of them: [2, 2]."""
    if min(counts.shape) < 2:
        return np.ones((2, 2))
    parts = [[counts[i::2, j::2] for j in (0, 1)] for i in (0, 1)]
    sums = [[float(part[part < camera.saturation].sum()) for part in row] for row in parts]
    used = [[max(int((part < camera.saturation).sum()), 1) for part in row] for row in parts]
    light = np.array(sums) / np.array(used) - camera.black_level
    return light / max(float(light.max()), 1e-9)


def check_mosaic(shares: Sequence[np.ndarray]) -> list[Problem]:
    """Whether the pixels have colour filters, as of a colour camera whose raw counts were saved.

    Parameters
    ----------
    shares : sequence of float arrays [2, 2]
        Of each capture with light, as `quarters` gives them.
    """
    most = np.max(shares, axis=0) if shares else np.ones((2, 2))
    least, lower, upper, top = np.sort(most, axis=None)
    # Two dull and two bright ones alike are what patterns that alternate do, such as double phase.
    if least > DULL or max(lower - least, top - upper) < ALIKE:
        return []
    text = ", ".join(f"{value:.2f}" for value in most.ravel())
    return [
        Problem(
            "error",
            "mosaic",
            "",
            f"of every 2 x 2 pixels, some are dull in all captures (in reading order at most {text} of the brightest): "
            "these look like the raw counts of a colour camera. Use a monochrome one, or save every second row and "
            "column, of the brightest pixels: width and height are then half, pixel_um twice, and registered is false",
        )
    ]


def check_brightness(counts: np.ndarray, camera: Camera, name: str) -> list[Problem]:
    """What is wrong with the brightness of one picture, uint16 [h, w]: saturated, dark, or without contrast."""
    top = int(counts.max())
    share = float((counts == camera.saturation).mean())
    if share > SATURATED_SHARE:
        return [
            Problem(
                "error",
                "saturated",
                name,
                f"{100 * share:.1f} % of the pixels of capture {name} "
                f"are at the top count {camera.saturation}: take it again with less light",
            )
        ]
    share = float((counts == top).mean())
    bright = top > camera.black_level + 0.25 * camera.full_scale
    near_top = float(((counts < top) & (counts >= top - 16)).mean()) / 16
    if share > SATURATED_SHARE and bright and share > 10 * near_top:
        return [
            Problem(
                "error",
                "saturated",
                name,
                f"{100 * share:.1f} % of the pixels of capture {name} "
                f"pile up at {top}, below camera.bit_depth's top count {camera.saturation}: take it "
                "again with less light, or correct bit_depth if that is the camera's top",
            )
        ]
    if fault_of(counts, camera) == DARK:
        return [
            Problem(
                "error",
                "dark",
                name,
                f"the image of capture {name} shows no light above the camera's noise: check that the laser was on "
                "and the exposure long enough, then take it again or remove its row; fits leave it out",
            )
        ]
    if float(counts[counts < camera.saturation].std()) < 2 * _dark_noise(camera):
        return [
            Problem(
                "warning",
                "no_signal",
                name,
                f"the image of capture {name} holds nothing above the "
                "camera's noise: check that the laser was on and the exposure long enough",
            )
        ]
    return []


def check_black_level(camera: Camera, dark: np.ndarray, measured: Sequence[RepeatNoise]) -> Problem | None:
    """The stated black level against the darkest pixels and against the repeats' noise.

    Too high: many pixels are darker than black can be. Too low: the noise points to a higher level, and no
    pixel is as dark as the stated one. (Stray light also lifts the darkest pixels, but brings its own noise.)

    Parameters
    ----------
    camera : Camera
    dark : int array [65536]
        How many unsaturated pixels of all captures have each count.
    measured : sequence of RepeatNoise

    Returns
    -------
    Problem or None
    """
    pixels = int(dark.sum())
    if pixels < 256:
        return None
    noise = _dark_noise(camera)
    below = np.cumsum(dark) / pixels  # share of pixels at or below a count

    def share(count: float) -> float:
        return float(below[int(count)]) if count >= 0 else 0.0

    darkest = int(np.searchsorted(below, DARK_SHARE))
    estimate = black_estimate(list(measured), camera)
    stated = camera.black_level
    advice = "measure it with the laser off"
    if estimate:
        advice = f"the noise of the repeated patterns points to {estimate.level:.0f}; {advice}"
    off = 0.0 if estimate is None else estimate.level - stated
    sure = 0.0 if estimate is None else max(6 * estimate.error, 5 * noise, 0.003 * camera.full_scale)
    much = share(stated - 6 * noise - 0.001 * camera.full_scale) > DARK_SHARE
    some = share(stated - 4.5 * noise) > DARK_SHARE / 20
    if much or (estimate and off < -sure and some):
        return Problem(
            "error",
            "black_level",
            "",
            f"camera.black_level = {stated:g} is too high: pixels go "
            f"down to {darkest} counts, further than noise goes; {advice}",
        )
    if estimate and off > sure and darkest >= estimate.level - 4 * noise:
        return Problem(
            "error",
            "black_level",
            "",
            f"camera.black_level = {stated:g} is too low: no pixel "
            f"is darker than about {darkest} counts, and {advice}",
        )
    lowest = int(np.searchsorted(below, 1e-12))
    if not measured and stated < noise and lowest > stated + max(10 * noise, 0.002 * camera.full_scale):
        return Problem(
            "warning",
            "black_level",
            "",
            f"camera.black_level = {stated:g} is in doubt: no "
            f"pixel of any capture is darker than {lowest} counts, which is a black level or "
            f"stray light; {advice}",
        )
    return None


def _dark_noise(camera: Camera) -> float:
    """Standard deviation of a dark pixel, counts."""
    return float(np.sqrt(noise_variance(0.0, camera)))
