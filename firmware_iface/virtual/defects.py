"""Hidden defects of a simulated bench: one frozen dataclass for each kind, parameters in physical units.

All kinds carry the names of the catalogue of effects (ten of them are in `further_defects`), except `specks`, `fringes`
and `stripes`, which are outside it, `measured_field`, which is a real panel's, and `convention`, a bench described the
wrong way. Lateral parameters that scale with the panel are shares of its half width or half height (suffix `_share`);
`_px` is panel pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from firmware_iface.errors import InputError, nearest
from firmware_iface.toml_tables import parameter, read_table
from firmware_iface.virtual.defect_kind import Defect
from firmware_iface.virtual.further_defects import (
    AmplitudeModulation,
    CoherentGhost,
    Drivers,
    FixedPattern,
    FrameMotion,
    LaserAlignment,
    PhaseRipple,
    PolarisationLeak,
    SlowResponse,
    SourceLines,
    Vibration,
)
from firmware_iface.virtual.measured_field import MeasuredField


@dataclass(frozen=True)
class PhaseResponse(Defect):
    """Liquid-crystal curve: phase = 2 pi gain s(gray / levels), s from 0 to 1, S-shaped and lopsided.

    The gain belongs to `reference_nm`; other colours get gain (reference / wavelength)^dispersion.
    """

    kind = "phase_response"
    stage = "drive"
    gain: float = parameter(1.10, "phase at full gray over 2 pi", 0.1, 3)
    s_curvature: float = parameter(0.15, "slope of the curve is 1 -/+ this at the ends/middle", -0.7, 0.7)
    lopsidedness: float = parameter(0.02, "bulge of the curve, share of full phase", -0.08, 0.08)
    reference_nm: float = parameter(520.0, "wavelength at which the gain holds", 200, 2000)
    dispersion: float = parameter(1.1, "exponent of reference over wavelength", 0, 4)
    kink: float = parameter(
        0.0, "height of a kink, share of full phase: the curve is bent at one level", -0.2, 0.2
    )
    kink_at: float = parameter(0.4, "share of the gray levels where the kink is", 0.1, 0.9)


@dataclass(frozen=True)
class PhaseNonuniformity(Defect):
    """Cell thickness: the phase's gain is a wedge plus an off-centre dome plus a slow ripple."""

    kind = "phase_nonuniformity"
    stage = "drive"
    wedge: float = parameter(0.06, "gain change from the centre to the right edge", -0.5, 0.5)
    dome: float = parameter(0.14, "gain change at the top of the dome", -0.5, 0.5)
    dome_radius_share: float = parameter(0.7, "1/e radius of the dome", 0.05, 10)
    dome_x_share: float = parameter(-0.3, "centre of the dome", -2, 2)
    dome_y_share: float = parameter(0.25, "centre of the dome", -2, 2)
    ripple: float = parameter(0.012, "amplitude of the ripple", 0, 0.2)


@dataclass(frozen=True)
class Crosstalk(Defect):
    """Fringing field: the phase profile is smeared by a two-sided exponential along each axis."""

    kind = "crosstalk"
    stage = "drive"
    width_x_px: float = parameter(0.12, "mean decay length along a row", 0, 2)
    width_y_px: float = parameter(0.07, "mean decay length along a column", 0, 2)
    asymmetry_x: float = parameter(0.4, "-1 to 1, longer towards higher columns", -1, 1)
    asymmetry_y: float = parameter(-0.2, "-1 to 1, longer towards higher rows", -1, 1)


@dataclass(frozen=True)
class ZeroOrder(Defect):
    """Light that the pattern does not modulate: dead space between pixels, first-surface reflection."""

    kind = "zero_order"
    stage = "panel"
    fill_factor: float = parameter(0.90, "share of a pixel's area that is active", 0.05, 1)
    dead_amplitude: float = parameter(0.7, "amplitude that the dead space reflects", 0, 1)
    dead_phase_deg: float = parameter(40.0, "phase of the dead space")
    surface_amplitude: float = parameter(0.15, "amplitude of the first-surface reflection", 0, 2)
    surface_phase_deg: float = parameter(70.0, "its phase")
    surface_tilt_x_mrad: float = parameter(0.0, "wedge of the cover glass", -20, 20)
    surface_tilt_y_mrad: float = parameter(0.0, "wedge of the cover glass", -20, 20)


@dataclass(frozen=True)
class Illumination(Defect):
    """Off-centre elliptical Gaussian beam with a weak ring; mean power over the panel is kept."""

    kind = "illumination"
    stage = "panel"
    waist_x_share: float = parameter(1.6, "1/e^2 irradiance radius over the panel's half width", 0.1, 100)
    waist_y_share: float = parameter(1.8, "1/e^2 irradiance radius over the panel's half height", 0.1, 100)
    centre_x_share: float = parameter(0.25, "beam centre", -3, 3)
    centre_y_share: float = parameter(-0.2, "beam centre", -3, 3)
    ring: float = parameter(0.03, "amplitude of the ring", 0, 0.5)
    rough_rms: float = parameter(0.0, "rms of a rough surface that is added to the log amplitude", 0, 2)
    rough_nodes_y: int = parameter(7, "random nodes of the rough surface from edge to edge", 2, 200)
    rough_nodes_x: int = parameter(9, "random nodes of the rough surface from edge to edge", 2, 200)
    rough_seed: int = parameter(1, "seed of the nodes", 0)


@dataclass(frozen=True)
class PanelWavefront(Defect):
    """A panel that is not flat: saddle, trefoil and a dent, one path difference for all colours."""

    kind = "panel_wavefront"
    stage = "panel"
    peak_to_valley_nm: float = parameter(520.0, "path difference over the panel, peak to valley", 0, 20000)
    orientation_deg: float = parameter(25.0, "of the saddle")
    rough_rms_rad: float = parameter(0.0, "rms of a rough surface that is added, at 520 nm", 0, 50)
    rough_nodes_y: int = parameter(7, "random nodes of the rough surface from edge to edge", 2, 200)
    rough_nodes_x: int = parameter(9, "random nodes of the rough surface from edge to edge", 2, 200)
    rough_seed: int = parameter(1, "seed of the nodes", 0)


@dataclass(frozen=True)
class Distance(Defect):
    """The image plane is not where it is said to be."""

    kind = "distance"
    stage = "pupil"
    offset_mm: float = parameter(0.18, "true distance less the distance asked for", -1000, 1000)


@dataclass(frozen=True)
class PupilAberration(Defect):
    """An aberrated relay: path differences over the pupil, all colours alike; r = 1 is the band's edge."""

    kind = "pupil_aberration"
    stage = "pupil"
    astigmatism_nm: float = parameter(60.0, "r^2 cos 2t", -5000, 5000)
    oblique_astigmatism_nm: float = parameter(-25.0, "r^2 sin 2t", -5000, 5000)
    coma_x_nm: float = parameter(55.0, "(3 r^3 - 2 r) cos t", -5000, 5000)
    coma_y_nm: float = parameter(-30.0, "(3 r^3 - 2 r) sin t", -5000, 5000)
    spherical_nm: float = parameter(25.0, "6 r^4 - 6 r^2 + 1", -5000, 5000)
    trefoil_nm: float = parameter(20.0, "r^3 cos 3t", -5000, 5000)
    secondary_astigmatism_nm: float = parameter(8.0, "(4 r^4 - 3 r^2) cos 2t", -5000, 5000)


@dataclass(frozen=True)
class Iris(Defect):
    """The filter's true size, place and shape; it turns about its own centre.

    The edge's transmitted amplitude is a raised cosine, 1/2 where a hard edge would be.
    """

    kind = "iris"
    stage = "pupil"
    half_width: float = parameter(0.8, "share of the panel's band, replaces the nominal one", 0.02, 2)
    centre_x_share: float = parameter(0.08, "offset, share of the panel's band", -1, 1)
    centre_y_share: float = parameter(-0.05, "offset, share of the panel's band", -1, 1)
    shape: str = parameter("", "outline; empty: the nominal one", choices=("", "square", "circle"))
    half_width_x: float = parameter(0.0, "half width along x, share of the band; 0: half_width", 0, 2)
    half_width_y: float = parameter(0.0, "half width along y, share of the band; 0: half_width", 0, 2)
    rotation_deg: float = parameter(0.0, "from x towards y")
    soft_edge_share: float = parameter(0.0, "width of the edge, share of the band", 0, 1)


@dataclass(frozen=True)
class TemporalCoherence(Defect):
    """The source has a line width (the default is a superluminescent diode's): a sum of spectral lines."""

    kind = "temporal_coherence"
    stage = "pupil"
    linewidth_nm: float = parameter(18.0, "full width at half maximum", 0, 50)
    spread: float = parameter(
        0.0, "how much wider each further colour's line is, share of the first's", -0.3, 2
    )
    lines: int = parameter(13, "spectral lines summed", 1, 101)


@dataclass(frozen=True)
class SpatialCoherence(Defect):
    """The source is a uniform disc: each of its points tilts the illumination, irradiances are added."""

    kind = "spatial_coherence"
    stage = "pupil"
    radius_mrad: float = parameter(0.3, "half angle of the source", 0, 20)
    rings: int = parameter(2, "rings of source points round the centre", 1, 8)


@dataclass(frozen=True)
class SensorBlur(Defect):
    """Camera lens: a Gaussian core, wider along x, and a faint halo."""

    kind = "sensor_blur"
    stage = "sensor"
    sigma_x_px: float = parameter(0.5, "core", 0, 20)
    sigma_y_px: float = parameter(0.4, "core", 0, 20)
    halo_share: float = parameter(0.06, "light in the halo", 0, 1)
    halo_sigma_px: float = parameter(2.5, "halo", 0, 50)


@dataclass(frozen=True)
class Misregistration(Defect):
    """Shift, rotation, scale and distortion that remain after registration."""

    kind = "misregistration"
    stage = "sensor"
    shift_x_px: float = parameter(0.22, "camera pixel (i, j) sees panel column j + this", -1000, 1000)
    shift_y_px: float = parameter(-0.14, "camera pixel (i, j) sees panel row i + this", -1000, 1000)
    rotation_mrad: float = parameter(1.2, "about the centre, from x towards y", -3200, 3200)
    scale: float = parameter(1.0008, "panel pixels a camera pixel", 0.1, 10)
    distortion_px: float = parameter(0.3, "radial, at the corner", -50, 50)


@dataclass(frozen=True)
class Vignetting(Defect):
    """The camera's sensitivity falls as cos^4 of the field angle about a point off the centre."""

    kind = "vignetting"
    stage = "sensor"
    corner_angle_deg: float = parameter(32.0, "field angle at half the diagonal", 0, 80)
    centre_x_share: float = parameter(0.3, "where sensitivity is highest", -3, 3)
    centre_y_share: float = parameter(-0.2, "where sensitivity is highest", -3, 3)


@dataclass(frozen=True)
class StrayLight(Defect):
    """Light that is added: two broad glows, in counts at full power and 10 ms."""

    kind = "stray_light"
    stage = "sensor"
    glow_counts: float = parameter(130.0, "height of the first glow", 0, 60000)
    second_glow_counts: float = parameter(70.0, "height of the second glow", 0, 60000)
    radius_share: float = parameter(0.6, "1/e radius of the first glow", 0.05, 20)


@dataclass(frozen=True)
class SensorResponse(Defect):
    """Counts bend over a knee: s / (1 + (s / knee)^sharpness)^(1 / sharpness), s the share of full well."""

    kind = "sensor_response"
    stage = "sensor"
    knee_share: float = parameter(0.42, "share of full well where the curve bends", 0.01, 100)
    sharpness: float = parameter(1.8, "how sudden the bend is", 0.5, 20)


@dataclass(frozen=True)
class LaserDrift(Defect):
    """Power varies from capture to capture: a slow sine and a random walk."""

    kind = "laser_drift"
    stage = "sensor"
    sine_share: float = parameter(0.2, "amplitude of the sine", 0, 0.9)
    period_captures: float = parameter(7.3, "period of the sine", 1, 1e6)
    walk_share: float = parameter(0.04, "standard deviation of one step of the walk", 0, 0.5)


@dataclass(frozen=True)
class Ghost(Defect):
    """A second, weak, displaced and slightly blurred image."""

    kind = "ghost"
    stage = "sensor"
    share: float = parameter(0.14, "irradiance of the ghost over that of the image", 0, 1)
    shift_x_px: float = parameter(9.4, "displacement", -500, 500)
    shift_y_px: float = parameter(-5.7, "displacement", -500, 500)
    sigma_px: float = parameter(0.4, "blur of the ghost", 0, 50)


@dataclass(frozen=True)
class Specks(Defect):
    """Dust on the panel: small discs that absorb and delay."""

    kind = "specks"
    stage = "panel"
    count: int = parameter(26, "number of discs", 0, 5000)
    smallest_radius_px: float = parameter(1.5, "radius", 0.1, 100)
    largest_radius_px: float = parameter(5.0, "radius", 0.1, 100)
    transmission: float = parameter(0.15, "amplitude that passes a disc", 0, 1)
    phase_deg: float = parameter(60.0, "delay of the light that passes")
    phase_gain: float = parameter(
        1.0, "a disc's phase over the pattern's, as a bubble in the cell makes it", 0, 3
    )
    places: int = parameter(1, "seed of the places", 0)


@dataclass(frozen=True)
class Fringes(Defect):
    """Interference in the sensor's cover glass: a multiplicative sinusoid with a chirp."""

    kind = "fringes"
    stage = "sensor"
    contrast: float = parameter(0.22, "amplitude of the sinusoid", 0, 1)
    period_px: float = parameter(17.0, "period at the centre", 2.1, 5000)
    angle_deg: float = parameter(33.0, "direction of the fringes' normal from x")
    chirp: float = parameter(0.3, "relative change of frequency from centre to edge", -0.9, 0.9)
    fade: float = parameter(0.0, "relative change of the contrast from the centre to the right edge", -1, 1)


@dataclass(frozen=True)
class Stripes(Defect):
    """Column drivers differ: every panel column has its own amplitude."""

    kind = "stripes"
    stage = "panel"
    rms: float = parameter(0.16, "standard deviation of a column's amplitude", 0, 1)
    fade: float = parameter(0.0, "relative change of the errors from the centre to the lower edge", -1, 1)
    places: int = parameter(1, "seed of the columns' errors", 0)


@dataclass(frozen=True)
class Convention(Defect):
    """A bench described the wrong way: mirrored camera, reversed phase or distance, shifted bits."""

    kind = "convention"
    stage = "sensor"
    mirror_x: bool = parameter(True, "camera columns run backwards")
    flip_y: bool = parameter(False, "camera rows run backwards")
    phase_sign: int = parameter(1, "-1: more gray means less phase than described", choices=(1, -1))
    distance_sign: int = parameter(1, "-1: the distance is counted the other way", choices=(1, -1))
    left_justified: bool = parameter(False, "counts sit in the top bits of 16")


_CATALOGUE: tuple[type[Defect], ...] = (
    PhaseResponse,
    PhaseNonuniformity,
    Crosstalk,
    ZeroOrder,
    Illumination,
    PanelWavefront,
    Distance,
    PupilAberration,
    Iris,
    TemporalCoherence,
    SpatialCoherence,
    SensorBlur,
    Misregistration,
    Vignetting,
    StrayLight,
    SensorResponse,
    LaserDrift,
    Ghost,
    AmplitudeModulation,
    PolarisationLeak,
    SlowResponse,
    PhaseRipple,
    Drivers,
    CoherentGhost,
    SourceLines,
    Vibration,
    FrameMotion,
    FixedPattern,
)
CATALOGUE_KINDS: tuple[str, ...] = tuple(c.kind for c in _CATALOGUE)
_OUTSIDE: tuple[type[Defect], ...] = (Specks, Fringes, Stripes, MeasuredField, LaserAlignment, Convention)
DEFECT_KINDS: dict[str, type[Defect]] = {c.kind: c for c in _CATALOGUE + _OUTSIDE}


def make_defect(kind: str, where: str = "a defect", **parameters: Any) -> Defect:
    """A defect by name; parameters that are not given take their defaults.

    Raises
    ------
    InputError
        For an unknown kind or parameter, or a value out of range.
    """
    if kind not in DEFECT_KINDS:
        raise InputError(f"{where} has an unknown kind '{kind}'; {nearest(kind, DEFECT_KINDS)}")
    return read_table(DEFECT_KINDS[kind], parameters, f"{where} (kind '{kind}')")


def read_defect(table: Mapping[str, Any], where: str) -> Defect:
    """A defect from one `[[defect]]` table, whose `kind` names it; raises as `make_defect`."""
    if not isinstance(table, Mapping) or "kind" not in table:
        raise InputError(f"{where} lacks the key 'kind'; add kind = \"...\" with a kind of defect.")
    return make_defect(str(table["kind"]), where, **{k: v for k, v in table.items() if k != "kind"})
