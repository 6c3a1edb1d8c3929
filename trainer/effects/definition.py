"""What an effect is: a name, the stage it belongs to, its physical parameters, and one function.

The function takes the stage without the effect and the parameters as tensors, and returns the stage with the effect.
Screening, fitting, the report, export and the headset need nothing more.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench
from trainer.effects.docstring import effect_text
from trainer.effects.free_form import FreeForm
from trainer.formatting import UNIT_SUFFIX

STAGES = ("drive", "panel", "pupil", "sensor")
ACTS_ON = ("display", "camera")
COLOURS = ("alike", "apart", "either")


@dataclass(frozen=True)
class Parameter:
    """One physical parameter of an effect.

    Attributes
    ----------
    name : str
        Without a unit.
    unit : str
        As printed; "1" for a pure number.
    scale : float
        A change of this size is small but visible; fits step in units of it.
    absent : float or callable
        Value at which the effect is not there: a number, or a function of the bench.
    low, high : float
        Physical range, inclusive.
    count : int or callable
        0 for a single number; otherwise how many numbers, or a function of the effect's order.
    per_channel : bool
        One value (or row of values) for each colour.
    even : bool
        The effect depends on the square of this parameter, so its derivative at `absent` is zero.
    starts : tuple of float
        Values from which fits start, where the derivative at `absent` does not reach far; () for `absent` alone.
    about : str
        What it is, in a few words.
    blocks : int
        Equal parts of the numbers, each with its lowest terms first (2 for a field of displacements).
    typical : (float, float) or None
        What real benches show; the range of a slider. None: 20 scales about `absent`, within `low` and `high`.
    example : float or tuple of float or None
        A value, or the first terms, with which the effect is easy to see. None: left absent.
    terms : callable or None
        Names of the numbers, a function of the effect's order, as `count` is. None: their numbers from 1.
    per_pixel : bool
        One number for each of the camera's pixels, which the effect measures and no fit moves.
    """

    name: str
    unit: str
    scale: float
    absent: float | Callable[[Bench], float] = 0.0
    low: float = -np.inf
    high: float = np.inf
    count: int | Callable[[int], int] = 0
    per_channel: bool = False
    even: bool = False
    starts: tuple[float, ...] = ()
    about: str = ""
    blocks: int = 1
    typical: tuple[float, float] | None = None
    example: float | tuple[float, ...] | None = None
    terms: Callable[[int], tuple[str, ...]] | None = None
    per_pixel: bool = False

    def absent_value(self, bench: Bench) -> float:
        """The value at which the effect is not there, on this bench."""
        return float(self.absent(bench) if callable(self.absent) else self.absent)

    def shape(self, order: int, bench: Bench) -> tuple[int, ...]:
        """Shape of the parameter's values for an order, on a bench."""
        if self.per_pixel:
            return bench.camera.shape
        row = (self.count(order),) if callable(self.count) else (self.count,) if self.count else ()
        return (*((len(bench.channels),) if self.per_channel else ()), *row)

    @property
    def key(self) -> str:
        """Name with its unit, as files and JSON have it."""
        unit = UNIT_SUFFIX.get(self.unit, self.unit)
        return f"{self.name}_{unit}" if unit else self.name


@dataclass(frozen=True)
class Effect:
    """A named physical effect.

    Attributes
    ----------
    name : str
    stage : str
        One of STAGES.
    acts_on : str
        "display" where the eye sees it too, "camera" where only the camera does.
    about : str
        One line.
    parameters : tuple of Parameter
    apply : callable
        `(stage, **parameters) -> stage`.
    orders : tuple of int
        Orders of a map or curve that fits try, lowest first; (0,) where there is only one.
    starts : callable, optional
        `(evidence) -> list of {parameter: value}`: starting points estimated from the captures.
    touches_iris : bool
        The effect may open the iris beyond what the bench states.
    rugged : bool
        Derivatives do not reach far anywhere, so a pattern search comes before a fit.
    measure : callable, optional
        `(evidence) -> {parameter: value}`: values measured on the captures after all else is fitted.
    source : str
        "built in", or the file that defines it.
    takes_order : bool
        `apply` takes the effect's order as the keyword `order`.
    takes_moment : bool
        `apply` takes when a capture was taken as the keyword `moment`: the effect changes from capture to capture.
    same_as : str
        The effect that it equals in captures of one colour and plane, where it is no candidate; "" for none.
    rare : bool
        Few benches have it: an effect that captures cannot tell it from is named before it.
    colours : str
        On a bench of several colours: "alike", one value serves all; "apart", each has its own; "either", as captures
        say.
    in_common : Effect or None
        Where each colour has its own values: the effect with one for all. See `apart`.
    free_form : FreeForm or None
        How the effect's map or curve goes on where its polynomials end.
    formula : str
        LaTeX, without dollar signs; "" where none is given.
    description : str
        One or two sentences on what it is and where it comes from.
    references : tuple of str
        Papers, standards and books.
    """

    name: str
    stage: str
    acts_on: str
    about: str
    parameters: tuple[Parameter, ...]
    apply: Callable[..., Any]
    orders: tuple[int, ...] = (0,)
    starts: Callable[..., list[dict[str, Any]]] | None = None
    touches_iris: bool = False
    rugged: bool = False
    measure: Callable[..., dict[str, Any]] | None = None
    source: str = "built in"
    takes_order: bool = False
    takes_moment: bool = False
    same_as: str = ""
    rare: bool = False
    colours: str = "alike"
    in_common: Effect | None = None
    free_form: FreeForm | None = None
    formula: str = ""
    description: str = ""
    references: tuple[str, ...] = ()

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(p for p in self.parameters if p.name == name)


def apart(one: Effect) -> Effect:
    """The same effect with values for each colour, where it has them for all together."""
    if one.in_common is not None:
        return one
    parameters = tuple(p if p.per_pixel else replace(p, per_channel=True) for p in one.parameters)
    return replace(one, parameters=parameters, in_common=one)


def effect(
    *,
    stage: str,
    acts_on: str | None = None,
    parameters: list[Parameter],
    orders: tuple[int, ...] = (0,),
    starts: Callable[..., list[dict[str, Any]]] | None = None,
    touches_iris: bool = False,
    rugged: bool = False,
    measure: Callable[..., dict[str, Any]] | None = None,
    told_to: str | None = None,
    same_as: str = "",
    rare: bool = False,
    colours: str = "alike",
    free_form: FreeForm | None = None,
    formula: str = "",
) -> Callable[[Callable[..., Any]], Effect]:
    """Make an effect of a function: its name is the function's, its description the docstring's first line.

    The function takes the stage, then its parameters in their order. A keyword-only argument `order` receives the
    effect's order, and `moment` when the capture was taken (`trainer.captures.capture_table.Moment`). The docstring's
    further paragraphs are the effect's description, and its section `References` its references.

    Parameters
    ----------
    stage, acts_on, parameters, orders, starts, touches_iris, rugged, measure, same_as, rare, colours, free_form,
    formula
        As in `Effect`.
    told_to : str, optional
        The former name of `acts_on`.

    Returns
    -------
    callable
        A decorator that makes an `Effect` of a function.

    Raises
    ------
    InputError
        Where `stage`, `acts_on` or `colours` is unknown, a parameter has no range, or the parameters do not fit the
        function.
    """
    acted_on = acts_on or told_to

    def make(function: Callable[..., Any]) -> Effect:
        name = getattr(function, "__name__", "effect")
        if stage not in STAGES:
            raise InputError(f"effect '{name}': stage '{stage}' is not one of {', '.join(STAGES)}")
        if acted_on not in ACTS_ON:
            raise InputError(f"effect '{name}': acts_on '{acted_on}' is not one of {', '.join(ACTS_ON)}")
        if colours not in COLOURS:
            raise InputError(f"effect '{name}': colours '{colours}' is not one of {', '.join(COLOURS)}")
        if not parameters:
            raise InputError(f"effect '{name}': give it at least one Parameter")
        for p in parameters:
            if not p.low < p.high:
                raise InputError(
                    f"effect '{name}': Parameter '{p.name}': make low {p.low:g} less than high {p.high:g}"
                )
        arguments = list(inspect.signature(function).parameters.values())[1:]
        given = {a.name for a in arguments if a.kind is a.KEYWORD_ONLY} & {"order", "moment"}
        taken = [a.name for a in arguments if a.name not in given]
        named = [p.name for p in parameters]
        if taken != named:
            raise InputError(
                f"effect '{name}': the function takes ({', '.join(taken)}) after the stage, its parameters are "
                f"({', '.join(named)}); make them the same, in the same order"
            )
        text = effect_text(function)
        own = function.__module__.startswith("trainer.effects.")
        source = "built in" if own else inspect.getsourcefile(function) or "built in"
        return Effect(
            name,
            stage,
            acted_on,
            text.about,
            tuple(parameters),
            function,
            orders,
            starts,
            touches_iris,
            rugged,
            measure,
            source,
            "order" in given,
            "moment" in given,
            same_as,
            rare,
            colours,
            None,
            free_form,
            formula.strip(),
            text.description,
            text.references,
        )

    return make
