"""Ten more kinds of hidden defects, which real panels, sources and cameras have beside those of `defects`."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_iface.toml_tables import parameter
from firmware_iface.virtual.defect_kind import Defect


@dataclass(frozen=True)
class AmplitudeModulation(Defect):
    """A pixel's amplitude falls with its gray level: 1 - fall (t + curvature t (1 - t)), t = gray / 255."""

    kind = "amplitude_modulation"
    stage = "drive"
    fall: float = parameter(0.18, "share of the amplitude that is gone at gray 255", -1, 0.95)
    curvature: float = parameter(0.25, "bend of the curve: 0 is a straight line", -1, 1)


@dataclass(frozen=True)
class PolarisationLeak(Defect):
    """A second component of the field, which the pattern delays less."""

    kind = "polarisation_leak"
    stage = "drive"
    amplitude: float = parameter(0.15, "amplitude over the first component's", 0, 2)
    phase_deg: float = parameter(30.0, "phase of its own")
    gain: float = parameter(0.35, "its phase over the pattern's", -3, 3)
    interferes: bool = parameter(
        True, "true: the fields add, as behind an analyser; false: the irradiances add"
    )


@dataclass(frozen=True)
class SlowResponse(Defect):
    """From one capture to the next the panel goes only part of the way from the old phase to the new."""

    kind = "slow_response"
    stage = "drive"
    share: float = parameter(0.08, "share of the phase before that is still there", 0, 0.95)


@dataclass(frozen=True)
class PhaseRipple(Defect):
    """Within an exposure the phase is u = -1, -1/2, 0, 1/2, 1 times the depth off, for a fifth of it each."""

    kind = "phase_ripple"
    stage = "drive"
    depth: float = parameter(0.14, "the phase's gain is 1 + u depth", -1, 1)
    offset_rad: float = parameter(0.0, "u times this is added to the phase of the whole panel", -10, 10)


@dataclass(frozen=True)
class Drivers(Defect):
    """Column and row drivers differ: phase offset and gain repeat every few columns and rows, mean 0 and 1."""

    kind = "drivers"
    stage = "drive"
    column_offset_rad: float = parameter(0.12, "rms of the columns' offsets", 0, 3)
    column_gain: float = parameter(0.03, "rms of the columns' gains", 0, 0.4)
    column_period: int = parameter(4, "columns after which they repeat", choices=(2, 3, 4))
    row_offset_rad: float = parameter(0.06, "rms of the rows' offsets", 0, 3)
    row_gain: float = parameter(0.015, "rms of the rows' gains", 0, 0.4)
    row_period: int = parameter(2, "rows after which they repeat", choices=(2, 3, 4))
    seed: int = parameter(1, "seed of the values", 0)


@dataclass(frozen=True)
class CoherentGhost(Defect):
    """A second path of the field: displaced, and delayed by one path difference for all colours."""

    kind = "coherent_ghost"
    stage = "panel"
    amplitude: float = parameter(0.12, "amplitude over the first path's", 0, 1)
    phase_deg: float = parameter(50.0, "phase of the delay at 520 nm")
    shift_y_px: float = parameter(6.3, "displacement", -500, 500)
    shift_x_px: float = parameter(-3.6, "displacement", -500, 500)


@dataclass(frozen=True)
class SourceLines(Defect):
    """The source has lines beside the nominal one, which keeps the rest of the power; irradiances add."""

    kind = "source_lines"
    stage = "pupil"
    separation_nm: float = parameter(6.0, "second line less the nominal one", -50, 50)
    share: float = parameter(0.3, "share of the second line in the power", 0, 0.5)
    third_separation_nm: float = parameter(-4.0, "third line less the nominal one", -50, 50)
    third_share: float = parameter(0.0, "share of the third line in the power", 0, 0.5)
    spread: float = parameter(
        0.0, "how much farther apart each further colour's lines are, share of the first's", -2, 2
    )


@dataclass(frozen=True)
class LaserAlignment(Defect):
    """Lasers that do not point the same way: each further colour's beam is tilted against the one before."""

    kind = "laser_alignment"
    stage = "panel"
    tilt_y_mrad: float = parameter(-0.06, "angle between one laser and the next", -20, 20)
    tilt_x_mrad: float = parameter(0.1, "angle between one laser and the next", -20, 20)


@dataclass(frozen=True)
class Vibration(Defect):
    """The picture swings to and fro on the camera during an exposure, more in some captures than in others."""

    kind = "vibration"
    stage = "sensor"
    rms_px: float = parameter(0.6, "displacement, root mean square over the exposure", 0, 20)
    direction_deg: float = parameter(35.0, "from x towards y")
    spread: float = parameter(0.4, "standard deviation of a capture's rms over its mean", 0, 2)


@dataclass(frozen=True)
class FrameMotion(Defect):
    """The camera is displaced at random in every capture."""

    kind = "frame_motion"
    stage = "sensor"
    rms_px: float = parameter(0.3, "displacement along each axis, panel pixels", 0, 50)
    seed: int = parameter(1, "seed of the displacements, beside the bench's own", 0)


@dataclass(frozen=True)
class FixedPattern(Defect):
    """Each camera pixel has a gain and an offset of its own, the same in every capture."""

    kind = "fixed_pattern"
    stage = "sensor"
    gain_rms: float = parameter(0.03, "standard deviation of a pixel's gain", 0, 0.5)
    offset_counts: float = parameter(6.0, "standard deviation of a pixel's offset", 0, 10000)
    seed: int = parameter(1, "seed of the pixels' values", 0)
