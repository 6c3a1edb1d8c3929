"""The planes that a calibration does not fit: whether what was found in one plane is right in the others.

A drift of the panel's wavefront, of the beam or of its response is the same in every plane, and a shift of the image is
taken to be. So the light paths of all planes are replaced together, and each plane that the camera can be focused on
is checked with held-out patterns first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from runtime.bundle.bundle_folder import Bundle
from runtime.bundle.light_path_arrays import bundle_paths, load_light_path
from runtime.calibration.colour_captures import ColourCaptures, ColourPatterns
from runtime.calibration.drift import Drift, drifted
from runtime.calibration.drift_fit import fit, layout_of
from runtime.calibration.estimate import ColourLightPath, Estimate, Shot
from runtime.calibration.held_out_errors import held_out_errors
from runtime.calibration.information import measured_information
from runtime.calibration.refit import PIXELS, few
from runtime.calibration.replacement_rule import LEAST_EXCESS
from runtime.calibration.taking import Taker
from runtime.camera.view import View
from runtime.excess import PredictionErrors, removed_excess
from runtime.program.progress import no_progress


@dataclass(frozen=True)
class PlaneCheck:
    """Errors on held-out patterns in a plane that no fit has seen.

    Attributes
    ----------
    plane_mm : float, mm
        From the panel.
    before, after : PredictionErrors
        Of the light path as it was and with what was found.
    """

    plane_mm: float
    before: PredictionErrors
    after: PredictionErrors

    @property
    def worse(self) -> bool:
        """Whether what was found is certainly wrong here: the old light path predicts better, by enough to matter."""
        removed = removed_excess(self.before, self.after)
        return removed.interval()[1] < 0 and -removed.value > LEAST_EXCESS


def other_planes(bundle: Bundle, plane_mm: float) -> list[float]:
    """The planes of a bundle without the given one, mm."""
    return sorted({float(r["plane_mm"]) for r in bundle_paths(bundle)} - {plane_mm})


def plane_shots(
    taker: Taker,
    plane_mm: float,
    patterns: Mapping[str, ColourPatterns],
    captures: Mapping[str, ColourCaptures],
) -> list[Shot]:
    """Each colour's held-out patterns in another plane, at its exposure and with its camera's noise.

    Parameters
    ----------
    taker : Taker
    plane_mm : float, mm
        Where the camera is focused then.
    patterns, captures : mappings of str
        By colour; what was captured in the plane that is fitted.
    """
    taker.devices.move_to_plane(plane_mm)
    shots: list[Shot] = []
    for channel, one in captures.items():
        taker.light(channel)
        taker.devices.camera.exposure_ms = one.exposure_ms
        shots += taker.shots(
            channel, patterns[channel].heldout, one.noise, f"{channel} at {plane_mm:g} mm, pattern"
        )
    return shots


def checked_plane(
    bundle: Bundle,
    wavelengths_nm: Mapping[str, float],
    plane_mm: float,
    shots: Sequence[Shot],
    found: Estimate,
) -> PlaneCheck:
    """The check of one plane.

    Parameters
    ----------
    bundle : Bundle
    wavelengths_nm : mapping of str to float, nm
        By colour.
    plane_mm : float, mm
    shots : sequence of Shot
        Taken in that plane.
    found : Estimate
        What the calibration has found in its own plane.
    """
    bases = {c: ColourLightPath(load_light_path(bundle, c, plane_mm), nm) for c, nm in wavelengths_nm.items()}
    moved = {
        c: ColourLightPath(drifted(base.path, c, base.wavelength_nm, found.drift), base.wavelength_nm)
        for c, base in bases.items()
    }
    # a lens that is focused anew looks elsewhere: each light path gets the view that suits it best
    before, after = (
        held_out_errors(paths, shots, fitted_views(paths, shots, found.view)[1]).errors
        for paths in (bases, moved)
    )
    return PlaneCheck(plane_mm, before, after)


def fitted_views(
    bases: Mapping[str, ColourLightPath], shots: Sequence[Shot], view: View
) -> tuple[Estimate, Estimate]:
    """The views of the camera that suit light paths as they are best: with the lens's scale, and with a free one.

    At one plane, defocus and distance together do what a camera of another scale does: no pattern tells them apart
    (the rays' matrices are the same). So a light path is checked with the scale of the camera that suits it best,
    and a refit must be better than that before it replaces anything.

    Parameters
    ----------
    bases : mapping of str to ColourLightPath
        By colour.
    shots : sequence of Shot
    view : View
        To begin with.

    Returns
    -------
    (Estimate, Estimate)
        Without a drift.
    """
    some, start, layout = few(shots, PIXELS[0]), Estimate(Drift(), view), layout_of(bases, (0, 0), True)
    known = measured_information(bases, some, layout.widened(start), layout, no_progress)
    rigid = fit(bases, some, start, (0, 0), 5, information=known).estimate
    scaled = fit(bases, some, rigid, (0, 0), 5, new_view=True, information=known).estimate
    return rigid, scaled
