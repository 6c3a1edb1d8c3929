"""Self-calibration from beginning to end: show and capture, refit, check, and say what came of it.

The sequence for each colour is dots (where the camera looks), a sweep of gratings (the phase response), ten patterns
of random grains (wavefront, beam and distance), three held-out ones, and a picture solved through the light path as
it was; after the fit, the picture solved through the new one. Lasers are on only while pictures are taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import Bundle
from runtime.bundle.light_path_arrays import bundle_channels, bundle_paths, load_light_path, plane_of
from runtime.calibration.drift import Drift, drifted
from runtime.calibration.drift_fit import Base, Estimate, Fitted, Shot, chi_squared, fit, gain_of, predicted
from runtime.calibration.free_form_fit import fit_freeform
from runtime.calibration.held_out_errors import HeldOutErrors, held_out_errors
from runtime.calibration.replacement_rule import LEAST_EXCESS, is_certain, replacement_verdict
from runtime.calibration.response import SWEEP, Sweep, best_period, fitted_response, measured_sweep
from runtime.calibration.shown_patterns import GRAINS, HELD_OUT, grains, grating, proof_picture
from runtime.calibration.taking import Noise, Taker
from runtime.camera.registration import dot_pattern, dots_of, find_homography, panel_points
from runtime.camera.view import View, on_panel, sampler, view_of
from runtime.excess import is_complete, removed_excess
from runtime.headset.open_devices import Devices
from runtime.solver import quality, solve

ORDERS = ((4, 2), (8, 4), (12, 6))  # of wavefront and beam, one fit after the other
TURNS = 4  # of free-form maps, and all else around them
SCAN_MM = (
    0.0,
    *(s * d for d in (0.1, 0.2, 0.35, 0.6, 1.0, 1.6, 2.5) for s in (-1, 1)),
)  # starts of the distance
SAME_PX = 6.0  # a camera that the dots put within this of the view that was known has not been exchanged
SOLVING = 30  # iterations a picture

Progress = Callable[[float, str], None]


@dataclass
class Taken:
    """What was captured of one colour."""

    dots: Shot
    sweep: list[Shot]
    fitted: list[Shot]
    heldout: list[Shot]
    exposure_ms: float
    noise: Noise


@dataclass(frozen=True)
class Calibration:
    """A finished self-calibration; nothing has been written yet.

    verdict: see `replacement_rule`. estimate: what was fitted, and errors: its standard errors. sweeps: the measured
    responses. shots: captures a colour. before, after: errors on held-out captures. pictures: for each colour the
    picture as the camera saw it before and after, on the panel's pixels, float32 [H, W], with amplitude PSNR in dB.
    counts_per_ms: of each colour, and the relative spread over captures; known_counts_per_ms: what it was at the last
    calibration. camera_scale: where nothing is replaced and only a camera whose scale is off by this much, relative,
    makes the light path right: that, or defocus and distance.
    """

    verdict: str
    complete: bool
    estimate: Estimate
    errors: Drift
    sweeps: Mapping[str, Sweep]
    shots: Mapping[str, Taken]
    before: HeldOutErrors
    after: HeldOutErrors
    pictures: Mapping[str, Mapping[str, tuple[np.ndarray, float]]]
    counts_per_ms: Mapping[str, tuple[float, float]]
    bases: Mapping[str, Base]
    plane_mm: float
    captures: int
    seconds: Mapping[str, float]
    known_counts_per_ms: Mapping[str, float]
    camera_scale: float | None


def calibrate(
    open_devices: Callable[[], AbstractContextManager[Devices]],
    bundle: Bundle,
    plane_mm: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Show, capture, refit and check. The bundle is not touched; lasers are off afterwards, whatever happens.

    open_devices: opens the headset for the captures, and once more for the last picture: while the fit computes, no
    laser is armed. plane_mm: the image plane that the camera is focused on; none: the bundle's own. Raises InputError
    where the panel is not the bundle's, a colour has no laser, or the camera cannot see what it should.
    """
    say = progress or (lambda done, what: None)
    channels = bundle_channels(bundle)
    bases = {c: Base(load_light_path(bundle, c, plane_mm), _wavelength(bundle, c)) for c in channels}
    shape = next(iter(bases.values())).path.grid.shape
    plane = plane_of(bundle, channels[0], plane_mm)
    say(0.0, "solving what is to be shown")
    plans = {c: _planned(c, bases[c], seed) for c in channels}
    started = time.perf_counter()
    many = len(channels) * (len(GRAINS) + len(HELD_OUT) + len(SWEEP) + 8) + 2

    def showing(what: str) -> None:
        say(0.25 * min(taker.taken / many, 1), f"showing: {what}")

    with open_devices() as devices, _dark_after(devices):
        _check(devices, channels, shape)
        devices.move_to_plane(plane)
        camera = tuple(devices.camera.shape)
        taker = Taker(devices, showing)
        black, floor = taker.darkness()
        taken = {c: _taken(taker, c, plans[c], black, floor) for c in channels}
    captured = time.perf_counter()
    view, new = _start_view(taken[channels[0]], view_of(bundle), shape, camera)
    found, sweeps = _refit(bases, taken, view, new, lambda d, w: say(0.25 + 0.6 * d, f"fitting: {w}"))
    say(0.86, "checking against held-out patterns")
    heldout = [shot for t in taken.values() for shot in t.heldout]
    before, scale = _as_it_was(bases, heldout, found.estimate.view)
    after = held_out_errors(bases, heldout, found.estimate)
    say(0.92, "solving the picture again")
    better = {c: _solved(bases[c], c, found.estimate.drift) for c in channels}
    with open_devices() as devices, _dark_after(devices):
        devices.move_to_plane(plane)
        taker = Taker(devices, lambda what: say(0.96, f"showing: {what}"), taker.taken)
        pictures = {c: _pictures(taker, c, better[c], taken[c], found.estimate.view) for c in channels}
    done = time.perf_counter()
    verdict = replacement_verdict(before.errors, after.errors, _excess_before(bundle))
    return Calibration(
        verdict,
        is_complete(after.errors.excess, before.errors.excess),
        found.estimate,
        found.errors,
        sweeps,
        taken,
        before,
        after,
        pictures,
        {c: _power(bases[c], taken[c], found.estimate) for c in channels},
        bases,
        plane,
        taker.taken,
        {"capturing": captured - started, "fitting": done - captured},
        (bundle.description.get("camera") or {}).get("counts_per_ms") or {},
        scale if verdict == "unchanged" else None,
    )


def _as_it_was(
    bases: Mapping[str, Base], heldout: list[Shot], view: View
) -> tuple[HeldOutErrors, float | None]:
    """How well the light path predicts as it was, and the camera's scale if that matters to it.

    At one plane defocus and distance together do what a camera of another scale does: not one pattern tells them
    apart (the rays' matrices are the same). So the camera's scale is the old light path's to choose, and a refit must
    be better than that before it replaces anything.
    """
    start = Estimate(Drift(), view)
    rigid, scaled = (fit(bases, heldout, start, (0, 0), new_view=new).estimate for new in (False, True))
    errors = held_out_errors(bases, heldout, scaled)
    removed = removed_excess(held_out_errors(bases, heldout, rigid).errors, errors.errors)
    matters = is_certain(removed) and removed.value > LEAST_EXCESS
    return errors, scaled.view.magnification if matters else None


@contextmanager
def _dark_after(devices: Devices) -> Iterator[None]:
    try:
        yield
    finally:
        devices.lasers.off()


def _check(devices: Devices, channels: list[str], shape: tuple[int, int]) -> None:
    """Raises InputError where the headset is not the one that the bundle is for."""
    if tuple(devices.panel.shape) != shape:
        raise InputError(
            f"the bundle is for a panel of {shape[0]} x {shape[1]} and this one has "
            f"{' x '.join(map(str, devices.panel.shape))} pixels: use the bundle of this headset"
        )
    for channel in channels:
        if channel not in devices.lasers.channels:
            raise InputError(f"the headset has no laser '{channel}', which the bundle is for: check both")


def _wavelength(bundle: Bundle, channel: str) -> float:
    return float(next(r["wavelength_nm"] for r in bundle_paths(bundle) if r["channel"] == channel))


def _excess_before(bundle: Bundle) -> float:
    """The excess that a bundle had when it was last calibrated or exported; 0 where nothing says so."""
    done = bundle.provenance.get("calibrations") or []
    record = done[-1]["heldout"]["after"] if done else bundle.provenance.get("heldout") or {}
    return float(record.get("excess") or 0.0)


@dataclass(frozen=True)
class _Plan:
    """The patterns of one colour, uint8 [H, W] each."""

    dots: np.ndarray
    gratings: list[np.ndarray]
    fitted: list[np.ndarray]
    heldout: list[np.ndarray]


def _planned(channel: str, base: Base, seed: int) -> _Plan:
    """What is shown of one colour, with the light path as it was."""
    path, shape = base.path, base.path.grid.shape
    still = Estimate(Drift(), View(shape))
    period = best_period(base, channel, still, sampler(still.view, path.grid, 1))
    kept = [grains(shape, size, seed + 1000 + k) for k, size in enumerate(HELD_OUT)]
    return _Plan(
        solve(path, np.maximum(dot_pattern(shape, _spacing(shape)), 1e-3), SOLVING).gray,
        [grating(shape, period, g) for g in SWEEP],
        [grains(shape, size, seed + k) for k, size in enumerate(GRAINS)],
        [*kept, _solved(base, channel, Drift())],
    )


def _solved(base: Base, channel: str, drift: Drift) -> np.ndarray:
    """The pattern of the test picture through a drifted light path, uint8 [H, W]."""
    path = drifted(base.path, channel, base.wavelength_nm, drift)
    return solve(path, proof_picture(path.grid.shape), SOLVING).gray


def _taken(taker: Taker, channel: str, plan: _Plan, black: float, floor: float) -> Taken:
    """Every capture of one colour."""
    taker.light(channel)
    exposure = taker.expose(plan.fitted[0], black)
    noise = taker.noise(plan.fitted[0], black, floor)
    return Taken(
        taker.shot(channel, plan.dots, noise, f"{channel}, dots"),
        taker.shots(channel, plan.gratings, noise, f"{channel}, grating"),
        taker.shots(channel, plan.fitted, noise, f"{channel}, pattern"),
        taker.shots(channel, plan.heldout, noise, f"{channel}, held-out pattern"),
        exposure,
        noise,
    )


def _spacing(shape: tuple[int, int]) -> float:
    """Of the dots, panel pixels: six or seven along the shorter side."""
    return min(max(16.0, min(shape) / 7), min(shape) / 4.5)


def _start_view(
    taken: Taken, known: View | None, shape: tuple[int, int], camera: tuple[int, int]
) -> tuple[View, bool]:
    """Where the camera looks, by the dots; and whether all of that is new.

    A camera of the panel's own size may be registered: then only its rigid motion is looked for, and so it is with
    a view that was known. Its scale is the lens's and does not drift; a magnified picture is the light's doing. Only
    a camera that is turned, mirrored or scaled against that by many pixels is taken from the dots as a whole.
    """
    start = known if known is not None and known.shape == camera else View(camera)
    found = find_homography(taken.dots.signal, dots_of(shape, _spacing(shape)), start.matrix(shape))
    corners = np.array(
        [[0, 0], [0, camera[0] - 1], [camera[1] - 1, 0], [camera[1] - 1, camera[0] - 1]], float
    )
    away = panel_points(found, corners) - panel_points(start.matrix(shape), corners)
    right, down = away.mean(0)
    if np.hypot(*(away - (right, down)).T).max() > SAME_PX:
        return View(camera, tuple(float(v) for v in found.ravel())), True
    down, right = start.shift_y_px + float(down), start.shift_x_px + float(right)
    return replace(start, shift_y_px=down, shift_x_px=right), False


def _refit(
    bases: Mapping[str, Base], taken: Mapping[str, Taken], view: View, new: bool, say: Progress
) -> tuple[Fitted, dict[str, Sweep]]:
    """Distance from several starts, then response and the rest in turn, with rising orders."""
    shots = [shot for t in taken.values() for shot in t.fitted]
    estimate = Estimate(Drift(), view)
    coarse = [t.fitted[GRAINS.index(size)] for t in taken.values() for size in sorted(GRAINS)[-2:]]
    say(0.0, "distance")
    costs = {
        mm: chi_squared(bases, coarse, replace(estimate, drift=Drift(distance_mm=mm)), 1) for mm in SCAN_MM
    }
    estimate = replace(estimate, drift=Drift(distance_mm=min(costs, key=lambda mm: costs[mm])))
    parts = len(ORDERS) + TURNS
    for number, orders in enumerate(ORDERS):
        say(number / parts, "phase response")
        estimate, sweeps = _with_response(bases, taken, estimate)
        what = f"wavefront and beam to order {orders[0]}"
        told = _part(say, number, parts, what)
        found = fit(bases, shots, estimate, orders, new_view=new, progress=told)
        estimate = found.estimate
    estimate, sweeps = _with_response(bases, taken, estimate)
    found = replace(found, estimate=estimate)
    return _with_maps(bases, taken, found, sweeps, new, say)


def _with_maps(
    bases: Mapping[str, Base],
    taken: Mapping[str, Taken],
    found: Fitted,
    sweeps: dict[str, Sweep],
    new: bool,
    say: Progress,
) -> tuple[Fitted, dict[str, Sweep]]:
    """A fit with free-form maps and all else in turn, where held-out patterns surely say that maps pay."""
    shots = [shot for t in taken.values() for shot in t.fitted]
    heldout = [shot for t in taken.values() for shot in t.heldout]
    before = held_out_errors(bases, heldout, found.estimate)
    for turn in range(TURNS):
        told = _part(say, len(ORDERS) + turn, len(ORDERS) + TURNS, "wavefront and beam, free-form")
        estimate = fit_freeform(bases, shots, found.estimate, told)
        removed = removed_excess(before.errors, held_out_errors(bases, heldout, estimate).errors)
        if turn == 0 and not is_certain(removed):
            break
        found = fit(bases, shots, estimate, ORDERS[-1], iterations=2, new_view=new)
        estimate, sweeps = _with_response(bases, taken, found.estimate)
        found = replace(found, estimate=estimate)
    return found, sweeps


def _part(say: Progress, number: int, parts: int, what: str) -> Callable[[float], None]:
    return lambda done: say((number + done) / parts, what)


def _with_response(
    bases: Mapping[str, Base], taken: Mapping[str, Taken], estimate: Estimate
) -> tuple[Estimate, dict[str, Sweep]]:
    """The estimate with each colour's response from its sweep, all else as it is."""
    sweeps, responses = {}, dict(estimate.drift.response)
    for channel, base in bases.items():
        sample = sampler(estimate.view, base.path.grid)
        sweeps[channel] = measured_sweep(base, taken[channel].sweep, estimate, sample)
        believed = np.asarray(responses.get(channel, base.path.response), np.float64)
        responses[channel] = fitted_response(believed, sweeps[channel])
    return replace(estimate, drift=replace(estimate.drift, response=responses)), sweeps


def _pictures(
    taker: Taker, channel: str, gray: np.ndarray, taken: Taken, view: View
) -> dict[str, tuple[np.ndarray, float]]:
    """The test picture before and after, as the camera saw it on the panel's pixels, with its PSNR in dB.

    gray: the pattern after; the one before is the last of the held-out ones.
    """
    taker.light(channel)
    taker.devices.camera.exposure_ms = taken.exposure_ms
    after = taker.shot(channel, gray, taken.noise, f"{channel}, picture")
    target = proof_picture(gray.shape)
    inside = tuple(slice(n // 16, n - n // 16) for n in gray.shape)
    seen = {}
    for name, shot in (("before", taken.heldout[-1]), ("after", after)):
        light = on_panel(shot.signal, view, gray.shape)
        seen[name] = (light, quality(np.maximum(light[inside], 0), target[inside]).psnr_db)
    return seen


def _power(base: Base, taken: Taken, estimate: Estimate) -> tuple[float, float]:
    """Counts a millisecond for irradiance 1 at the power used, mean over captures, and the relative spread."""
    sample = sampler(estimate.view, base.path.grid)
    gains = [gain_of(s, predicted(base, s, estimate, sample)) / taken.exposure_ms for s in taken.fitted]
    return float(np.mean(gains)), float(np.std(gains) / np.mean(gains))
