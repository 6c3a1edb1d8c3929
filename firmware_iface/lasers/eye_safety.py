"""How much light may leave the exit pupil: Class 1, intentional long-term viewing, weighted by wavelength and summed.

Limits are those of IEC/EN 60825-1:2014 for 400 to 700 nm, as published implementations code its Table 3; check them
against the standard itself before any claim. Two hazards are kept apart, and in each the shares of all wavelengths add:

thermal         390 µW for a point source (1.5 mrad or less); 7e-4 C6 T2^-0.25 W for a source of alpha mrad, with
                C6 = alpha/1.5, T2 = 10 * 10^((alpha - 1.5)/98.5) s, up to 100 mrad
photochemical   39 µW * C3 from 400 to 600 nm, C3 = 1 below 450 nm and 10^(0.02 (wavelength - 450)) above; over
                30 000 s the eye moves, so all light counts as one spot

A hologram can send all its light into one spot, so this is assumed without a prediction. A predicted picture
counts with its brightest spots: for squares from 1.5 to 100 mrad, the largest share of the light that any square
holds, against the limit of a source as large as the next smaller square. Sizes in between are then covered too.

Light that a panel gates to fields comes in pulses, and the standard asks for both: the mean power, summed over the
fields of a frame, keeps the limits above, and each pulse keeps the limit of a single one, 7e-4 t^-0.25 C6 C5 W for a
pulse of t seconds. C5 is taken as 1 up to 5 mrad (as 0.4, its lowest value there, for pulses of 5 µs and less, of
which a train has more than 600) and as 0.2, its lowest value, above; C6 grows up to 200 t^0.5 mrad, and 5 mrad at
least. Pulses of all lasers are taken to come together.

Where a laser has n pulses in a frame, any k of them that follow one another, k = 1 to n, also keep the limit of a
single pulse: they bring k times the energy, taken as one pulse of k t. In truth they last longer, with the pauses
between them, and the energy that is allowed only grows with time. In power that is P <= limit(k t). Every k is
checked, since for a large source the limit over time falls (up to 0.6 ms), rises and falls again: the lowest can be
at any k.

This is arithmetic, not a classification. Software does not make a product Class 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError

POINT_MRAD, LARGEST_MRAD = 1.5, 100.0
SHORTEST_PULSE_S = 5e-6  # shorter ones count as this long
ROUNDED = 1 + 1e-9
SIZES_MRAD = tuple(np.geomspace(POINT_MRAD, LARGEST_MRAD, 13).tolist())
ALL_IN_ONE_SPOT = (1.0,) * len(SIZES_MRAD)


def thermal_limit_uw(source_mrad: float = POINT_MRAD) -> float:
    """Class 1 thermal limit for a source of this angular size, µW."""
    alpha = min(max(source_mrad, POINT_MRAD), LARGEST_MRAD)
    if alpha == POINT_MRAD:
        return 390.0
    t2_s = 10 * 10 ** ((alpha - 1.5) / 98.5)
    return 1e6 * 7e-4 * (alpha / 1.5) * t2_s**-0.25


def photochemical_limit_uw(wavelength_nm: float) -> float:
    """Class 1 photochemical limit over 30 000 s, µW; infinite above 600 nm."""
    if wavelength_nm > 600:
        return math.inf
    return 39.0 * 10 ** (0.02 * max(0.0, wavelength_nm - 450))


def pulse_limit_uw(source_mrad: float, pulse_s: float) -> float:
    """Class 1 thermal limit of the power in one pulse of a long train, for a source of this angular size, µW."""
    lasts_s = max(pulse_s, SHORTEST_PULSE_S)
    alpha = min(max(source_mrad, POINT_MRAD), largest_pulsed_mrad(lasts_s))
    of_train = 0.2 if source_mrad > 5.0 else 0.4 if pulse_s <= SHORTEST_PULSE_S else 1.0
    return 1e6 * 7e-4 * lasts_s**-0.25 * (alpha / POINT_MRAD) * of_train


def largest_pulsed_mrad(pulse_s: float) -> float:
    """Angular size beyond which a source bears no more light in a pulse, mrad."""
    return min(LARGEST_MRAD, max(5.0, 200.0 * pulse_s**0.5))


def spot_shares(irradiance: NDArray[np.floating], mrad_per_pixel: float) -> tuple[float, ...]:
    """The largest share of a picture's light in any square of each of SIZES_MRAD.

    A square is rounded up to whole pixels, so is never too small.

    Parameters
    ----------
    irradiance : float array [H, W]
        Predicted in the image plane, any unit, not negative.
    mrad_per_pixel : float, mrad
        Angle of a pixel at the eye.

    Returns
    -------
    tuple of float
        One share for each of SIZES_MRAD, 0 to 1.

    Raises
    ------
    InputError
        Where this is no picture of light, or the angle is not above 0.
    """
    picture = np.asarray(irradiance, np.float64)
    if picture.ndim != 2 or not np.isfinite(picture).all() or picture.size == 0 or picture.min() < 0:
        raise InputError("a predicted picture must be [H, W], finite and nowhere negative; correct it.")
    if not (math.isfinite(mrad_per_pixel) and mrad_per_pixel > 0):
        raise InputError(f"{mrad_per_pixel!r} mrad a pixel is not an angle; give a number above 0.")
    total = float(picture.sum())
    if total == 0:
        return ALL_IN_ONE_SPOT  # no prediction: the worst case
    table = np.zeros((picture.shape[0] + 1, picture.shape[1] + 1))
    table[1:, 1:] = picture.cumsum(0).cumsum(1)
    shares = []
    for size in SIZES_MRAD:
        side = math.ceil(size / mrad_per_pixel) + 1  # wherever between the pixels the square begins
        h, w = min(side, picture.shape[0]), min(side, picture.shape[1])
        sums = table[h:, w:] - table[:-h, w:] - table[h:, :-w] + table[:-h, :-w]
        shares.append(min(1.0, float(sums.max()) / total))
    return tuple(shares)


@dataclass(frozen=True)
class GatedLight:
    """Light that the panel gates: in each frame, every laser shines in its own fields alone.

    Attributes
    ----------
    duty : float
        Share of the time in which each laser shines, at most: in all of its pulses together.
    pulse_s : float, s
        How long it shines at a time, at most.
    frame_s : float, s
        Time of a frame, with all of its fields.
    pulses : int
        In how many fields of a frame one laser shines, at most.

    Raises
    ------
    InputError
        For a value out of range, and for a share of the time that is less than that of the pulses.
    """

    duty: float
    pulse_s: float
    frame_s: float
    pulses: int = 1

    def __post_init__(self) -> None:
        lit_s = self.pulses * self.pulse_s
        if not (0 < self.duty <= 1 and self.pulses >= 1 and 0 < lit_s <= self.frame_s * ROUNDED < math.inf):
            raise InputError(
                f"light for {self.duty:g} of the time, in {self.pulses} pulses of {self.pulse_s:g} s of "
                f"{self.frame_s:g} s, cannot be; give a share of 0 to 1 and pulses within the frame."
            )
        if lit_s > self.duty * self.frame_s * ROUNDED:
            raise InputError(
                f"{self.pulses} pulses of {self.pulse_s:g} s are {lit_s / self.frame_s:.3g} of a frame of "
                f"{self.frame_s:g} s, and {self.duty:g} is given; give the share of all pulses together."
            )


@dataclass(frozen=True)
class Exposure:
    """Shares of the Class 1 limits that are used.

    Attributes
    ----------
    thermal, photochemical : float
        1 is the limit.
    """

    thermal: float
    photochemical: float

    @property
    def worst(self) -> float:
        """The larger of the two."""
        return max(self.thermal, self.photochemical)


def exposure(
    power_uw: Mapping[str, float],
    wavelength_nm: Mapping[str, float],
    shares: Mapping[str, Sequence[float]] | None = None,
    gated: GatedLight | None = None,
) -> Exposure:
    """Shares of the Class 1 limits that these lasers use.

    Parameters
    ----------
    power_uw : mapping of channel to float, µW
        Through a 7 mm aperture at the exit pupil, while it shines.
    wavelength_nm : mapping of channel to float, nm
        400 to 700.
    shares : mapping of channel to sequence of float, or None
        From `spot_shares`. A channel that is missing has all its light in
        one spot. The brightest spots of all channels are taken to coincide.
    gated : GatedLight or None
        How the panel gates the lasers; None: they shine all the time.

    Returns
    -------
    Exposure
    """
    if gated is not None:
        mean = exposure({c: gated.duty * p for c, p in power_uw.items()}, wavelength_nm, shares)
        groups = (_pulsed(power_uw, shares, k * gated.pulse_s) for k in range(1, gated.pulses + 1))
        return Exposure(max(mean.thermal, *groups), mean.photochemical)
    photochemical = sum(p / photochemical_limit_uw(wavelength_nm[c]) for c, p in power_uw.items())
    found = {c: (shares or {}).get(c, ALL_IN_ONE_SPOT) for c in power_uw}
    thermal = sum(power_uw.values()) / thermal_limit_uw(LARGEST_MRAD)  # all light, in the largest source
    for k in range(len(SIZES_MRAD)):
        limit = thermal_limit_uw(SIZES_MRAD[max(0, k - 1)])
        thermal = max(thermal, sum(p * found[c][k] for c, p in power_uw.items()) / limit)
    return Exposure(thermal, photochemical)


def _pulsed(
    power_uw: Mapping[str, float], shares: Mapping[str, Sequence[float]] | None, pulse_s: float
) -> float:
    """The share of the limit of a single pulse of this length that these lasers use together."""
    found = {c: (shares or {}).get(c, ALL_IN_ONE_SPOT) for c in power_uw}
    worst = 0.0
    for k in range(len(SIZES_MRAD)):
        smaller = SIZES_MRAD[max(0, k - 1)]
        limit = min(pulse_limit_uw(size, pulse_s) for size in (smaller, SIZES_MRAD[k]))
        worst = max(worst, sum(p * found[c][k] for c, p in power_uw.items()) / limit)
        if smaller >= largest_pulsed_mrad(pulse_s):
            break
    return worst
