"""A self-calibration in numbers: what `calibrate --json` prints and a bundle remembers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.calibration.drift import LOWEST_AMPLITUDE, LOWEST_WAVEFRONT, Drift
from runtime.calibration.estimate import ColourLightPath
from runtime.calibration.self_calibration import Calibration
from runtime.calibration.shown_patterns import GRAINS, HELD_OUT
from runtime.excess import PredictionErrors, removed_excess
from runtime.lightpath.legendre import edge_to_edge, legendre_curve, legendre_order, legendre_products


def numbers(found: Calibration) -> dict[str, Any]:
    """What was found, as numbers.

    Returns
    -------
    dict
        Keys `verdict`, `complete`, `heldout`, `wavefront`, `distance_mm`, `registration`, `camera_scale`, `channels`,
        `plane_mm`, `planes`, `planes_unchecked`, `network`, `patterns`, `captures` and `seconds` of `calibrate --json`.
        `captures` counts all pictures taken.
    """
    drift, view = found.estimate.drift, found.estimate.view
    shape = next(iter(found.bases.values())).path.grid.shape
    wavefront = drift.wavefront(shape)
    shortest = min(b.wavelength_nm for b in found.bases.values())
    colours = {}
    for channel, base in found.bases.items():
        sweep, was, now = found.sweeps[channel], base.path.response, drift.response[channel]
        counts, spread = found.counts_per_ms[channel]
        known = found.known_counts_per_ms.get(channel)
        terms = np.asarray(drift.log_amplitude[channel])
        beam = drift.amplitude(channel, shape)
        last = base.path.gray_levels[-1] if base.path.gray_levels else -1
        colours[channel] = {
            "wavelength_nm": base.wavelength_nm,
            "illumination_rms": float(np.log(beam).std()),
            "illumination_error": _rms_error(found.errors.log_amplitude[channel], shape, LOWEST_AMPLITUDE),
            "illumination_terms": [float(v) for v in terms],
            **_laser(drift, channel, base),
            "response_change_rad": float(np.abs((now - now[0]) - (was - was[0])).max()),
            "response_gain": float((now[last] - now[0]) / (was[last] - was[0])),
            "response_error_rad": float(np.median(sweep.error)),
            "grating_visibility": float(np.median(sweep.visibility)),
            "counts_per_ms": counts,
            "power_change": counts / known - 1 if known else None,
            "power_spread": spread,
            "exposure_ms": found.captures[channel].exposure_ms,
            "picture_psnr_db": {name: psnr for name, (_, psnr) in found.pictures[channel].items()},
        }
    return {
        "verdict": found.verdict,
        "complete": found.complete,
        "heldout": _heldout(found.before.errors, found.after.errors),
        "wavefront": {
            "rms_nm": float(wavefront.std()),
            "peak_to_valley_nm": float(np.ptp(wavefront)),
            "error_rms_nm": _rms_error(found.errors.wavefront_nm, shape, LOWEST_WAVEFRONT),
            "rms_waves": float(wavefront.std()) / shortest,
            "terms_nm": [float(v) for v in drift.wavefront_nm],
            "free_form": {
                "nodes": list(drift.wavefront_nodes_nm.shape) if drift.wavefront_nodes_nm.size else None,
                "rms_nm": float(replace(drift, wavefront_nm=np.zeros(0)).wavefront(shape).std()),
            },
        },
        "distance_mm": {"value": drift.distance_mm, "error": found.errors.distance_mm},
        "registration": view.as_json(),
        "camera_scale": found.camera_scale,
        "channels": colours,
        "plane_mm": found.plane_mm,
        "planes": [
            {"plane_mm": p.plane_mm, "heldout": _heldout(p.before, p.after), "worse": p.worse}
            for p in found.planes
        ],
        "planes_unchecked": list(found.planes_unchecked),
        "network": found.network and {"outcome": found.network.outcome, "errors": dict(found.network.errors)},
        "patterns": {
            "fitted": len(GRAINS),
            "gratings": max(len(sweep.gray) for sweep in found.sweeps.values()),
            "held_out": len(HELD_OUT) + 1,
            "dots": 1,
        },
        "captures": found.pictures_taken,
        "seconds": {name: round(value, 2) for name, value in found.seconds.items()},
    }


def sentence_of(found: dict[str, Any], replaced: bool) -> str:
    """The verdict in plain words.

    Parameters
    ----------
    found : dict
        As from `numbers`.
    replaced : bool
        Whether the bundle was replaced.
    """
    before, after = found["heldout"]["before"]["excess"], found["heldout"]["after"]["excess"]
    if found["verdict"] == "unchanged" and found["camera_scale"] is not None:
        return (
            f"It is not certain that anything has drifted (excess {before:.2g} on held-out patterns): the camera's "
            f"scale is off by {found['camera_scale']:+.5f}, or defocus and distance have drifted as below, which at "
            "one plane looks the same; nothing was replaced. To know, register the camera again."
        )
    if found["verdict"] == "unchanged":
        return (
            f"Nothing has drifted that the camera can see: the excess on held-out patterns is {before:.2g}."
        )
    if worse := [plane for plane in found["planes"] if plane["worse"]]:
        plane, errors = worse[0]["plane_mm"], worse[0]["heldout"]
        return (
            f"What was found in the plane at {found['plane_mm']:g} mm (excess from {before:.2g} to {after:.2g}) is "
            f"wrong in the one at {plane:g} mm (from {errors['before']['excess']:.2g} to "
            f"{errors['after']['excess']:.2g}): planes or the camera's focus are not where they should be; take "
            "captures of both planes and run hololoop-trainer diagnose; nothing was replaced."
        )
    if found["verdict"] == "not_explained":
        return (
            f"The light path does not fit (excess {before:.2g} on held-out patterns) and refitting what drifts does "
            f"not correct it ({after:.2g}): take captures and run hololoop-trainer diagnose; nothing was replaced."
        )
    if found["planes_unchecked"]:
        seen = ", ".join(f"{mm:g} mm" for mm in found["planes_unchecked"])
        after_planes = f" Not checked, as the camera's focus is fixed: {seen}."
    else:
        after_planes = ""
    done = "it was replaced" if replaced else "nothing was replaced, as asked"
    more = (
        ""
        if found["complete"]
        else ("; more is wrong than drifts here: take captures and run hololoop-trainer diagnose")
    )
    return (
        f"The light path has drifted: the refit takes the excess from {before:.2g} to {after:.2g}; {done}{more}."
        f"{after_planes}"
    )


def _laser(drift: Drift, channel: str, base: ColourLightPath) -> dict[str, Any]:
    """A laser's own wavefront against the first one's, and its tilt; nothing where there is one laser."""
    terms = [float(v) for v in drift.laser_nm.get(channel, ())]
    if not terms:
        return {}
    grid = base.path.grid
    half_um = [0.5e6 * grid.pitch * n for n in grid.shape]  # P_1 rises by 1 over half of the panel
    return {
        "laser_terms_nm": terms,
        "laser_tilt_mrad": [term / half for term, half in zip(terms[:2], half_um, strict=True)],
    }


def _heldout(before: PredictionErrors, after: PredictionErrors) -> dict[str, Any]:
    """Errors on held-out patterns of one plane, before and after, and what the refit removes."""
    removed = removed_excess(before, after)
    return {
        "before": before.as_json(),
        "after": after.as_json(),
        "excess_removed": removed.value,
        "ci95": list(removed.interval()),
    }


def _rms_error(errors: np.ndarray, shape: tuple[int, int], lowest: int) -> float:
    """Root mean square over the panel of a map's standard error, its terms' errors taken as independent."""
    order = legendre_order(len(errors), lowest)
    y, x = edge_to_edge(shape)
    down, across = ((legendre_curve(t, order + 1) ** 2).mean(1) for t in (y[:, 0], x[0]))
    squares = (
        e**2 * down[i] * across[j] for e, (i, j) in zip(errors, legendre_products(order, lowest), strict=True)
    )
    return math.sqrt(float(sum(squares)))
