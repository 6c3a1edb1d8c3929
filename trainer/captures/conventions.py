"""How the camera's image is turned, and which sign the panel's phase has: a mismatch of conventions, not of physics.

Sixteen combinations are compared: eight ways to turn and mirror the camera's image, times two signs of the panel's
phase. (To mirror the panel's pattern is the same as to mirror the image. Another sign of the phase conjugates the
field, and so does counting the distance the other way: one picture cannot tell them apart, and one change corrects
both.)

A combination's score is the correlation of the ideal prediction with the measured images, at the best shift within a
few pixels, after the slow variation of beam and field is removed. A combination is *decisively* better than the
stated one when three things hold: over the images' tiles, the paired difference of Fisher's z has a t-statistic above
`T_LEVEL`; its correlation is at least `R_RATIO` times the stated one's; and it is at least `R_LEAST`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft as spfft
from scipy.ndimage import gaussian_filter

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench
from trainer.captures.image_turns import TURN_WORDS, TURNS, turned

T_LEVEL = 6.0
R_RATIO = 2.0
R_LEAST = 0.05
WINDOW = 8  # pixels, the largest shift that is looked for along each axis
CORE = 512  # pixels, the part of a large registered image that is compared

Predict = Callable[[Bench, np.ndarray, str, float], np.ndarray]


@dataclass(frozen=True)
class Sample:
    """One capture in memory.

    Attributes
    ----------
    capture : str
        Its id.
    gray : uint8 array [H, W]
        Gray levels sent to the panel.
    signal : float array [h, w], counts above black
    valid : bool array [h, w]
        Where the signal can be used.
    channel : str
    plane_mm : float, mm
    """

    capture: str
    gray: np.ndarray
    signal: np.ndarray
    valid: np.ndarray
    channel: str
    plane_mm: float


@dataclass(frozen=True)
class Score:
    """One combination, and how well the images fit it.

    Attributes
    ----------
    turn : str
        What is done to the images, one of TURNS.
    phase_sign : int
        The panel's.
    correlation : float
        Of prediction and images, -1 to 1, over all tiles.
    shift : tuple of (int, int), pixels
        (row, column) of the image against the prediction, one for each sample.
    t : float
        t-statistic of its advantage over the stated combination.
    """

    turn: str
    phase_sign: int
    correlation: float
    shift: tuple[tuple[int, int], ...]
    t: float = 0.0


@dataclass(frozen=True)
class Convention:
    """The result of a comparison of conventions.

    Attributes
    ----------
    best, stated : Score
        The best combination, and the bench's own.
    decisive : bool
        Another combination than the stated one is surely right.
    change : str
        What to do, one sentence; "" when the stated convention holds.
    scores : tuple of Score
        All combinations, best first.
    alike : tuple of Score
        Combinations that the data cannot tell from the best.
    """

    best: Score
    stated: Score
    decisive: bool
    change: str
    scores: tuple[Score, ...]
    alike: tuple[Score, ...] = ()


def compare_conventions(
    bench: Bench, samples: Sequence[Sample], predict: Predict, quick: bool = False
) -> Convention:
    """Score every combination that the image's shape allows; the module's text describes the test.

    Parameters
    ----------
    bench : Bench
    samples : sequence of Sample
    predict : callable
        The ideal model: (bench, gray, channel, plane_mm) -> irradiance [h, w] on any scale.
    quick : bool
        Stop when a sample fits so well as stated that no other combination can be decisively better.

    Returns
    -------
    Convention

    Raises
    ------
    InputError
        If there is no sample.
    """
    if not samples:
        raise InputError("there are no captures to compare conventions on: give at least one")
    stated_sign = bench.panel.phase_sign
    tiles: dict[tuple[str, int], list[np.ndarray]] = {}
    shifts: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for sample in samples:
        near, gray, image, valid, core = central_part(bench, sample)
        for sign in (stated_sign, -stated_sign):
            model = replace(near, panel=replace(near.panel, phase_sign=sign))
            made = np.asarray(predict(model, gray, sample.channel, sample.plane_mm), dtype=np.float32)[core]
            flat = flattened(made, np.ones(made.shape, bool))
            for turn in TURNS:
                observed, good = turned(image, turn), turned(valid, turn)
                if observed.shape != made.shape:
                    continue
                values, shift = tile_correlations(flattened(observed, good), good, flat)
                tiles.setdefault((turn, sign), []).append(values)
                shifts.setdefault((turn, sign), []).append(shift)
            if quick and R_RATIO * float(np.mean(tiles["as_stated", stated_sign][0])) > 1:
                return _conclude(tiles, shifts, stated_sign)
    return _conclude(tiles, shifts, stated_sign)


def _conclude(
    tiles: dict[tuple[str, int], list[np.ndarray]],
    shifts: dict[tuple[str, int], list[tuple[int, int]]],
    stated_sign: int,
) -> Convention:
    joined = {key: np.concatenate(values) for key, values in tiles.items()}
    reference = joined["as_stated", stated_sign]
    scores = [
        Score(turn, sign, float(np.mean(values)), tuple(shifts[turn, sign]), paired_t(values, reference))
        for (turn, sign), values in joined.items()
    ]
    scores.sort(key=lambda score: -score.correlation)
    best = scores[0]
    stated = next(s for s in scores if s.turn == "as_stated" and s.phase_sign == stated_sign)
    decisive = bool(
        best is not stated
        and best.t > T_LEVEL
        and best.correlation >= R_LEAST
        and best.correlation >= R_RATIO * max(stated.correlation, 0.0)
    )
    alike = tuple(
        s
        for s in scores[1:]
        if decisive
        and s.correlation * R_RATIO > best.correlation
        and paired_t(joined[best.turn, best.phase_sign], joined[s.turn, s.phase_sign]) < T_LEVEL
    )
    change = _change(best, stated, alike) if decisive else ""
    return Convention(best, stated, decisive, change, tuple(scores), alike)


def _change(best: Score, stated: Score, alike: tuple[Score, ...]) -> str:
    steps = _steps(best, stated)
    text = (
        f"the images fit the ideal model with correlation {stated.correlation:.2f} as stated and "
        f"{best.correlation:.2f} after a change of convention: {steps}"
    )
    if alike:
        text += "; these captures cannot tell this from: " + ", or ".join(_steps(s, stated) for s in alike)
    return text


def _steps(score: Score, stated: Score) -> str:
    steps = []
    if score.phase_sign != stated.phase_sign:
        steps.append(
            f"in bench.toml [panel] set phase_sign = {score.phase_sign} (more gray means "
            f"{'less' if score.phase_sign < 0 else 'more'} phase; a distance counted the other way "
            "looks the same, and this corrects it too)"
        )
    if score.turn in TURN_WORDS:
        steps.append(
            TURN_WORDS[score.turn] + " (or the panel's patterns)" * (score.turn.startswith("mirror"))
        )
    return " and ".join(steps) or "leave everything as stated"


def central_part(
    bench: Bench, sample: Sample
) -> tuple[Bench, np.ndarray, np.ndarray, np.ndarray, tuple[slice, slice]]:
    """A large registered capture, cut to its centre and what diffracts into it.

    Returns
    -------
    Bench, uint8 array
        The smaller bench and gray pattern.
    float array, bool array
        The image and its mask.
    tuple of slice
        Where the image is in the prediction.
    """
    whole = (slice(None), slice(None))
    if not bench.camera.registered:
        return bench, sample.gray, sample.signal, sample.valid, whole
    wave, pitch = bench.channel(sample.channel).wavelength, bench.panel.pitch
    reach = math.ceil(abs(sample.plane_mm) * 1e-3 * wave / (2 * pitch**2)) + 8
    outer, core, inside = [], [], []
    for size in bench.panel.shape:
        small = min(size, CORE + size % 2)
        large = min(size, small + 2 * reach)
        if large == size:  # nothing to gain by cutting this axis of the panel
            small = size if size <= 2 * CORE else small
        outer.append(slice((size - large) // 2, (size - large) // 2 + large))
        core.append(slice((size - small) // 2, (size - small) // 2 + small))
        inside.append(slice((large - small) // 2, (large - small) // 2 + small))
    gray = sample.gray[outer[0], outer[1]]
    panel = replace(bench.panel, height=gray.shape[0], width=gray.shape[1])
    camera = replace(bench.camera, height=gray.shape[0], width=gray.shape[1])
    return (
        replace(bench, panel=panel, camera=camera),
        gray,
        sample.signal[core[0], core[1]],
        sample.valid[core[0], core[1]],
        (inside[0], inside[1]),
    )


def flattened(image: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Amplitude without its slow variation, slightly blurred, zero where not valid; float32 [h, w]."""
    amplitude = np.sqrt(np.maximum(image, 0)).astype(np.float32)
    amplitude = gaussian_filter(amplitude, 0.7, mode="nearest")
    wide = max(4.0, min(16.0, min(image.shape) / 8))
    detail = amplitude - _slow_part(amplitude, wide)
    spread = np.sqrt(np.maximum(_slow_part(detail**2, wide), 0))
    floor = 0.1 * float(np.sqrt(np.mean(detail**2))) + 1e-12
    return np.where(valid, detail / (spread + floor), 0).astype(np.float32)


def _slow_part(picture: np.ndarray, width: float) -> np.ndarray:
    """A Gaussian blur of a standard deviation in pixels; the border repeats beyond itself.

    Through the Fourier transform, which takes a fraction of the time of a wide kernel.
    """
    beyond = int(4 * width)  # where the Gaussian has ended
    rows, columns = (spfft.next_fast_len(n + 2 * beyond, real=True) for n in picture.shape)
    room = [(beyond, size - n - beyond) for n, size in zip(picture.shape, (rows, columns), strict=True)]
    spectrum = spfft.rfft2(np.pad(picture, room, mode="edge"))
    fy, fx = spfft.fftfreq(rows).astype(np.float32), spfft.rfftfreq(columns).astype(np.float32)
    spectrum *= np.exp(-2 * (np.pi * width * fy[:, None]) ** 2)
    spectrum *= np.exp(-2 * (np.pi * width * fx) ** 2)
    blurred = spfft.irfft2(spectrum, s=(rows, columns))
    return np.asarray(blurred[beyond : beyond + picture.shape[0], beyond : beyond + picture.shape[1]])


def tile_correlations(
    image: np.ndarray, valid: np.ndarray, model: np.ndarray
) -> tuple[np.ndarray, tuple[int, int]]:
    """Correlation of each tile, at the shift (row, column) within WINDOW that fits the whole best."""
    rows, columns = image.shape
    window = max(1, min(WINDOW, min(rows, columns) // 8))
    cross = spfft.irfft2(spfft.rfft2(image) * np.conj(spfft.rfft2(model)), s=image.shape)
    near = np.roll(cross, (window, window), (0, 1))[: 2 * window + 1, : 2 * window + 1]
    at = np.unravel_index(int(np.argmax(near)), near.shape)
    shift = (int(at[0]) - window, int(at[1]) - window)
    moved = np.roll(model, shift, (0, 1))
    side = max(16, min(64, min(rows, columns) // 4))
    values = []
    for top in range(window, rows - window - side + 1, side):
        for left in range(window, columns - window - side + 1, side):
            cell = (slice(top, top + side), slice(left, left + side))
            use = valid[cell]
            if use.mean() < 0.5:
                values.append(0.0)
                continue
            a, b = image[cell][use], moved[cell][use]
            a, b = a - a.mean(), b - b.mean()
            values.append(float(a @ b) / (math.sqrt(float(a @ a) * float(b @ b)) + 1e-12))
    if not values:
        a, b = image[valid], moved[valid]
        values.append(float(a @ b) / (math.sqrt(float(a @ a) * float(b @ b)) + 1e-12) if a.size else 0.0)
    return np.asarray(values), shift


def beyond_chance(pixels: float) -> float:
    """The correlation that a picture of so many pixels does not have by chance, at the best of many shifts.

    About one pixel in four is an independent sample.
    """
    return max(R_LEAST, 5 * math.sqrt(4 / max(pixels, 1)))


def paired_t(values: np.ndarray, reference: np.ndarray) -> float:
    """t-statistic of the mean difference of Fisher's z over tiles; 0 with fewer than four tiles."""
    if len(values) != len(reference) or len(values) < 4:
        return 0.0
    gain = np.arctanh(np.clip(values, -0.999, 0.999)) - np.arctanh(np.clip(reference, -0.999, 0.999))
    spread = float(np.std(gain, ddof=1)) / math.sqrt(len(gain))
    return float(np.mean(gain)) / (spread + 1e-6)
