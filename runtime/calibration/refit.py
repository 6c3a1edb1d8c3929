"""The refit of a headset from its captures: camera, distance, response, wavefront and beam, in turn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from runtime.calibration.colour_captures import ColourCaptures, dot_spacing
from runtime.calibration.drift import Drift
from runtime.calibration.drift_fit import (
    ROUNDS,
    SETTLED_SHARE,
    DriftFit,
    fit,
    layout_of,
    predicted_chi_squared,
)
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.free_form_fit import ITERATIONS, fit_freeform, iterations_over, spacings
from runtime.calibration.held_out_errors import held_out_errors
from runtime.calibration.information import measured_information
from runtime.calibration.prediction import Predictor, enough_for_direction
from runtime.calibration.replacement_rule import LEAST_EXCESS, is_certain
from runtime.calibration.response import Sweep, fitted_response, measured_sweep
from runtime.calibration.shown_patterns import GRAINS
from runtime.camera.registration import dots_of, find_homography, panel_points
from runtime.camera.view import View
from runtime.excess import is_complete, removed_excess
from runtime.program.progress import Progress, part_of

ORDERS = ((4, 2), (8, 4), (12, 6))  # of wavefront and beam, one fit after the other
PIXELS = (
    1_000_000,
    1_000_000,
    8_000_000,
)  # of all colours that each of these is fitted to: two patterns at least, and one of each colour
NEARLY_SETTLED = 0.05  # share of chi squared by which all but the highest orders' last iteration lowers it
TURNS = 4  # of free-form maps, and all else around them
SCAN_MM = (
    0.0,
    *(s * d for d in (0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.5) for s in (-1, 1)),
)  # starts of the distance
SAME_PX = 6.0  # a camera that the dots put within this of the known view has not been exchanged


def start_view(
    captures: ColourCaptures, known: View | None, shape: tuple[int, int], camera: tuple[int, int]
) -> tuple[View, bool]:
    """Where the camera looks, by the dots.

    A camera of the panel's own size may be registered, and a camera may be known from an earlier calibration. Then only
    its rigid motion is taken from the dots. Its scale is the lens's and does not drift: the light makes a picture that
    is magnified. Only a camera that is turned, mirrored or scaled against that by many pixels is taken from the dots
    as a whole.

    Parameters
    ----------
    captures : ColourCaptures
        Its dots are used.
    known : View or None
        Of an earlier calibration.
    shape, camera : (int, int)
        (height, width) of the panel and of the camera, pixels.

    Returns
    -------
    View
    bool
        Whether the whole of it is new.

    Raises
    ------
    InputError
        Where the dots are not found.
    """
    start = known if known is not None and known.shape == camera else View(camera)
    found = find_homography(captures.dots.signal, dots_of(shape, dot_spacing(shape)), start.matrix(shape))
    corners = np.array(
        [[0, 0], [0, camera[0] - 1], [camera[1] - 1, 0], [camera[1] - 1, camera[0] - 1]], float
    )
    away = panel_points(found, corners) - panel_points(start.matrix(shape), corners)
    right, down = away.mean(0)
    if np.hypot(*(away - (right, down)).T).max() > SAME_PX:
        return View(camera, tuple(float(v) for v in found.ravel())), True
    down, right = start.shift_y_px + float(down), start.shift_x_px + float(right)
    return replace(start, shift_y_px=down, shift_x_px=right), False


def refit(
    bases: Mapping[str, ColourLightPath],
    captures: Mapping[str, ColourCaptures],
    view: View,
    new_view: bool,
    say: Progress,
) -> tuple[DriftFit, dict[str, Sweep]]:
    """Distance from several starts, then response and the rest in turn, with rising orders, then free-form maps.

    Parameters
    ----------
    bases, captures : mappings
        By colour.
    view : View
        To start from.
    new_view : bool
        Whether the view's homography is only as good as dots are.
    say : callable
        Called with the share done, 0 to 1, and what is done now.

    Returns
    -------
    DriftFit
    dict of str to Sweep
        The measured phase response of each colour.
    """
    shots = [shot for t in captures.values() for shot in t.fitted]
    estimate = Estimate(Drift(), view)
    first = next(iter(bases))  # the distance is that of all colours
    coarse = [captures[first].fitted[GRAINS.index(size)] for size in sorted(GRAINS)[-2:]]
    say(0.0, "distance")
    estimate = _nearest_distance({first: bases[first]}, coarse, estimate)
    parts, known = len(ORDERS) + TURNS, None
    for number, orders in enumerate(ORDERS):
        say(number / parts, "phase response")
        estimate, sweeps = _with_response(bases, captures, estimate)
        what = f"wavefront and beam to order {orders[0]}"
        progress = _part(say, number, parts, what)
        some, last = few(shots, PIXELS[number]), number == len(ORDERS) - 1
        if number == 1:  # from here on near enough to the truth for one information to serve all orders
            layout = layout_of(bases, ORDERS[-1], new_view)
            progress, measuring = part_of(progress, 0.5, 1.0), part_of(progress, 0.0, 0.5)
            known = measured_information(bases, some, layout.widened(estimate), layout, measuring)
        found = fit(
            bases, some, estimate, orders, new_view=new_view, progress=progress, information=known,
            settled_share=SETTLED_SHARE if last else NEARLY_SETTLED,
        )  # fmt: skip
        estimate = found.estimate
    estimate, sweeps = _with_response(bases, captures, estimate)
    found = replace(found, estimate=estimate)
    return _with_maps(bases, captures, found, sweeps, new_view, say)


def _nearest_distance(
    bases: Mapping[str, ColourLightPath], shots: Sequence[Shot], estimate: Estimate
) -> Estimate:
    """The estimate with that distance of `SCAN_MM` which explains the shots best."""
    predictor, costs = Predictor(bases, enough_for_direction(bases)), {}
    for mm in SCAN_MM:
        predictor.take(replace(estimate, drift=Drift(distance_mm=mm)))
        costs[mm] = predicted_chi_squared(predictor, shots)
    return replace(estimate, drift=Drift(distance_mm=min(costs, key=lambda mm: costs[mm])))


def _with_maps(
    bases: Mapping[str, ColourLightPath],
    captures: Mapping[str, ColourCaptures],
    found: DriftFit,
    sweeps: dict[str, Sweep],
    new_view: bool,
    say: Progress,
) -> tuple[DriftFit, dict[str, Sweep]]:
    """A fit with free-form maps and all else in turn, where held-out patterns certainly get better by them.

    A turn over a large panel takes a minute. It is taken only where what is left matters: an excess of 0.0003 is an
    error of a 170th of a wave where it is smooth, of a 400th where it is as rough as maps can hold. It is the last
    where it has removed next to nothing.
    """
    shots = [shot for t in captures.values() for shot in t.fitted]
    heldout = [shot for t in captures.values() for shot in t.heldout]
    before = held_out_errors(bases, heldout, found.estimate)
    cheap = iterations_over(few(shots, PIXELS[-1])) == ITERATIONS
    for turn, spacing in enumerate(spacings(next(iter(bases.values())).path.grid.shape, TURNS)):
        if not cheap and is_complete(before.errors.excess, 0.0):
            break
        progress = _part(say, len(ORDERS) + turn, len(ORDERS) + TURNS, "wavefront and beam, free-form")
        some = few(shots, PIXELS[-1], turn)
        estimate = fit_freeform(bases, some, found.estimate, progress, spacing)
        after = held_out_errors(bases, heldout, estimate)
        removed = removed_excess(before.errors, after.errors)
        # What lies in corners without light, held-out patterns do not show: where it costs little, go on for it.
        if not (cheap and turn) and not is_certain(removed):
            break
        known, rounds = (None, ROUNDS) if cheap else (found.information, 1)
        found = fit(bases, some, estimate, ORDERS[-1], 4, new_view, information=known, rounds=rounds)
        estimate, sweeps = _with_response(bases, captures, found.estimate)
        found, before = replace(found, estimate=estimate), held_out_errors(bases, heldout, estimate)
        if not cheap and removed.value < LEAST_EXCESS:
            break
    return found, sweeps


def few(shots: Sequence[Shot], pixels: int, turn: int = 0) -> list[Shot]:
    """As many shots as have a number of pixels, two at least, of each colour as many; turn after turn the next ones."""
    chosen: list[Shot] = []
    channels = list(dict.fromkeys(shot.channel for shot in shots))
    for channel in channels:
        own = [shot for shot in shots if shot.channel == channel]
        count = max(2, math.ceil(pixels / own[0].counts.size))
        count = min(math.ceil(count / len(channels)), len(own))
        chosen += [own[(turn * count + k) % len(own)] for k in range(count)]
    return chosen


def _part(say: Progress, number: int, parts: int, what: str) -> Progress:
    """Progress of one part as progress of the whole refit."""
    return part_of(say, number / parts, (number + 1) / parts, what)


def _with_response(
    bases: Mapping[str, ColourLightPath], captures: Mapping[str, ColourCaptures], estimate: Estimate
) -> tuple[Estimate, dict[str, Sweep]]:
    """The estimate with each colour's response from its sweep, all else as it is."""
    sweeps, responses = {}, dict(estimate.drift.response)
    predictor = Predictor(bases)
    predictor.take(estimate)
    for channel, base in bases.items():
        sweeps[channel] = measured_sweep(predictor, captures[channel].sweep)
        believed = np.asarray(responses.get(channel, base.path.response), np.float64)
        responses[channel] = fitted_response(believed, sweeps[channel], base.path.gray_levels)
    return replace(estimate, drift=replace(estimate.drift, response=responses)), sweeps
