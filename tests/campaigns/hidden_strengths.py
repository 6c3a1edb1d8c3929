"""Which defect each set of the verdict's study hides, and how strong it is.

Sets come in blocks: each kind of the catalogue once, and NOTHING sets without a defect, in random order. So any number
of first sets holds all kinds about equally often. From block to block the strengths of a kind are spread evenly (van
der Corput's sequence with a random start) over two decades of the defect's departure from absent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from firmware_iface.virtual.defects import CATALOGUE_KINDS, make_defect

NOTHING = 7  # sets of a block that hide nothing
BLOCK = len(CATALOGUE_KINDS) + NOTHING
DECADES = 2.0
CAPTURES = (9, 12)

# What the parameters that scale a defect are where it is absent. Infinity: the departure is 1 / value^2, as of a beam
# that grows wider than the panel.
ABSENT: dict[str, dict[str, float]] = {
    "phase_response": {"gain": 1, "s_curvature": 0, "lopsidedness": 0},
    "phase_nonuniformity": {"wedge": 0, "dome": 0, "ripple": 0},
    "crosstalk": {"width_x_px": 0, "width_y_px": 0},
    "zero_order": {"fill_factor": 1, "surface_amplitude": 0},
    "illumination": {"waist_x_share": math.inf, "waist_y_share": math.inf, "ring": 0},
    "panel_wavefront": {"peak_to_valley_nm": 0},
    "distance": {"offset_mm": 0},
    "pupil_aberration": {
        "astigmatism_nm": 0,
        "oblique_astigmatism_nm": 0,
        "coma_x_nm": 0,
        "coma_y_nm": 0,
        "spherical_nm": 0,
        "trefoil_nm": 0,
        "secondary_astigmatism_nm": 0,
    },
    "iris": {"half_width": 1, "centre_x_share": 0, "centre_y_share": 0},
    "temporal_coherence": {"linewidth_nm": 0},
    "spatial_coherence": {"radius_mrad": 0},
    "sensor_blur": {"sigma_x_px": 0, "sigma_y_px": 0, "halo_share": 0},
    "misregistration": {"shift_x_px": 0, "shift_y_px": 0, "rotation_mrad": 0, "scale": 1, "distortion_px": 0},
    "vignetting": {"corner_angle_deg": 0},
    "stray_light": {"glow_counts": 0, "second_glow_counts": 0},
    "sensor_response": {"knee_share": math.inf},
    "laser_drift": {"sine_share": 0, "walk_share": 0},
    "ghost": {"share": 0},
    "amplitude_modulation": {"fall": 0},
    "polarisation_leak": {"amplitude": 0},
    "slow_response": {"share": 0},
    "phase_ripple": {"depth": 0},
    "drivers": {"column_offset_rad": 0, "column_gain": 0, "row_offset_rad": 0, "row_gain": 0},
    "coherent_ghost": {"amplitude": 0},
    "source_lines": {"share": 0},
    "vibration": {"rms_px": 0},
    "frame_motion": {"rms_px": 0},
    "fixed_pattern": {"gain_rms": 0, "offset_counts": 0},
}


@dataclass(frozen=True)
class HiddenStrength:
    """What one set hides.

    Attributes
    ----------
    kind : str or None
        The defect; None for a set that hides nothing.
    strength : float
        Its departure from absent over that of its defaults; 0 where nothing is hidden.
    captures : int
        How many the set has.
    """

    kind: str | None
    strength: float
    captures: int


def hidden_in(number: int, seed: int) -> HiddenStrength:
    """What the set of this number hides; the same for every length of the study."""
    block, place = divmod(number, BLOCK)
    order = np.random.default_rng([seed, block]).permutation(BLOCK)
    which = int(order[place])
    captures = int(np.random.default_rng([seed, 1, number]).integers(CAPTURES[0], CAPTURES[1] + 1))
    if which >= len(CATALOGUE_KINDS):
        return HiddenStrength(None, 0.0, captures)
    start = np.random.default_rng([seed, 2, which]).random()
    exponent = -DECADES * ((start + van_der_corput(block)) % 1)
    return HiddenStrength(CATALOGUE_KINDS[which], float(10**exponent), captures)


def van_der_corput(index: int) -> float:
    """The index's binary digits mirrored at the point: any number of first ones is spread evenly over 0 to 1."""
    value, step = 0.0, 0.5
    while index:
        index, digit = divmod(index, 2)
        value += step * digit
        step /= 2
    return value


def defect_of(kind: str, strength: float, seed: int) -> str:
    """The lines after [[defect]] of a bench file: a kind whose departure from absent is this share of its default.

    Parameters
    ----------
    strength : float
    seed : int
        For kinds that draw their values at random.
    """
    default = make_defect(kind)
    values = {name: scaled(getattr(default, name), absent, strength) for name, absent in ABSENT[kind].items()}
    lines = [f'kind = "{kind}"', *(f"{name} = {value:.9g}" for name, value in values.items())]
    if hasattr(default, "seed"):
        lines.append(f"seed = {seed}")
    return "\n".join(lines)


def scaled(default: float, absent: float, strength: float) -> float:
    """A parameter at a share of its default's departure from absent."""
    if math.isinf(absent):
        return default / math.sqrt(strength)
    return absent + strength * (default - absent)
