"""Facts of bench.toml that captures cannot tell from a fitted distance, wavelength or stray light.

Near the axis, light from a panel of pixels arrives by wavelength x distance / pitch^2 alone. So at one plane a wrong
distance, wavelength or pixel pitch is one number. Another plane tells a distance that is off by the same length
everywhere from the other two; a second colour tells one wrong wavelength from a wrong pitch. Stray light that is the
same everywhere adds counts as a wrong black level does; captures at several exposures tell the two apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainer.captures.bench_file import Bench
from trainer.captures.camera_numbers import equal_depth
from trainer.captures.capture_set import CaptureSet
from trainer.formatting import measured, number
from trainer.model.model import Model

PLANES = (0.6, 1.6)  # proposed planes, as shares of the stated distance
ALIKE = 3.0  # standard errors up to which two colours are off in the same proportion
LEAST = 1e-4  # a proportion closer to 1 says nothing of the facts
FLAT = (
    0.9  # share of stray light's counts, squared, that is the same everywhere where it may be the black level
)


@dataclass(frozen=True)
class EqualFact:
    """A fact of bench.toml that would explain the captures as well as a fitted effect.

    Attributes
    ----------
    fact : str
        table.key of bench.toml.
    stated, value : float
        As stated, and as it would have to be; in the key's unit.
    error : float
        Standard error of `value`, from the fitted effect's; 0 where it has none.
    """

    fact: str
    stated: float
    value: float
    error: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """Keys `fact`, `stated`, `value` and `error`."""
        return dict(vars(self))

    def __str__(self) -> str:
        value = measured(self.value, self.error) if self.error else number(self.value, 4)
        return f"{self.fact} = {value} instead of {self.stated:g}"


@dataclass(frozen=True)
class EqualFacts:
    """Facts of bench.toml that would explain captures as well as one effect of a model does.

    Attributes
    ----------
    effect : str
        "distance", "wavelength" or "stray_light"; "" for none.
    facts : tuple of EqualFact
        Empty for none.
    planes_mm : tuple of float, mm
        Of the captures.
    told : bool
        The captures tell that it is the fact.
    """

    effect: str = ""
    facts: tuple[EqualFact, ...] = ()
    planes_mm: tuple[float, ...] = ()
    told: bool = False

    @property
    def sentence(self) -> str:
        """Which facts, in one sentence; "" for none."""
        if not self.facts:
            return ""
        facts = " or ".join(map(str, self.facts))
        if self.told:
            return f"The same counts are added at every exposure: bench.toml should have {facts}."
        if self.effect == "distance":
            return f"At one plane this distance cannot be told from {facts} in bench.toml."
        words = "stray light" if self.effect == "stray_light" else "the wavelength"
        return f"Instead of {words}, bench.toml may err in {facts}: that is the same here."

    @property
    def deciding_captures(self) -> list[str]:
        """Captures that would tell which fact it is, as sentences."""
        if self.told:
            return []
        if self.effect == "stray_light":
            return [
                "one capture with the laser off: what it shows is the black level, not stray light",
                "the same pattern at another exposure: light grows with it, and a black level does not",
            ]
        if not self.facts or len(self.planes_mm) > 1:
            return []
        near, far = (f"{self.planes_mm[0] * share:.3g}" for share in PLANES)
        return [
            f"the same patterns at {near} mm or {far} mm: a wrong distance, and a wrong wavelength or pitch, differ "
            "there"
        ]


def equal_facts(model: Model, captures: CaptureSet) -> EqualFacts:
    """Facts that would explain the captures as well as the model's distance, wavelength or stray light does."""
    bench, planes = model.bench, captures.planes
    if "distance" in model.names and len(planes) == 1 and planes[0]:
        ratio = 1 + float(model.instance("distance").values["offset"]) / planes[0]
        if abs(ratio - 1) < LEAST or ratio <= 0:
            return EqualFacts()
        error = _relative_error(model, "distance", planes[0])
        facts = (*_wavelengths(bench, captures, ratio, error), _pitch(bench, ratio, error))
        return EqualFacts("distance", facts, planes)
    if "wavelength" in model.names:
        common = _common_ratio(model, captures)
        if common is None or abs(common - 1) < LEAST:
            return EqualFacts()
        stated, error = (
            bench.distance_mm,
            _relative_error(model, "wavelength", bench.channels[0].wavelength_nm),
        )
        distance = EqualFact("propagation.distance_mm", stated, stated * common, stated * error)
        facts = (_pitch(bench, common, error), distance)
        return EqualFacts("wavelength", facts, planes)
    if "stray_light" in model.names:
        return _black_level(model, planes)
    return EqualFacts()


def _black_level(model: Model, planes: tuple[float, ...]) -> EqualFacts:
    """The black level that would explain stray light which is nearly the same everywhere, or at every exposure."""
    present, camera = model.instance("stray_light"), model.bench.camera
    if present.effect.in_common is not None:  # one camera has one black level for all colours
        return EqualFacts()
    counts = np.atleast_1d(present.values["counts"])
    told = present.errors is not None and bool(
        np.isfinite(present.errors["constant"])
    )  # by several exposures
    flat = float(counts[0]) ** 2 >= FLAT * float((counts**2).sum())
    name = "constant" if told else "counts"
    same, error = (
        0.0 if v is None else float(np.atleast_1d(v[name])[0]) for v in (present.values, present.errors)
    )
    if not (told or flat) or abs(same) <= ALIKE * error:
        return EqualFacts()
    stated = float(camera.black_level)
    fact = EqualFact("camera.black_level", stated, stated + same, error)
    return EqualFacts("stray_light", (fact,), planes, told)


def _relative_error(model: Model, name: str, stated: float) -> float:
    """Standard error of a fitted offset as a share of what is stated; the largest of several, 0 without errors."""
    errors = model.instance(name).errors
    return 0.0 if errors is None else float(np.nanmax(errors["offset"], initial=0.0)) / abs(stated)


def _wavelengths(bench: Bench, captures: CaptureSet, ratio: float, error: float) -> list[EqualFact]:
    used = [c for c in bench.channels if c.name in captures.channels]
    if len(used) > 1:  # every one would have to be off in the same proportion
        return []
    stated = used[0].wavelength_nm
    return [EqualFact("channel.wavelength_nm", stated, stated * ratio, stated * error)]


def _pitch(bench: Bench, ratio: float, error: float) -> EqualFact:
    stated = bench.panel.pitch_um
    return EqualFact(
        "panel.pitch_um", stated, stated / math.sqrt(ratio), 0.5 * stated * error / math.sqrt(ratio) ** 3
    )


def _common_ratio(model: Model, captures: CaptureSet) -> float | None:
    """By which all used colours' wavelengths are off alike; None where they differ."""
    present = model.instance("wavelength")
    rows = [k for k, c in enumerate(model.bench.channels) if c.name in captures.channels]
    stated = np.array([model.bench.channels[k].wavelength_nm for k in rows])
    ratios = 1 + present.values["offset"][rows] / stated
    errors = np.zeros(len(rows)) if present.errors is None else present.errors["offset"][rows] / stated
    spread = np.abs(ratios - ratios.mean())
    return float(ratios.mean()) if (spread <= ALIKE * errors + 1e-12).all() else None


def camera_facts(captures: CaptureSet) -> tuple[EqualFact, ...]:
    """Facts of bench.toml's camera that repeated captures contradict, each with the value that they show."""
    stated, used = captures.bench.camera, captures.noise_camera()
    if used == stated or not stated.noise_stated:
        return ()
    facts = [
        EqualFact(f"camera.{key}", getattr(stated, key), getattr(used, key))
        for key in ("full_well_e", "read_noise_e")
    ]
    depth = equal_depth(stated, used)
    return (*facts, *([] if depth is None else [EqualFact("camera.bit_depth", stated.bit_depth, depth)]))
