"""Which captures a fit may see, and which are held out to judge it.

A fit sees some patterns; every number that is reported comes from others. All repeats of a pattern are on the same
side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture, ids_of
from trainer.captures.signal_present import with_signal

FIT_PIXELS = 4 * 240 * 320  # about four small pictures hold a few dozen parameters to far below the noise
FIT_CAPTURES = 4
PROBE_CAPTURES = 9
HELD_PIXELS = 24 * 480 * 640  # held-out pixels that a candidate is judged on


@dataclass(frozen=True)
class CaptureSplit:
    """Captures for fitting and captures held out, as a partition of the captures that show any light.

    Attributes
    ----------
    fitted, held_out : tuple of Capture
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
    left_out : dict
        By the id of each capture that is used for nothing: why, as `trainer.captures.signal_present` says.
    """

    fitted: tuple[Capture, ...]
    held_out: tuple[Capture, ...]
    is_held_out: bool = True
    left_out: dict[str, str] = field(default_factory=dict)


def split(captures: CaptureSet) -> CaptureSplit:
    """Every third pattern of each colour and plane is held out, from the second on (at least one).

    The choice depends only on the order of the captures, so every command holds out the same ones. A colour and plane
    with a single pattern is fitted. Only where every colour and plane has a single pattern, the last capture is both
    fitted and judged. Captures without light, or with nothing but saturated pixels, are in neither part.

    Raises
    ------
    InputError
        Where no capture shows any light, or all are saturated.
    """
    fitted: list[Capture] = []
    held: list[Capture] = []
    used, left_out = with_signal(captures)
    for channel, plane in scenes(used):
        rows = [c for c in used if (c.channel, c.plane_mm) == (channel, plane)]
        patterns = list(dict.fromkeys(c.pattern for c in rows))
        out = {p for k, p in enumerate(patterns) if holds_out(k)}
        for c in rows:
            (held if c.pattern in out else fitted).append(c)
    is_held_out = bool(held)
    return CaptureSplit(tuple(fitted), tuple(held or fitted[-1:]), is_held_out, left_out)


def holds_out(place: int) -> bool:
    """Whether the pattern at this place among those of its colour and plane, from 0 on, is held out."""
    return place % 3 == 1


def scenes(captures: Iterable[Capture]) -> list[tuple[str, float]]:
    """(channel, plane) pairs in order of appearance."""
    return list(dict.fromkeys((c.channel, c.plane_mm) for c in captures))


def with_stopping(rows: Sequence[Capture], most: int) -> tuple[list[Capture], list[Capture]]:
    """Captures for a descent's gradient, and one of each colour and plane that says when to stop.

    Parameters
    ----------
    rows : sequence of Capture
    most : int
        For the gradient, over all colours and planes; at least one for each.

    Returns
    -------
    list of Capture, list of Capture
        The same capture is in both only where a colour and plane has no other.
    """
    last = list({(c.channel, c.plane_mm): c for c in rows}.values())
    each = max(1, most // max(1, len(last)))
    first: list[Capture] = []
    for scene in scenes(rows):
        own = [c for c in rows if (c.channel, c.plane_mm) == scene]
        first += ([c for c in own if c not in last] or own)[:each]
    return first, last


def sample(
    captures: Iterable[Capture], pixels: int, most: int, first: Capture | None = None
) -> list[Capture]:
    """Different patterns for a fit, spread over colours and planes, each as it was captured last.

    Patterns that were captured at several exposures take turns with these: what is added to pictures grows with the
    exposure or does not, and one exposure tells neither. A repeat follows its own pattern. What a slow panel showed
    before the first capture of a set, nobody knows: that one is the last to be chosen.

    Parameters
    ----------
    captures : iterable of Capture
    pixels : int
        Of one capture; FIT_PIXELS in all are enough for each colour and plane.
    most : int
        Captures at most, but at least one for each colour and plane.
    first : Capture, optional
        Of the set.

    Returns
    -------
    list of Capture
    """
    by_scene: dict[tuple[str, float], dict[str, dict[float, Capture]]] = {}
    for c in captures:
        patterns = by_scene.setdefault((c.channel, c.plane_mm), {})
        patterns.setdefault(c.pattern, {})[c.exposure_ms] = c
    # Patterns of one kind often follow each other: spread the choice over the whole list.
    spread = [[list(each.values())[i] for i in _spread(len(each))] for each in by_scene.values()]
    columns = [[list(own.values())[k % len(own)] for k, own in enumerate(column)] for column in spread]
    columns = [sorted(column, key=lambda c: c is first) for column in columns]
    needed = max(len(columns), min(most, FIT_PIXELS * max(1, len(columns)) // max(1, pixels)))
    chosen: list[Capture] = []
    depth = 0
    while len(chosen) < needed and any(depth < len(column) for column in columns):
        chosen += [column[depth] for column in columns if depth < len(column)][: needed - len(chosen)]
        depth += 1
    return chosen


def _spread(count: int) -> list[int]:
    """0 .. count-1 in an order whose every beginning is spread over the range (bit-reversed)."""
    bits = max(1, (count - 1).bit_length())
    order = [int(format(k, f"0{bits}b")[::-1], 2) for k in range(2**bits)]
    return [k for k in order if k < count]


@dataclass(frozen=True)
class CaptureRoles:
    """Which captures a diagnosis uses for what.

    Attributes
    ----------
    captures : CaptureSet
    fitted : tuple of Capture
        For fits.
    screened : tuple of Capture
        For the screen, one of each colour and plane.
    screenable : tuple of Capture
        Those of `fitted` that may be screened in their place.
    probed : tuple of Capture
        For the probes.
    held_out : tuple of Capture
        For the judgement.
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
    """

    captures: CaptureSet
    fitted: tuple[Capture, ...]
    screened: tuple[Capture, ...]
    screenable: tuple[Capture, ...]
    probed: tuple[Capture, ...]
    held_out: tuple[Capture, ...]
    is_held_out: bool = True

    @property
    def folder(self) -> Path:
        """Folder of the capture set."""
        return self.captures.folder

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of all captures of the set, which may be a part of those in its folder."""
        return ids_of(self.captures.captures)


def capture_roles(captures: CaptureSet) -> CaptureRoles:
    """Choose captures for fits, the screen, the probes and the judgement.

    Raises
    ------
    InputError
        As `split` does.
    """
    divided = split(captures)
    height, width = captures.bench.panel.shape
    pixels = height * width
    count = len(scenes(divided.fitted))
    first = captures.captures[0]
    fitted = sample(divided.fitted, pixels, max(FIT_CAPTURES, count), first)
    # A panel that still shows the pattern before is seen only where that was another one.
    after_another = {b.capture for a, b in pairwise(captures.captures) if a.pattern != b.pattern}

    def telling(rows: Sequence[Capture]) -> Sequence[Capture]:
        found = [c for c in rows if c.capture in after_another]
        return found if len(scenes(found)) == count else rows

    screened = sample(telling(divided.fitted), pixels, count)
    probed = sample(divided.fitted, pixels // 2, max(PROBE_CAPTURES, count), first)
    most = max(2 * count, HELD_PIXELS // pixels)
    held_out = list(divided.held_out)
    if len(held_out) > most:
        held_out = held_out[:: -(-len(held_out) // most)]
    return CaptureRoles(
        captures,
        tuple(fitted),
        tuple(screened),
        tuple(telling(fitted)),
        tuple(probed),
        tuple(held_out),
        divided.is_held_out,
    )


def with_patterns(roles: CaptureRoles, fewest: int) -> CaptureRoles:
    """The roles with at least so many patterns for fits, where the set has them: of large pictures, one is the rule."""
    if len({c.pattern for c in roles.fitted}) >= fewest:
        return roles
    rows = sample(split(roles.captures).fitted, 1, fewest, roles.captures.captures[0])
    return replace(roles, fitted=tuple(rows))
