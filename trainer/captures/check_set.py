"""Looks for everything that is wrong with a capture set, before anything is explained by it.

One capture at a time is in memory. All problems are collected and none is raised. Saturated pixels are left out of
every statistic.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from runtime.program.progress import Progress
from trainer.captures.bench_file import Bench, read_bench
from trainer.captures.camera_noise import RepeatNoise, compare_repeats
from trainer.captures.camera_numbers import MEASURED_PAIRS, MOST_PAIRS, camera_by_repeats, numbers_text
from trainer.captures.capture_table import Capture, scan_rows
from trainer.captures.check_brackets import bracket_problems, excused
from trainer.captures.check_counts import (
    check_bits,
    check_black_level,
    check_brightness,
    check_mosaic,
    check_top,
    quarters,
)
from trainer.captures.conventions import Predict, Sample, compare_conventions
from trainer.captures.full_pixels import SURELY, brightest, check_full, may_be_full
from trainer.captures.mismatches import mismatched
from trainer.captures.png_reader import PictureError, read_picture
from trainer.captures.problems import MISREAD, Problem

NOISE_FACTOR = 2.25  # measured noise variance over the camera model's
NOT_MEASURED = (
    "bench.toml does not state camera.full_well_e and read_noise_e, and no repeated pictures show them, so a common "
    "camera's are assumed: capture one pattern twice, or write them"
)
FEWEST_PATTERNS = 4


@dataclass
class _SetStatistics:
    """What the pass over the captures leaves for the tests that need several of them.

    Attributes
    ----------
    patterns : dict
        By channel, and by the digest of the gray levels: the pattern's name.
    names : dict
        By (channel, pattern): the digest, and the first capture's id.
    repeats : dict
        By (channel, plane, digest, exposure): the captures.
    dark : int array [65536]
        How many unsaturated pixels have each count.
    good : list of Capture
        Those whose counts can be used, and show light.
    quarters : list of float array [2, 2]
        Light of the four pixels of each 2 x 2, of each capture in `good`.
    full : dict
        By channel and digest of a pattern: how bright its full pixels are, share of full scale; None where it has none.
    shift : dict
        By capture id: bits by which its counts are shifted down.
    """

    patterns: dict[str, dict[str, str]] = field(default_factory=dict)
    names: dict[tuple[str, str], tuple[str, str]] = field(default_factory=dict)
    repeats: dict[tuple[str, float, str, float], list[Capture]] = field(default_factory=dict)
    dark: np.ndarray = field(default_factory=lambda: np.zeros(65536, np.int64))
    good: list[Capture] = field(default_factory=list)
    quarters: list[np.ndarray] = field(default_factory=list)
    full: dict[tuple[str, str], float | None] = field(default_factory=dict)
    shift: dict[str, int] = field(default_factory=dict)


def check_captures(folder: Path | str, predict: Predict, progress: Progress | None = None) -> list[Problem]:
    """Every problem of the capture set in a folder, errors and warnings, in the order of the captures.

    Parameters
    ----------
    folder : path
    predict : callable
        The ideal model, for the test of conventions: (bench, gray, channel, plane_mm) -> irradiance [h, w].
    progress : callable, optional
        Called with the share of the captures that is done.

    Returns
    -------
    list of Problem
    """
    folder = Path(folder).absolute()
    try:
        bench = read_bench(folder / "bench.toml")
    except InputError as error:
        return [Problem("error", "unreadable", "", str(error))]
    rows, faults = scan_rows(folder, bench)
    problems = [Problem("error", f.kind, f.capture, f.message) for f in faults]
    statistics = _SetStatistics()
    made_good = excused(rows)
    for number, capture in enumerate(rows):
        found = _one(bench, capture, statistics)
        problems += [p for p in found if p.kind not in made_good.get(capture.capture, ())]
        if progress:
            progress((number + 1) / len(rows))
    problems += bracket_problems(rows, bench.camera, lambda row: _load(row, bench, statistics)[1])
    problems += _patterns(bench, statistics)
    problems += _camera(bench, statistics)
    problems += _convention(bench, statistics, predict)
    return problems


def errors_unless_misread(folder: Path | str, predict: Predict) -> list[Problem]:
    """The errors of a capture set that can still be used.

    Raises
    ------
    InputError
        Where the captures are misread, so that every number would be wrong.
    """
    errors = [p for p in check_captures(folder, predict) if p.severity == "error"]
    for problem in errors:
        if problem.kind in MISREAD:
            raise InputError(problem.message)
    return errors


def _load(capture: Capture, bench: Bench, statistics: _SetStatistics) -> tuple[np.ndarray, np.ndarray]:
    """A capture's gray levels [H, W] and its counts [h, w], shifted to the bits that bit_depth says."""
    gray = read_picture(capture.phase, bench.panel.shape, 8, f"the pattern of capture {capture.capture}")
    counts = read_picture(
        capture.image,
        bench.camera.shape,
        16 if bench.camera.bit_depth > 8 else 0,
        f"the image of capture {capture.capture}",
    )
    return gray, counts >> statistics.shift.get(capture.capture, 0)


def _one(bench: Bench, capture: Capture, statistics: _SetStatistics) -> list[Problem]:
    """What is wrong with one capture by itself; adds to `statistics` where it is sound."""
    try:
        gray, counts = _load(capture, bench, statistics)
    except PictureError as error:
        return [Problem("error", error.kind, capture.capture, str(error))]
    problems: list[Problem] = []
    digest = hashlib.sha256(gray.tobytes()).hexdigest()
    statistics.patterns.setdefault(capture.channel, {}).setdefault(digest, capture.pattern)
    known, first = statistics.names.setdefault((capture.channel, capture.pattern), (digest, capture.capture))
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
    shift, wrong = check_bits(counts, camera, capture.capture)
    problems += wrong
    if shift:
        statistics.shift[capture.capture] = shift
        counts = counts >> shift
    if int(counts.max()) > camera.saturation:
        return problems
    brightness = check_brightness(counts, camera, capture.capture)
    problems += brightness
    statistics.dark += np.bincount(counts[counts < camera.saturation].ravel(), minlength=65536)
    if any(p.kind == "dark" for p in brightness):
        return problems
    statistics.good.append(capture)
    statistics.quarters.append(quarters(counts, camera))
    full = brightest(counts, camera) if may_be_full(counts, camera, SURELY) else None
    statistics.full[capture.channel, digest] = full
    key = (capture.channel, capture.plane_mm, digest, capture.exposure_ms)
    statistics.repeats.setdefault(key, []).append(capture)
    return problems


def _patterns(bench: Bench, statistics: _SetStatistics) -> list[Problem]:
    """Whether each channel has enough different patterns."""
    problems = []
    for channel in bench.channels:
        number = len(statistics.patterns.get(channel.name, {}))
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


def _camera(bench: Bench, statistics: _SetStatistics) -> list[Problem]:
    """The stated camera against the darkest pixels of all captures, and against repeated patterns."""
    camera, problems = bench.camera, check_top(bench.camera, statistics.dark)
    problems += check_mosaic(statistics.quarters)
    problems += check_full([f for f in statistics.full.values() if f is not None], len(statistics.full))
    pairs = [pair for group in statistics.repeats.values() for pair in pairwise(group)][:MOST_PAIRS]
    measured: list[tuple[str, RepeatNoise]] = []
    for a, b in pairs:
        repeats = compare_repeats(_load(a, bench, statistics)[1], _load(b, bench, statistics)[1], camera)
        if repeats:
            measured.append((b.capture, repeats))
    # Repeats that differ by more than noise, as behind a slow panel, point nowhere.
    noisy = [repeats for _, repeats in measured if repeats.is_noise]
    black = check_black_level(camera, statistics.dark, noisy)
    if black:
        return [*problems, black]
    used = camera_by_repeats(camera, [repeats for _, repeats in measured[:MEASURED_PAIRS]])
    text = numbers_text(camera, used)
    if text:
        problems.append(Problem("warning", "camera_numbers", "", text + "; correct them in bench.toml"))
    elif not camera.noise_stated:
        problems.append(Problem("warning", "camera_numbers", "", NOT_MEASURED))
    for name, repeats in measured:
        ratio = repeats.ratio_to(used)
        if ratio > NOISE_FACTOR or ratio < 1 / NOISE_FACTOR:
            more = ratio > 1
            problems.append(
                Problem(
                    "warning",
                    "noise",
                    name,
                    f"capture {name} differs from an earlier capture of its pattern "
                    f"by {ratio**0.5:.2g} times the noise that the camera's numbers give: "
                    + ("look for vibration, drift or flicker, or " if more else "")
                    + "correct full_well_e and read_noise_e",
                )
            )
    return problems


def _convention(bench: Bench, statistics: _SetStatistics, predict: Predict) -> list[Problem]:
    """Whether another convention than the stated one fits a few captures decisively better."""
    first: dict[tuple[str, str], Capture] = {}
    for capture in statistics.good:
        first.setdefault((capture.channel, capture.pattern), capture)
    distinct = list(first.values())
    if not distinct:
        return []
    samples = []
    for place in sorted({round(i) for i in np.linspace(0, len(distinct) - 1, min(3, len(distinct)))}):
        capture = distinct[place]
        samples.append(_sample(capture, bench, statistics))
    found = compare_conventions(bench, samples, predict, quick=True)
    if found.decisive:
        return [Problem("error", "convention", "", found.change)]
    return _mismatches(bench, statistics, distinct, predict)


def _mismatches(
    bench: Bench, statistics: _SetStatistics, distinct: list[Capture], predict: Predict
) -> list[Problem]:
    """Images that stand next to the wrong patterns, a colour and plane at a time."""
    problems = []
    for channel, plane in dict.fromkeys((c.channel, c.plane_mm) for c in distinct):
        rows = [c for c in distinct if (c.channel, c.plane_mm) == (channel, plane)]
        samples = (_sample(capture, bench, statistics) for capture in rows)
        problems += mismatched(bench, samples, predict)
    return problems


def _sample(capture: Capture, bench: Bench, statistics: _SetStatistics) -> Sample:
    gray, counts = _load(capture, bench, statistics)
    signal, valid = counts.astype(np.float32) - bench.camera.black_level, counts < bench.camera.saturation
    return Sample(capture.capture, gray, signal, valid, capture.channel, capture.plane_mm)
