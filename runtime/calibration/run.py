"""Self-calibration from beginning to end: show and capture, refit, check, and say what came of it.

The sequence for each colour is dots (where the camera looks), a sweep of gratings (the phase response), ten patterns
of random grains (wavefront, beam and distance), three held-out ones, and a picture solved through the light path as
it was; after the fit, the picture solved through the new one. Lasers are on only while pictures are taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.errors import InputError
from runtime.bundle import Bundle
from runtime.calibrated import bundle_channels, bundle_paths, load_light_path, plane_of
from runtime.calibration.check import Heldout, complete, heldout_errors, verdict
from runtime.calibration.drift import Drift, drifted
from runtime.calibration.fit import Base, Estimate, Fitted, Shot, chi_squared, fit, gain_of, predicted
from runtime.calibration.patterns import GRAINS, HELD_OUT, grains, grating, proof_picture
from runtime.calibration.response import SWEEP, Sweep, best_period, fitted_response, measured_sweep
from runtime.calibration.taking import Noise, Taker
from runtime.calibration.view import View, on_panel, sampler, view_of
from runtime.devices import Devices
from runtime.registration import dot_pattern, dots_of, find_homography, panel_points
from runtime.solver import quality, solve

ORDERS = ((4, 2), (8, 4), (12, 6))  # of wavefront and beam, one fit after the other
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

    verdict: see `check.verdict`. estimate: what was fitted, and errors: its standard errors. sweeps: the measured
    responses. shots: captures a colour. before, after: errors on held-out captures. pictures: for each colour the
    picture as the camera saw it before and after, on the panel's pixels, float32 [H, W], with amplitude PSNR in dB.
    counts_per_ms: of each colour, and the relative spread over captures.
    """

    verdict: str
    complete: bool
    estimate: Estimate
    errors: Drift
    sweeps: Mapping[str, Sweep]
    shots: Mapping[str, Taken]
    before: Heldout
    after: Heldout
    pictures: Mapping[str, Mapping[str, tuple[np.ndarray, float]]]
    counts_per_ms: Mapping[str, tuple[float, float]]
    bases: Mapping[str, Base]
    plane_mm: float
    captures: int
    seconds: Mapping[str, float]
    known_view: View | None


def calibrate(
    devices: Devices,
    bundle: Bundle,
    plane_mm: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Show, capture, refit and check. The bundle is not touched; lasers are off afterwards, whatever happens.

    plane_mm: the image plane that the camera is focused on; none: the bundle's own. Raises InputError where the
    panel is not the bundle's, a colour has no laser, or the camera cannot see what it should.
    """
    say = progress or (lambda done, what: None)
    channels = bundle_channels(bundle)
    bases = {c: Base(load_light_path(bundle, c, plane_mm), _wavelength(bundle, c)) for c in channels}
    shape = next(iter(bases.values())).path.grid.shape
    plane = plane_of(bundle, channels[0], plane_mm)
    if tuple(devices.panel.shape) != shape:
        raise InputError(
            f"the bundle is for a panel of {shape[0]} x {shape[1]} and this one has "
            f"{' x '.join(map(str, devices.panel.shape))} pixels: use the bundle of this headset"
        )
    for channel in channels:
        if channel not in devices.lasers.channels:
            raise InputError(f"the headset has no laser '{channel}', which the bundle is for: check both")
    devices.move_to_plane(plane)
    started = time.perf_counter()
    many = len(channels) * (len(GRAINS) + len(HELD_OUT) + len(SWEEP) + 6) + 1
    taker = Taker(devices, lambda what: say(0.25 * min(taker.taken / many, 1), f"showing: {what}"))
    try:
        black, floor = taker.darkness()
        taken = {c: _taken(taker, c, bases[c], black, floor, seed) for c in channels}
        devices.lasers.off()
        captured = time.perf_counter()
        known = view_of(bundle)
        view = _start_view(taken[channels[0]], known, shape, tuple(devices.camera.shape))
        found, sweeps = _refit(bases, taken, view, lambda d, w: say(0.25 + 0.6 * d, f"fitting: {w}"))
        say(0.86, "checking against held-out patterns")
        heldout = [shot for t in taken.values() for shot in t.heldout]
        as_it_was = fit(bases, heldout, Estimate(Drift(), found.estimate.view), (0, 0)).estimate
        before, after = (heldout_errors(bases, heldout, e) for e in (as_it_was, found.estimate))
        pictures = {}
        for channel in channels:
            say(0.92, f"showing the picture again: {channel}")
            pictures[channel] = _pictures(taker, channel, bases[channel], taken[channel], found.estimate)
    finally:
        devices.lasers.off()
    done = time.perf_counter()
    return Calibration(
        verdict(before, after),
        complete(before, after),
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
        known,
    )


def _wavelength(bundle: Bundle, channel: str) -> float:
    return float(next(r["wavelength_nm"] for r in bundle_paths(bundle) if r["channel"] == channel))


def _taken(taker: Taker, channel: str, base: Base, black: float, floor: float, seed: int) -> Taken:
    """Every capture of one colour, with the light path as it was."""
    path, shape = base.path, base.path.grid.shape
    dots = solve(path, np.maximum(dot_pattern(shape, _spacing(shape)), 1e-3), SOLVING).gray
    picture = solve(path, proof_picture(shape), SOLVING).gray
    still = Estimate(Drift(), View(shape))
    period = best_period(base, channel, still, sampler(still.view, path.grid, 1))
    taker.light(channel)
    first = grains(shape, GRAINS[0], seed)
    exposure = taker.expose(first, black)
    noise = taker.noise(first, black, floor)
    gratings = [grating(shape, period, g) for g in SWEEP]
    learned = [grains(shape, size, seed + k) for k, size in enumerate(GRAINS)]
    kept = [grains(shape, size, seed + 1000 + k) for k, size in enumerate(HELD_OUT)] + [picture]
    result = Taken(
        taker.shot(channel, dots, noise, f"{channel}, dots"),
        taker.shots(channel, gratings, noise, f"{channel}, grating"),
        taker.shots(channel, learned, noise, f"{channel}, pattern"),
        taker.shots(channel, kept, noise, f"{channel}, held-out pattern"),
        exposure,
        noise,
    )
    taker.devices.lasers.off()
    return result


def _spacing(shape: tuple[int, int]) -> float:
    """Of the dots, panel pixels: six or seven along the shorter side."""
    return min(max(16.0, min(shape) / 7), min(shape) / 4.5)


def _start_view(taken: Taken, known: View | None, shape: tuple[int, int], camera: tuple[int, int]) -> View:
    """Where the camera looks, by the dots.

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
        return View(camera, tuple(float(v) for v in found.ravel()))
    return replace(
        start, shift_y_px=start.shift_y_px + float(down), shift_x_px=start.shift_x_px + float(right)
    )


def _refit(
    bases: Mapping[str, Base], taken: Mapping[str, Taken], view: View, say: Progress
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
    for number, orders in enumerate(ORDERS):
        begin, part = number / len(ORDERS), 1 / len(ORDERS)
        say(begin, "phase response")
        estimate, sweeps = _with_response(bases, taken, estimate)
        found = fit(
            bases,
            shots,
            estimate,
            orders,
            progress=lambda d, b=begin, p=part, o=orders: say(
                b + p * d, f"wavefront and beam to order {o[0]}"
            ),  # type: ignore[misc]
        )
        estimate = found.estimate
    estimate, sweeps = _with_response(bases, taken, estimate)
    return replace(found, estimate=estimate), sweeps


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
    taker: Taker, channel: str, base: Base, taken: Taken, estimate: Estimate
) -> dict[str, tuple[np.ndarray, float]]:
    """The test picture before and after, as the camera saw it on the panel's pixels, with its PSNR in dB."""
    target = proof_picture(base.path.grid.shape)
    path = drifted(base.path, channel, base.wavelength_nm, estimate.drift)
    gray = solve(path, target, SOLVING).gray
    taker.light(channel)
    taker.devices.camera.exposure_ms = taken.exposure_ms
    after = taker.shot(channel, gray, taken.noise, f"{channel}, picture")
    taker.devices.lasers.off()
    seen = {}
    for name, shot in (("before", taken.heldout[-1]), ("after", after)):
        light = on_panel(shot.signal, estimate.view, base.path.grid.shape)
        edge = tuple(slice(n // 16, n - n // 16) for n in light.shape)
        seen[name] = (light, quality(np.maximum(light[edge], 0), target[edge]).psnr_db)
    return seen


def _power(base: Base, taken: Taken, estimate: Estimate) -> tuple[float, float]:
    """Counts a millisecond for irradiance 1 at the power used, mean over captures, and the relative spread."""
    sample = sampler(estimate.view, base.path.grid)
    gains = [gain_of(s, predicted(base, s, estimate, sample)) / taken.exposure_ms for s in taken.fitted]
    return float(np.mean(gains)), float(np.std(gains) / np.mean(gains))
