"""Motion in a video by blocks: what moves as the whole picture does, what moves by itself, and what is new."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.solver.array_backend import Backend
from runtime.solver.video_motion import is_cut, motion_between

Array = Any

BLOCK = 16  # pixels: side of the blocks that move together
STEP = 2  # pixels: of the blocks' errors
WINDOW = (64, 128)  # pixels, of small and large pictures: side of the windows in which a motion is looked for
WINDOWS = 8  # at most, those that differ most
MOTIONS = 3  # at most, beside that of the whole picture
WRONG = 0.1  # of the picture's variance: a block with more error does not move like that
BETTER = 0.005  # of the picture's variance: so much less error, and a block moves by itself


@dataclass(frozen=True)
class Part:
    """A part of a picture that does not move as the whole does.

    Attributes
    ----------
    rows, columns : slice, pixels
    motion : (int, int) or None, pixels
        Down, right; None: its content is new.
    """

    rows: slice
    columns: slice
    motion: tuple[int, int] | None


@dataclass(frozen=True)
class Change:
    """What has become of a picture in the next one.

    Attributes
    ----------
    motion : (int, int), pixels
        Of most of it: down, right.
    parts : list of Part
        What moves otherwise, and what is new.
    cut : bool
        Whether it is another scene.
    """

    motion: tuple[int, int]
    parts: list[Part]
    cut: bool


def change_between(before: Array, after: Array, on: Backend, motion: tuple[int, int] | None = None) -> Change:
    """What has become of a picture [H, W] in the next one; `motion` is that of the whole, where it is known."""
    whole = motion_between(before, after) if motion is None else motion
    motion, parts = block_motions(before, after, whole, on)
    return Change(motion, parts, is_cut(before, after, motion))


def block_motions(
    before: Array, after: Array, motion: tuple[int, int], on: Backend
) -> tuple[tuple[int, int], list[Part]]:
    """How the content of a picture has moved, block by block.

    Candidates are the motion of the whole, standing still, and the motions found by phase correlation in windows where
    neither fits. Each block takes the one that makes it most like the picture before.

    Parameters
    ----------
    before, after : float array [H, W]
    motion : (int, int), pixels
        Of the whole picture, down and right, as from `motion_between`.
    on : Backend
        Where the pictures are.

    Returns
    -------
    ((int, int), list of Part)
        The motion of most of the picture, and the parts that move otherwise.
    """
    contrast = max(float(after[::STEP, ::STEP].var()), 1e-30)
    candidates, errors = [motion], [_block_errors(before, after, motion, on) / contrast]
    if not (_known(errors[0]) > WRONG).any():
        return motion, []
    for candidate in (0, 0), *_window_motions(before, after, errors[0] > WRONG):
        if candidate not in candidates and len(candidates) < MOTIONS + 2:
            candidates.append(candidate)
            errors.append(_block_errors(before, after, candidate, on) / contrast)
    # among blocks that do not fit at all, how little they fit says nothing about where most of the picture goes
    whole = int(np.argmin([np.minimum(e, WRONG).sum() for e in errors]))
    order = [whole, *(k for k in range(len(candidates)) if k != whole)]
    stack = np.stack([errors[k] for k in order])
    stack[0] = _known(stack[0])  # what comes in over the panel's edge gets its start there anyway
    choice = stack.argmin(0)
    choice[stack[0] <= stack.min(0) + BETTER] = 0
    choice[stack.min(0) > WRONG] = len(order)
    motions = [candidates[k] for k in order]
    return motions[0], _parts(choice, motions, after.shape)


def follow(phase: Array, found: Array, fresh: Array, part: Part, whole: tuple[int, int]) -> None:
    """Fill a part of a phase [H, W] with a fresh start, and add what was found before if that fits its chequerboard.

    The start's chequerboard has moved as the whole picture (down, right), so it fits what has moved by an even number
    beside that.
    """
    to = (part.rows, part.columns)
    phase[to] = fresh[to]
    if part.motion is None or (sum(part.motion) - sum(whole)) % 2:
        return
    spans = []
    for span, step, count in zip(to, part.motion, phase.shape, strict=True):
        first, last = max(span.start, step, 0), min(span.stop, count + min(step, 0))
        if first >= last:
            return
        spans.append((slice(first, last), slice(first - step, last - step)))
    (rows, from_rows), (columns, from_columns) = spans
    phase[rows, columns] += found[from_rows, from_columns]


def _block_errors(before: Array, after: Array, motion: tuple[int, int], on: Backend) -> np.ndarray:
    """Mean squared difference of each block to the picture before, moved; infinite where nothing comes from there."""
    # Samples of a block's side: every STEP-th pixel from the first that the motion leaves.
    side = BLOCK // STEP
    here, there, counts, samples = [], [], [], []
    for step, size in zip(motion, after.shape, strict=True):
        first, last = (min(max(n, 0), size) for n in (step, size + step))
        here.append(slice(first, last, STEP))
        there.append(slice(first - step, last - step, STEP))
        blocks = -(-size // BLOCK)
        samples.append(slice(first // STEP, first // STEP + len(range(first, last, STEP))))
        counts.append(np.bincount(np.arange(samples[-1].start, samples[-1].stop) // side, minlength=blocks))
    rows, columns = map(len, counts)
    squares = on.xp.zeros((rows * side, columns * side), before.dtype)
    on.xp.subtract(after[tuple(here)], before[tuple(there)], out=squares[tuple(samples)])
    squares *= squares
    sums = squares.reshape(rows, side, -1).sum(1).reshape(rows, columns, side).sum(-1)
    pixels = np.outer(*counts)
    return np.where(pixels > 0, on.to_host(sums) / np.maximum(pixels, 1), np.inf)


def _known(errors: np.ndarray) -> np.ndarray:
    """Errors with 0 where nothing is known."""
    return np.where(np.isinf(errors), 0, errors)


def _window_motions(before: Array, after: Array, wrong: np.ndarray) -> list[tuple[int, int]]:
    """Motions in the windows with most blocks that no candidate explains, the most frequent first."""
    pixels = int(np.clip(min(before.shape) // 8, *WINDOW))
    side = pixels // BLOCK
    places = []
    for row in range(0, max(wrong.shape[0] - side, 0) + 1, side // 2):
        for column in range(0, max(wrong.shape[1] - side, 0) + 1, side // 2):
            share = float(wrong[row : row + side, column : column + side].mean())
            if share > WRONG:
                places.append((share, row * BLOCK, column * BLOCK))
    votes: dict[tuple[int, int], int] = {}
    for _, row, column in sorted(places, reverse=True)[:WINDOWS]:
        window = (slice(row, row + pixels), slice(column, column + pixels))
        found = _nearest(before[window], after[window], motion_between(before[window], after[window]))
        votes[found] = votes.get(found, 0) + 1
    return sorted(votes, key=lambda m: -votes[m])


def _nearest(before: Array, after: Array, motion: tuple[int, int]) -> tuple[int, int]:
    """The motion of least difference among this one and its neighbours: a window's taper pulls the peak to 0."""
    best, least = motion, np.inf
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            tried = (motion[0] + down, motion[1] + right)
            (rows, from_rows), (columns, from_columns) = (
                (slice(max(m, 0), n + min(m, 0)), slice(max(-m, 0), n - max(m, 0)))
                for m, n in zip(tried, after.shape, strict=True)
            )
            error = float(((after[rows, columns] - before[from_rows, from_columns]) ** 2).mean())
            if error < least:
                best, least = tried, error
    return best


def _parts(choice: np.ndarray, motions: list[tuple[int, int]], shape: tuple[int, ...]) -> list[Part]:
    """Blocks in a row with one choice, as one part; the first choice is that of the whole picture."""
    parts = []
    for row, choices in enumerate(choice):
        rows = slice(row * BLOCK, min((row + 1) * BLOCK, shape[0]))
        ends = np.flatnonzero(np.diff(choices)) + 1
        for first, last in zip([0, *ends], [*ends, len(choices)], strict=True):
            if chosen := int(choices[first]):
                columns = slice(int(first) * BLOCK, min(int(last) * BLOCK, shape[1]))
                parts.append(Part(rows, columns, motions[chosen] if chosen < len(motions) else None))
    return parts
