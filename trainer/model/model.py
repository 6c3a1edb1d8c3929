"""A model of a bench: what the bench file says, and the effects that have been added to it, in order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from trainer.captures.bench_file import Bench
from trainer.effects.definition import Effect, apart
from trainer.effects.own_effect import parameters_of
from trainer.prediction.panel_field import NAME

Values = dict[str, np.ndarray]


@dataclass(frozen=True)
class EffectInstance:
    """An effect in a model.

    Attributes
    ----------
    effect : Effect
    order : int
        Of its map or curve.
    values : dict of float64 arrays
        By parameter, in the parameter's unit.
    errors : dict of float64 arrays or None
        Standard errors, shaped as `values`; None where nothing was fitted.
    nodes : float64 array [m, n], [colours, m, n] or None
        Of the free-form map, maps or curves that are added to the polynomials, in the unit of the effect's `free_form`.
    """

    effect: Effect
    order: int
    values: Values
    errors: Values | None = None
    nodes: np.ndarray | None = None

    def is_plainer_than(self, other: EffectInstance) -> bool:
        """Whether it is the other one's plain form, less rare, or has half of its numbers."""
        if other.effect.same_as == self.effect.name or other.effect.rare > self.effect.rare:
            return True
        return self.effect.measure is None and 2 * self.numbers <= other.numbers

    @property
    def numbers(self) -> int:
        """How many numbers it has, without those that a fit found the captures to say nothing of."""
        fitted = self.errors if self.errors is not None and self.effect.measure is None else {}
        unknown = sum(int(np.isnan(errors).sum()) for errors in fitted.values())
        return sum(values.size for values in self.values.values()) - unknown

    def with_values(self, values: Mapping[str, np.ndarray]) -> EffectInstance:
        """The same with other values, without errors."""
        return replace(self, values=dict(values), errors=None)


@dataclass(frozen=True)
class Model:
    """A model of a bench's light path.

    Attributes
    ----------
    bench : Bench
    present : tuple of EffectInstance
        Effects in the order in which they were added.
    gain : mapping
        Camera counts a unit of irradiance and millisecond, by channel; empty before anything was fitted.
    method : str
        Of propagation.
    history : tuple of dict
        One record a step: what was added, and the held-out errors after it.
    panel_field : mapping or None
        Maps of the panel's learned field by name, float32 [m, n]; None where nothing was learned.
    learned : mapping
        What was learned at other stages, by stage and name (`trainer.prediction.free_stages`); float32 arrays.
    response_known_to : float or None
        Where the camera's response is bent: the brightest light that it was fitted to, as a share of full scale.
    """

    bench: Bench
    present: tuple[EffectInstance, ...] = ()
    gain: Mapping[str, float] = field(default_factory=dict)
    method: str = "angular_spectrum"
    history: tuple[dict[str, Any], ...] = ()
    panel_field: Mapping[str, np.ndarray] | None = None
    learned: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    response_known_to: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects that are present."""
        return tuple(p.effect.name for p in self.present)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of all that a network learns beyond: the effects, the learned field, what was learned at stages."""
        field_name = () if self.panel_field is None else (NAME,)
        return (*self.names, *field_name, *(f"learned_{stage}" for stage in self.learned))

    @property
    def in_time(self) -> bool:
        """Whether an effect changes from capture to capture with the moment when each was taken."""
        return any(p.effect.takes_moment for p in self.present)

    def instance(self, name: str) -> EffectInstance:
        """The effect of that name, as it is in the model."""
        return next(p for p in self.present if p.effect.name == name)

    def without(self, name: str) -> Model:
        """The model with one effect left out; the others keep their values."""
        return replace(self, present=tuple(p for p in self.present if p.effect.name != name))

    def having(self, added: EffectInstance) -> Model:
        """The model with an effect added, or put in the place of one of the same name."""
        others = tuple(p for p in self.present if p.effect.name != added.effect.name)
        if len(others) == len(self.present):
            return replace(self, present=(*self.present, added))
        return replace(
            self, present=tuple(added if p.effect.name == added.effect.name else p for p in self.present)
        )


def absent(effect: Effect, bench: Bench, order: int | None = None) -> EffectInstance:
    """The effect at the values at which it changes nothing, at its lowest order unless another is given.

    An effect of the lasers has values for each of several colours.
    """
    order = effect.orders[0] if order is None else order
    if effect.colours == "apart" and len(bench.channels) > 1:
        effect = apart(effect)
    with parameters_of(effect):
        values = {
            p.name: np.full(p.shape(order, bench), p.absent_value(bench), dtype=np.float64)
            for p in effect.parameters
        }
    return EffectInstance(effect, order, values)


def instance_with(
    effect: Effect, bench: Bench, values: Mapping[str, ArrayLike], order: int | None = None
) -> EffectInstance:
    """The effect with some values given, held within their physical range; parameters not named stay absent.

    Parameters
    ----------
    values : mapping of str to number or array
        By parameter name; one number stands for all of a parameter's numbers.
    order : int, optional
        The effect's lowest order without it.
    """
    base = absent(effect, bench, order)
    full = dict(base.values)
    for name, value in values.items():
        p, shape = base.effect.parameter(name), base.values[name].shape
        held = np.clip(np.asarray(value, dtype=float), p.low, p.high)
        full[name] = np.array(
            held.reshape(shape) if held.size == math.prod(shape) else np.broadcast_to(held, shape)
        )
    return base.with_values(full)


def raised(present: EffectInstance, bench: Bench, order: int) -> EffectInstance:
    """The same effect at a higher order: known terms kept, new ones absent.

    Terms are ordered lowest first within each colour's row and within each of the parameter's blocks.
    """
    higher = absent(present.effect, bench, order)
    values = {}
    for p in present.effect.parameters:
        old, new = present.values[p.name], higher.values[p.name].copy()
        source, target = old.reshape(-1), new.reshape(-1)
        rows = (len(bench.channels) if p.per_channel else 1) * p.blocks
        if new.ndim == 0 or p.per_pixel:
            new = old.copy()
        elif source.size:
            length, longer = source.size // rows, target.size // rows
            for k in range(rows):
                target[k * longer : k * longer + length] = source[k * length : (k + 1) * length]
        values[p.name] = new
    return replace(higher, values=values, nodes=present.nodes)
