"""Looks for what is wrong with the exposure brackets of a capture set."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Camera
from trainer.captures.brackets import bracket_faults, frame_scales, one_capture_each
from trainer.captures.capture_table import Capture
from trainer.captures.problems import Problem

OFF = (
    0.05  # by which the frames' brightness may differ from their exposures before the exposures are in doubt
)


def bracket_problems(
    rows: Sequence[Capture], camera: Camera, load: Callable[[Capture], np.ndarray]
) -> list[Problem]:
    """Everything that is wrong with the brackets.

    Parameters
    ----------
    rows : sequence of Capture
        Of captures.csv, in its order.
    camera : Camera
    load : callable
        Gives a row's raw counts, uint16 [h, w]; may raise InputError.

    Returns
    -------
    list of Problem
        Of kind "bracket": errors for brackets that cannot be merged; warnings for a bracket with fewer frames than
        most, and for one whose brightness does not follow its exposures.
    """
    if not any(row.bracket for row in rows):
        return []
    faults = bracket_faults(rows)
    problems = [Problem("error", f.kind, f.capture, f.message) for f in faults]
    captures = [c for c in one_capture_each(rows) if c.frames]
    numbers = [len(c.frames) for c in captures]
    usual = max(set(numbers), key=numbers.count)
    wrong = {f.capture for f in faults}
    for capture in captures:
        if wrong & {row.capture for row in capture.rows}:
            continue
        if len(capture.frames) < usual:
            problems.append(
                Problem(
                    "warning",
                    "bracket",
                    capture.capture,
                    f"bracket {capture.bracket!r} has {len(capture.frames)} captures, and most have {usual}: put back "
                    "the row of its missing exposure, if there is a picture of it",
                )
            )
        problems += _brightness(capture, camera, load)
    return problems


def _brightness(capture: Capture, camera: Camera, load: Callable[[Capture], np.ndarray]) -> list[Problem]:
    try:
        pictures = [load(row) for row in capture.rows]
    except InputError:  # reported where the capture is looked at by itself
        return []
    exposures = [row.exposure_ms for row in capture.rows]
    scales = frame_scales(pictures, exposures, camera)
    found = []
    for k in range(1, len(scales)):
        brightness, stated = scales[k] / scales[k - 1], exposures[k] / exposures[k - 1]
        if abs(brightness / stated - 1) > OFF:
            found.append(
                Problem(
                    "warning",
                    "bracket",
                    capture.rows[k].capture,
                    f"capture {capture.rows[k].capture} is {brightness:.3g} times as bright as "
                    f"{capture.rows[k - 1].capture} of its bracket, and its exposure is {stated:.3g} times as long: "
                    "correct exposure_ms, unless the laser's power changed so much between the two; they are merged "
                    "by their brightness",
                )
            )
    return found


def excused(rows: Sequence[Capture]) -> dict[str, tuple[str, ...]]:
    """By the id of each frame of a bracket: the kinds of problem that its other frames make good.

    Saturated pixels come back from the shortest exposure, and the dark from the longest.
    """
    kinds: dict[str, tuple[str, ...]] = {}
    for capture in one_capture_each(rows):
        for row in capture.frames:
            good: tuple[str, ...] = () if row is capture.frames[0] else ("saturated",)
            kinds[row.capture] = good if row is capture.frames[-1] else (*good, "dark", "no_signal")
    return kinds
