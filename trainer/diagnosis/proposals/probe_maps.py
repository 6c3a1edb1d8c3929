"""The maps of fitted probes, with where each acts on the light and how an effect's file says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trainer.diagnosis.probes import ProbeResult
from trainer.prediction.free_stages import PUPIL_EXTENT

PANEL_PLACES = (
    "    rows, columns = {stage}.y.shape",
    "    # Pixels from the centre.",
    "    y, x = {stage}.y * (rows / 2), {stage}.x * (columns / 2)",
)


@dataclass(frozen=True)
class Place:
    """Where a map acts.

    Attributes
    ----------
    stage : str
    title : str
        Beginning of the probe's title of the map.
    name : str
        What the map is, in the effect's name where the shape alone would not say it.
    what : str
        What it does to the light.
    unit : str
        Of the map's values.
    spread : str
        Unit of its coordinates: "pixels", "share of band" or "" for gray levels.
    before, after : tuple of str
        Lines of a file that make the coordinates, and that put `value` in.
    seen_by : str
        The stage whose probe shows it; "" for its own.
    """

    stage: str
    title: str
    name: str
    what: str
    unit: str
    spread: str
    before: tuple[str, ...]
    after: tuple[str, ...]
    seen_by: str = ""

    @property
    def probe(self) -> str:
        """The stage whose probe shows it."""
        return self.seen_by or self.stage

    @property
    def acts_on(self) -> str:
        """Whether the eye sees it too."""
        return "camera" if self.stage == "sensor" else "display"


def _on_pixels(stage: str) -> tuple[str, ...]:
    return tuple(line.format(stage=stage) for line in PANEL_PLACES)


AMPLITUDE = Place(
    "panel",
    "amplitude multiplied",
    "amplitude",
    "multiplies the light's amplitude at the panel by 1 + value",
    "1",
    "pixels",
    _on_pixels("panel"),
    ("    return panel.multiplied(1 + value)",),
)
PHASE = Place(
    "panel",
    "phase multiplied",
    "phase",
    "delays the light at the panel by value, in radians at the first colour",
    "rad",
    "pixels",
    _on_pixels("panel"),
    (
        "    # One path difference for all colours.",
        "    angle = value * (panel.reference_wavelength / panel.wavelength)",
        "    return panel.multiplied(torch.polar(torch.ones_like(angle), angle))",
    ),
)
TRANSMISSION = Place(
    "panel",
    "",
    "",
    "multiplies the light at the panel by 1 + value, amplitude and phase",
    "1",
    "pixels",
    _on_pixels("panel"),
    ("    return panel.multiplied(1 + value)",),
)
GAIN = Place(
    "sensor",
    "gain over the picture",
    "gain",
    "multiplies the camera's sensitivity by 1 + value",
    "1",
    "pixels",
    _on_pixels("sensor"),
    ("    return sensor.multiplied(1 + value)",),
)
OFFSET = Place(
    "sensor",
    "light added",
    "light",
    "adds value to the camera's counts",
    "counts",
    "pixels",
    _on_pixels("sensor"),
    ("    return sensor.brightened(value)",),
)
PASSED = Place(
    "pupil",
    "amplitude passed",
    "amplitude",
    "multiplies the amplitude that the pupil passes by 1 + value",
    "1",
    "share of band",
    (
        "    # Spatial frequency, 1 at the panel's band edge.",
        "    y, x = torch.broadcast_tensors(pupil.v, pupil.u)",
    ),
    (
        "    before = pupil.transmission",
        "    factor = (1 + value) + 0j",
        "    return replace(pupil, transmission=factor if before is None else before * factor)",
    ),
)
DELAY = Place(
    "pupil",
    "phase, over spatial frequency",
    "phase",
    "delays the light in the pupil by value, in radians at the first colour",
    "rad",
    "share of band",
    PASSED.before,
    ("    return pupil.delayed(value * (pupil.reference_wavelength / (2 * math.pi)))",),
)
DRIVEN = Place(
    "drive",
    "gain of the phase over the panel",
    "gain",
    "multiplies the phase that the panel makes of a gray level by 1 + value",
    "1",
    "pixels",
    _on_pixels("drive"),
    ("    return drive.scaled(1 + value)",),
)
# A shape at the panel times the gray level: the phase that it adds grows with the gray level.
DRIVEN_BY_GRAY = replace(DRIVEN, title="", name="gray", seen_by="panel")
GRAY = Place(
    "drive",
    "response, deviation",
    "response",
    "adds value to the phase of each gray level, in radians",
    "rad",
    "",
    ("    level = drive.level  # gray / levels, 0 to 1",),
    ("    return replace(drive, response=drive.response + value)",),
)
PLACES = (AMPLITUDE, PHASE, GAIN, OFFSET, PASSED, DELAY, DRIVEN, GRAY)


@dataclass(frozen=True)
class ProbeMap:
    """A probe's map about its middle value.

    Attributes
    ----------
    place : Place
    values : array [n, m], or [n] for gray levels
        In the place's unit; complex for TRANSMISSION.
    shape : (int, int)
        Pixels that it spreads over; (0, 0) for a map that is not over pixels.
    reach : (float, float)
        Coordinates of the last nodes; those of the first are the negative ones.
    weight : float
        Held-out excess that the probe removes, times this map's share in it.
    """

    place: Place
    values: NDArray[np.float64]
    shape: tuple[int, int]
    reach: tuple[float, float]
    weight: float = 0.0

    @property
    def grid(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates (y, x) of the nodes, each [n, m]."""
        y, x = (np.linspace(-r, r, n) for r, n in zip(self.reach, self.values.shape, strict=True))
        grid = np.meshgrid(y, x, indexing="ij")
        return grid[0], grid[1]

    @property
    def radius(self) -> float:
        """From the centre to a corner, in units of the coordinates."""
        return float(np.hypot(*self.reach))

    @property
    def whole(self) -> bool:
        """Whether there is a node a pixel."""
        return tuple(self.values.shape) == self.shape


def maps_of(
    found: ProbeResult, shape: tuple[int, int], signal: float = 1.0, phase_sign: int = 1
) -> list[ProbeMap]:
    """The maps of a probe that an effect could replace, each with its weight.

    Parameters
    ----------
    found : ProbeResult
    shape : (int, int), pixels
        Of the camera for the sensor's probe, of the panel otherwise.
    signal : float, counts
        Standard deviation of the measured signal, against which added counts are weighed.
    phase_sign : int
        -1 where more gray means less phase.
    """
    maps = [m for place in PLACES if place.stage == found.stage for m in _maps_at(place, found, shape)]
    powers = [
        float((np.abs(m.values - m.values.mean()) ** 2).mean())
        / (signal**2 if m.place.unit == "counts" else 1.0)
        for m in maps
    ]
    whole = sum(powers) or 1.0
    removed = found.removed.value
    weighed = [
        ProbeMap(m.place, m.values, m.shape, m.reach, removed * p / whole)
        for m, p in zip(maps, powers, strict=True)
    ]
    return [*_transmission(weighed, removed), *_times_gray(weighed, phase_sign), *weighed]


def _times_gray(maps: Sequence[ProbeMap], sign: int) -> list[ProbeMap]:
    """The phase at the panel as the mean over all gray levels, of half a wave, of a phase that grows with them."""
    return [
        replace(m, place=DRIVEN_BY_GRAY, values=sign * m.values / np.pi) for m in maps if m.place is PHASE
    ]


def _transmission(maps: Sequence[ProbeMap], removed: float) -> list[ProbeMap]:
    """Amplitude and phase at the panel as one complex map: what dust does."""
    by_place = {m.place: m for m in maps}
    if AMPLITUDE not in by_place or PHASE not in by_place:
        return []
    amplitude, phase = by_place[AMPLITUDE], by_place[PHASE]
    values = (1 + amplitude.values) * np.exp(1j * phase.values) - 1
    return [ProbeMap(TRANSMISSION, values, amplitude.shape, amplitude.reach, removed)]


def _maps_at(place: Place, found: ProbeResult, shape: tuple[int, int]) -> list[ProbeMap]:
    arrays = [
        np.asarray(values, dtype=np.float64)
        for title, values, _ in found.pictures
        if title.startswith(place.title)
    ]
    if not arrays:
        return []
    if place is GRAY:  # one response for all colours: their mean
        return [map_at(place, np.mean([a.reshape(-1) for a in arrays], axis=0), shape)]
    values = arrays[0]
    middle = float(np.median(values))
    if place is PASSED:
        values = values - 1
    elif place in (AMPLITUDE, GAIN):
        values = values / middle - 1 if middle > 0 else values * 0
    else:
        values = values - middle
    return [map_at(place, values, shape)]


def map_at(
    place: Place, values: NDArray[np.float64], shape: tuple[int, int], weight: float = 0.0
) -> ProbeMap:
    """A map of a place from the values on a probe's nodes.

    Parameters
    ----------
    shape : (int, int), pixels
        Of the camera or the panel.
    """
    if place is GRAY:
        return ProbeMap(place, values, (0, 0), (0.0, 0.0), weight)
    if place.spread == "pixels":
        # The maps' corners are the corner pixels' centres.
        return ProbeMap(place, values, shape, ((shape[0] - 1) / 2, (shape[1] - 1) / 2), weight)
    outside = outside_band(values.shape)
    rows, columns = (slice(k, n - k) for k, n in zip(outside, values.shape, strict=True))
    reach = [PUPIL_EXTENT * (1 - 2 * k / (n - 1)) for k, n in zip(outside, values.shape, strict=True)]
    return ProbeMap(place, values[rows, columns], (0, 0), (reach[0], reach[1]), weight)


def outside_band(nodes: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of the pupil's nodes on each side that lie beyond the panel's band."""
    rows, columns = (round((n - 1) / 2 * (1 - 1 / PUPIL_EXTENT)) for n in nodes)
    return rows, columns
