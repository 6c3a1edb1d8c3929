"""Self-calibration from beginning to end: show and capture, refit, check, and give a verdict.

The sequence for each colour is dots (where the camera looks), a sweep of gratings (the phase response), ten patterns
of random grains (wavefront, beam and distance), three held-out ones, and a picture solved through the light path as
it was; then the held-out ones in the bundle's other planes, where the camera can be focused on them; after the fit, the
picture solved through the new one. Lasers are on only while pictures are taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

import numpy as np

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import Bundle
from runtime.bundle.light_path_arrays import (
    bundle_channels,
    bundle_paths,
    load_light_path,
    plane_of,
    slow_response_share,
)
from runtime.calibration.colour_captures import (
    ColourCaptures,
    colour_captures,
    colour_patterns,
    proof_pattern,
    proof_pictures,
)
from runtime.calibration.drift import Drift, drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot, gain_of
from runtime.calibration.held_out_errors import HeldOutErrors, held_out_errors
from runtime.calibration.network_refit import (
    NetworkCheck,
    checked_network,
    colour_pictures,
    learned_pictures,
)
from runtime.calibration.other_planes import (
    PlaneCheck,
    checked_plane,
    fitted_views,
    other_planes,
    plane_shots,
)
from runtime.calibration.prediction import Predictor
from runtime.calibration.refit import Progress, part_of, refit, start_view
from runtime.calibration.replacement_rule import LEAST_EXCESS, Verdict, is_certain, replacement_verdict
from runtime.calibration.response import Sweep, swept
from runtime.calibration.shown_patterns import GRAINS, HELD_OUT
from runtime.calibration.taking import Taker
from runtime.camera.view import view_of
from runtime.excess import is_complete, removed_excess
from runtime.headset.open_devices import Devices
from runtime.lightpath.overdrive import settling_periods
from runtime.networks.onnx_approximator import approximator_of
from runtime.program.progress import no_progress


@dataclass(frozen=True)
class Calibration:
    """A finished self-calibration; nothing has been written yet.

    Attributes
    ----------
    verdict : str
        As from `replacement_verdict`.
    complete : bool
        Whether what the refit leaves is too little to matter, in every plane that was checked.
    estimate : Estimate
        What was fitted.
    errors : Drift
        Standard errors of the estimate's drift.
    sweeps : mapping of str to Sweep
        The measured phase response of each colour.
    captures : mapping of str to ColourCaptures
        Of each colour.
    before, after : HeldOutErrors
        Errors on held-out captures.
    pictures : mapping of str to mapping
        For each colour the picture "before" and "after" as the camera saw it, on the panel's pixels, float32 [H, W],
        and its amplitude PSNR in dB.
    counts_per_ms : mapping of str to (float, float)
        Of each colour, counts a millisecond for irradiance 1, and the relative spread over captures.
    bases : mapping of str to ColourLightPath
        The light path of each colour as it was.
    plane_mm : float, mm
        The image plane that the camera sees.
    planes : tuple of PlaneCheck
        The bundle's other planes, checked on held-out patterns.
    planes_unchecked : tuple of float, mm
        The bundle's other planes that this camera cannot be focused on.
    network : NetworkCheck or None
        What becomes of the bundle's network D; None where it has none, or nothing is replaced.
    pictures_taken : int
        By the camera, in all, without those for which a slow panel was waited for.
    seconds : mapping of str to float, s
        "capturing" and "fitting".
    known_counts_per_ms : mapping of str to float
        What `counts_per_ms` was at the last calibration.
    camera_scale : float or None
        Where nothing is replaced, and the light path is right only if the camera's scale is off by this much, relative.
        The cause is then either the camera's scale, or defocus and distance.
    """

    verdict: Verdict
    complete: bool
    estimate: Estimate
    errors: Drift
    sweeps: Mapping[str, Sweep]
    captures: Mapping[str, ColourCaptures]
    before: HeldOutErrors
    after: HeldOutErrors
    pictures: Mapping[str, Mapping[str, tuple[np.ndarray, float]]]
    counts_per_ms: Mapping[str, tuple[float, float]]
    bases: Mapping[str, ColourLightPath]
    plane_mm: float
    planes: tuple[PlaneCheck, ...]
    planes_unchecked: tuple[float, ...]
    network: NetworkCheck | None
    pictures_taken: int
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
    """Show, capture, refit and check. The bundle is not touched; lasers are off afterwards, also after an error.

    Parameters
    ----------
    open_devices : callable
        Opens the headset for the captures, and once more for the last picture: while the fit computes, no laser is
        armed.
    bundle : Bundle
    plane_mm : float, mm, optional
        The image plane that the camera is focused on; None: the bundle's own.
    seed : int
        Which random patterns.
    progress : callable, optional
        Called with the share done, 0 to 1, and what is done now.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        Where the panel is not the bundle's, a colour has no laser, or the camera does not see what it should.
    """
    say = progress or no_progress
    channels = bundle_channels(bundle)
    bases = {
        c: ColourLightPath(load_light_path(bundle, c, plane_mm), _wavelength(bundle, c)) for c in channels
    }
    shape = next(iter(bases.values())).path.grid.shape
    plane = plane_of(bundle, channels[0], plane_mm)
    approximator = approximator_of(bundle, (len(channels), *shape))
    settling = settling_periods(slow_response_share(bundle))
    say(0.0, "solving what is to be shown")
    patterns = colour_patterns(bases, seed)
    started = time.perf_counter()
    gratings = sum(len(swept(base.path)) for base in bases.values())
    many = len(channels) * (len(GRAINS) + len(HELD_OUT) + 8) + gratings + 2

    def showing(what: str) -> None:
        say(0.25 * min(taker.taken / many, 1), f"showing: {what}")

    with open_devices() as devices, _dark_after(devices):
        _check(devices, channels, shape)
        devices.move_to_plane(plane)
        camera = tuple(devices.camera.shape)
        taker = Taker(devices, showing, settling=settling)
        black, floor = taker.darkness()
        captures = {c: colour_captures(taker, c, patterns[c], black, floor) for c in channels}
        others = other_planes(bundle, plane) if devices.focus else []
        elsewhere = {mm: plane_shots(taker, mm, patterns, captures) for mm in others}
    captured = time.perf_counter()
    view, new = start_view(captures[channels[0]], view_of(bundle), shape, camera)
    found, sweeps = refit(bases, captures, view, new, part_of(say, 0.25, 0.85, "fitting"))
    say(0.86, "checking against held-out patterns")
    heldout = [shot for one in captures.values() for shot in one.heldout]
    rigid, scaled = fitted_views(bases, heldout, found.estimate.view)
    before = held_out_errors(bases, heldout, scaled)
    after = held_out_errors(bases, heldout, found.estimate)
    wavelengths = {c: base.wavelength_nm for c, base in bases.items()}
    planes = [
        checked_plane(bundle, wavelengths, mm, shots, found.estimate) for mm, shots in elsewhere.items()
    ]
    say(0.92, "solving the picture again")
    better = {c: proof_pattern(bases[c], c, found.estimate.drift) for c in channels}
    with open_devices() as devices, _dark_after(devices):
        devices.move_to_plane(plane)
        taker = Taker(devices, lambda what: say(0.96, f"showing: {what}"), taker.taken, settling)
        pictures = {
            c: proof_pictures(taker, c, better[c], captures[c], found.estimate.view) for c in channels
        }
    verdict = replacement_verdict(before.errors, after.errors, _excess_before(bundle))
    if verdict == "recalibrated" and any(p.worse for p in planes):
        verdict = "not_explained"
    network = None
    if approximator is not None and verdict == "recalibrated":
        drift, view = found.estimate.drift, found.estimate.view
        paths = {c: drifted(base.path, c, base.wavelength_nm, drift) for c, base in bases.items()}
        shown = {"before": {c: captures[c].heldout[-1].gray for c in channels}, "after": better}
        deciding = [
            colour_pictures(paths, grays, {c: pictures[c][name][0] for c in channels})
            for name, grays in shown.items()
        ]
        learned = learned_pictures(paths, captures, view)
        network = checked_network(
            approximator, learned, deciding, part_of(say, 0.97, 1.0, "refitting the network")
        )
    done = time.perf_counter()
    everywhere = [(before.errors, after.errors), *((p.before, p.after) for p in planes)]
    return Calibration(
        verdict,
        all(is_complete(now.excess, then.excess) for then, now in everywhere),
        found.estimate,
        found.errors,
        sweeps,
        captures,
        before,
        after,
        pictures,
        {c: _power(bases[c], captures[c], found.estimate) for c in channels},
        bases,
        plane,
        tuple(planes),
        tuple(mm for mm in other_planes(bundle, plane) if mm not in elsewhere),
        network,
        taker.taken,
        {"capturing": captured - started, "fitting": done - captured},
        (bundle.description.get("camera") or {}).get("counts_per_ms") or {},
        _camera_scale(bases, heldout, rigid, scaled, before) if verdict == "unchanged" else None,
    )


def _camera_scale(
    bases: Mapping[str, ColourLightPath],
    heldout: Sequence[Shot],
    rigid: Estimate,
    scaled: Estimate,
    errors: HeldOutErrors,
) -> float | None:
    """The camera's scale (relative, less 1), where it matters to the light path as it was.

    `errors` are those of `scaled`.
    """
    removed = removed_excess(held_out_errors(bases, heldout, rigid).errors, errors.errors)
    matters = is_certain(removed) and removed.value > LEAST_EXCESS
    return scaled.view.magnification if matters else None


@contextmanager
def _dark_after(devices: Devices) -> Iterator[None]:
    """Switches the lasers off at the end, also after an error."""
    try:
        yield
    finally:
        devices.lasers.off()


def _check(devices: Devices, channels: list[str], shape: tuple[int, int]) -> None:
    """Refuse, with InputError, a headset that the bundle is not for."""
    if tuple(devices.panel.shape) != shape:
        raise InputError(
            f"the bundle is for a panel of {shape[0]} x {shape[1]} and this one has "
            f"{' x '.join(map(str, devices.panel.shape))} pixels: use the bundle of this headset"
        )
    for channel in channels:
        if channel not in devices.lasers.channels:
            raise InputError(f"the headset has no laser '{channel}', which the bundle is for: check both")


def _wavelength(bundle: Bundle, channel: str) -> float:
    """Of a colour, nm."""
    return float(next(r["wavelength_nm"] for r in bundle_paths(bundle) if r["channel"] == channel))


def _excess_before(bundle: Bundle) -> float:
    """The excess that a bundle had when it was last calibrated or exported; 0 where nothing says so."""
    done = bundle.provenance.get("calibrations") or []
    record = done[-1]["heldout"]["after"] if done else bundle.provenance.get("heldout") or {}
    return float(record.get("excess") or 0.0)


def _power(base: ColourLightPath, captures: ColourCaptures, estimate: Estimate) -> tuple[float, float]:
    """Counts a millisecond for irradiance 1 at the power used, mean over captures, and the relative spread."""
    channel = captures.fitted[0].channel
    predictor = Predictor({channel: base})
    predictor.take(estimate)
    gains = [gain_of(s, predictor.light(s)) / captures.exposure_ms for s in captures.fitted]
    return float(np.mean(gains)), float(np.std(gains) / np.mean(gains))
