"""Looks for everything that is wrong with a capture set before anything is explained by it.

One capture at a time is in memory; all problems are collected and none is raised. Saturated pixels are
left out of every statistic.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.camera_noise import Repeats, black_estimate, compare_repeats
from trainer.captures.capture_set import (
    Bench,
    Camera,
    Capture,
    PictureError,
    read_bench,
    read_picture,
    scan_rows,
)
from trainer.captures.conventions import Predict, Sample, compare_conventions

SATURATED_SHARE = 0.03  # of the pixels at the top count
DARK_SHARE = 1e-3  # of the pixels that lie well below the stated black level
NOISE_FACTOR = 2.25  # measured noise variance over the camera model's
FEWEST_PATTERNS = 4
MOST_PAIRS = 12  # pairs of repeated pictures that are compared
MISREAD = ("convention", "left_justified", "bit_depth")  # kinds of problem after which every number is wrong

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong. severity : "error" or "warning"; capture : its id, "" for the whole set.

    kind : missing_file, wrong_size, saturated, left_justified, black_level, duplicate, too_few,
    unknown_channel,
        unreadable, bit_depth, not_a_number, noise, pattern, no_signal or convention
    message : what is wrong, where, and what to change
    """

    severity: str
    kind: str
    capture: str
    message: str


@dataclass
class _Seen:
    """What the pass over the captures leaves for the tests that need several of them."""

    patterns: dict[str, dict[str, str]] = field(default_factory=dict)  # channel: digest: name
    names: dict[tuple[str, str], tuple[str, str]] = field(default_factory=dict)
    repeats: dict[tuple[str, float, str, float], list[Capture]] = field(default_factory=dict)
    dark: np.ndarray = field(default_factory=lambda: np.zeros(65536, np.int64))
    good: list[Capture] = field(default_factory=list)
    shift: dict[str, int] = field(default_factory=dict)


def check_captures(
    folder: Path | str, progress: Progress | None = None, predict: Predict | None = None
) -> list[Problem]:
    """Every problem of the capture set in a folder, errors and warnings, in the order of the captures.

    progress : called with (captures done, captures in all)
    predict : the ideal model for the test of conventions, by default the product's own
    """
    folder = Path(folder).absolute()
    try:
        bench = read_bench(folder / "bench.toml")
    except InputError as error:
        return [Problem("error", "unreadable", "", str(error))]
    rows, faults = scan_rows(folder, bench)
    problems = [Problem("error", f.kind, f.capture, f.message) for f in faults]
    seen = _Seen()
    for number, capture in enumerate(rows):
        problems += _one(bench, capture, seen)
        if progress:
            progress(number + 1, len(rows))
    problems += _patterns(bench, seen)
    problems += _camera(bench, seen)
    problems += _convention(bench, seen, predict)
    return problems


def _load(capture: Capture, bench: Bench, seen: _Seen) -> tuple[np.ndarray, np.ndarray]:
    gray = read_picture(capture.phase, bench.panel.shape, 8, f"the pattern of capture {capture.capture}")
    counts = read_picture(
        capture.image,
        bench.camera.shape,
        16 if bench.camera.bit_depth > 8 else 0,
        f"the image of capture {capture.capture}",
    )
    return gray, counts >> seen.shift.get(capture.capture, 0)


def _one(bench: Bench, capture: Capture, seen: _Seen) -> list[Problem]:
    """What is wrong with one capture by itself; leaves its statistics in `seen` where it is sound."""
    try:
        gray, counts = _load(capture, bench, seen)
    except PictureError as error:
        return [Problem("error", error.kind, capture.capture, str(error))]
    problems: list[Problem] = []
    digest = hashlib.sha256(gray.tobytes()).hexdigest()
    seen.patterns.setdefault(capture.channel, {}).setdefault(digest, capture.pattern)
    known, first = seen.names.setdefault((capture.channel, capture.pattern), (digest, capture.capture))
    if known != digest:
        problems.append(
            Problem(
                "error",
                "pattern",
                capture.capture,
                f"capture {capture.capture} shows other gray levels than {first} "
                f"though both are pattern {capture.pattern!r}: give it another pattern name, or the right file",
            )
        )
    camera = bench.camera
    shift, wrong = _bits(counts, camera, capture.capture)
    problems += wrong
    if shift:
        seen.shift[capture.capture] = shift
        counts = counts >> shift
    if int(counts.max()) > camera.saturation:
        return problems
    problems += _brightness(counts, camera, capture.capture)
    seen.dark += np.bincount(counts[counts < camera.saturation].ravel(), minlength=65536)
    seen.good.append(capture)
    key = (capture.channel, capture.plane_mm, digest, capture.exposure_ms)
    seen.repeats.setdefault(key, []).append(capture)
    return problems


def _bits(counts: np.ndarray, camera: Camera, name: str) -> tuple[int, list[Problem]]:
    """How far the counts must be shifted down to be what bit_depth says, and the problem that this is."""
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


def _brightness(counts: np.ndarray, camera: Camera, name: str) -> list[Problem]:
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
    beside = float(((counts < top) & (counts >= top - 16)).mean()) / 16
    if share > SATURATED_SHARE and bright and share > 10 * beside:
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
    if float(counts[counts < camera.saturation].std()) < 2 * _dark_noise(camera):
        return [
            Problem(
                "warning",
                "no_signal",
                name,
                f"the image of capture {name} holds nothing above the "
                "camera's noise: see that the laser was on and the exposure long enough",
            )
        ]
    return []


def _patterns(bench: Bench, seen: _Seen) -> list[Problem]:
    problems = []
    for channel in bench.channels:
        number = len(seen.patterns.get(channel.name, {}))
        if number < FEWEST_PATTERNS:
            problems.append(
                Problem(
                    "warning",
                    "too_few",
                    "",
                    f"channel {channel.name!r} has {number} different patterns: take "
                    f"at least {FEWEST_PATTERNS}, so that some can be held back, and better 10 with one of them "
                    "repeated",
                )
            )
    return problems


def _camera(bench: Bench, seen: _Seen) -> list[Problem]:
    """The stated camera against the darkest pixels of all captures, and against repeated patterns."""
    camera, problems = bench.camera, []
    pairs = [pair for group in seen.repeats.values() for pair in pairwise(group)]
    measured: list[tuple[str, Repeats]] = []
    for a, b in pairs[:MOST_PAIRS]:
        repeats = compare_repeats(_load(a, bench, seen)[1], _load(b, bench, seen)[1], camera)
        if repeats:
            measured.append((b.capture, repeats))
    black = _black(camera, seen.dark, [repeats for _, repeats in measured])
    if black:
        return [black]
    for name, repeats in measured:
        if repeats.ratio > NOISE_FACTOR or repeats.ratio < 1 / NOISE_FACTOR:
            more = repeats.ratio > 1
            problems.append(
                Problem(
                    "warning",
                    "noise",
                    name,
                    f"capture {name} differs from an earlier capture of its pattern "
                    f"by {repeats.ratio**0.5:.2g} times the noise that the camera's numbers give: "
                    + ("look for vibration, drift or flicker, or " if more else "")
                    + "correct full_well_e and read_noise_e",
                )
            )
    return problems


def _black(camera: Camera, dark: np.ndarray, measured: Sequence[Repeats]) -> Problem | None:
    """The stated black level against the darkest pixels and against the repeats' noise.

    dark : int [65536], how many unsaturated pixels of all captures have each count
    Too high: many pixels are darker than black can be. Too low: the noise points to a higher level, and no
    pixel is as dark as the stated one (stray light also lifts the darkest pixels, but brings its own noise).
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
    return float(np.sqrt((camera.read_noise_e * camera.counts_per_electron) ** 2 + 1 / 12))


def _convention(bench: Bench, seen: _Seen, predict: Predict | None) -> list[Problem]:
    """Whether another convention than the stated one fits a few captures decisively better."""
    first: dict[tuple[str, str], Capture] = {}
    for capture in seen.good:
        first.setdefault((capture.channel, capture.pattern), capture)
    distinct = list(first.values())
    if not distinct:
        return []
    samples = []
    for place in sorted({round(i) for i in np.linspace(0, len(distinct) - 1, min(3, len(distinct)))}):
        capture = distinct[place]
        gray, counts = _load(capture, bench, seen)
        samples.append(
            Sample(
                capture.capture,
                gray,
                counts.astype(np.float32) - bench.camera.black_level,
                counts < bench.camera.saturation,
                capture.channel,
                capture.plane_mm,
            )
        )
    found = compare_conventions(bench, samples, predict, quick=True)
    return [Problem("error", "convention", "", found.change)] if found.decisive else []
