"""Numbers, names and parameters as text for people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

TERMS = 4  # parameters with more numbers than this are summarised, and listed on demand
UNITLESS = ("1", "")
# Units at the end of a name in files; other units stand there unchanged.
UNIT_SUFFIX = {"1": "", "%": "percent", "pixels": "px", "share of band": "share", "waves": "waves"}

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class ParameterText:
    """A parameter as it is printed.

    Attributes
    ----------
    name, text : str
        Its name as words, and its value in one line.
    terms : tuple of str
        Every number, where the line only summarises them.
    """

    name: str
    text: str
    terms: tuple[str, ...] = ()


def number(value: Any, digits: int = 3) -> str:
    """A number with some significant digits; a dash for None and for a number that is not finite."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    power = math.floor(math.log10(abs(value)))
    if power < -4 or power > 6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{_minus(mantissa)} × 10{superscript(int(exponent))}"
    text = f"{value:.{max(0, digits - 1 - power)}f}"
    return _minus(text)


def percent(share: Any, digits: int = 3) -> str:
    """A share as per cent."""
    return "–" if share is None or not math.isfinite(share) else f"{number(100 * share, digits)} %"


def change_of(step: Mapping[str, Any]) -> str:
    """What a step of a ladder changed, with names as in a model file; "" for the start.

    Parameters
    ----------
    step : mapping
        A step of `explain --json` or a record of a model's history: `added`, `removed`, and `refined` with `form`,
        where given.
    """
    signs = (("+", "added"), ("−", "removed"), (f"{step.get('form', 'map')} of", "refined"))
    return " ".join(f"{sign} {step[key]}" for sign, key in signs if step.get(key))


def measured(value: Any, error: Any = None, unit: str = "") -> str:
    """A value with its standard error, rounded to the error's second digit, and unit."""
    tail = "" if unit in UNITLESS else f" {unit}"
    if value is None or not math.isfinite(value):
        return "–"
    if error is None or not math.isfinite(error) or error <= 0:
        return number(value) + tail
    power = math.floor(math.log10(error))
    if power < -5 or abs(value) >= 1e7:
        return f"{number(value, 4)} ± {number(error, 2)}{tail}"
    places = max(0, 1 - power)
    return f"{_minus(f'{value:.{places}f}')} ± {error:.{places}f}{tail}"


def parameters(given: Any) -> list[ParameterText]:
    """The parameters of an effect, one line each.

    Parameters
    ----------
    given : mapping or None
        {name: {"value", "error", "unit"}} or {name: value}. A value is a number, a list, or {colour: number or list}.
    """
    lines = []
    fitted = any(_has_error(one) for one in (given or {}).values())
    for name, one in (given or {}).items():
        entry = one if isinstance(one, Mapping) and "value" in one else {"value": one}
        value, error, unit = entry["value"], entry.get("error"), str(entry.get("unit") or "")
        label = _label(str(name), unit)
        if isinstance(value, Mapping):
            for colour, own in value.items():
                own_error = error.get(colour) if isinstance(error, Mapping) else None
                lines.append(_parameter(f"{label}, {colour}", own, own_error, unit, fitted))
        elif isinstance(value, int | float | list | tuple | np.ndarray):
            lines.append(_parameter(label, value, error, unit, fitted))
        elif value is not None:
            lines.append(ParameterText(label, str(value)))
    return lines


def _has_error(entry: Any) -> bool:
    """Whether a parameter's value, or one of its values, has a standard error."""
    error = entry.get("error") if isinstance(entry, Mapping) else None
    own = list(error.values()) if isinstance(error, Mapping) else [error]
    return any(bool(np.isfinite(np.asarray(one, dtype=float)).any()) for one in own if one is not None)


def _label(name: str, unit: str) -> str:
    """The name as words, without the unit that files put at its end."""
    suffix = UNIT_SUFFIX.get(unit, unit)
    return plain(name.removesuffix(f"_{suffix}") if suffix else name)


def _parameter(label: str, value: Any, error: Any, unit: str, fitted: bool) -> ParameterText:
    """A parameter's line; `fitted`: other parameters of the effect have errors."""
    values = np.atleast_1d(np.asarray(value, dtype=float)).ravel()
    errors = np.full(values.shape, np.nan)
    if error is not None:
        given = np.atleast_1d(np.asarray(error, dtype=float)).ravel()
        errors = given if given.shape == values.shape else errors
    terms = [measured(float(v), float(e)) for v, e in zip(values, errors, strict=True)]
    tail = "" if unit in UNITLESS else f" {unit}"
    if len(terms) == 0:
        return ParameterText(label, "–")
    if fitted and not values.any() and not np.isfinite(errors).any():
        return ParameterText(label, "not told by these captures")
    if len(terms) <= TERMS:
        return ParameterText(label, ", ".join(terms) + tail)
    largest = int(np.argmax(np.abs(values)))
    size = math.sqrt(float(np.sum(values**2)))
    text = f"{len(terms)} terms, together {number(size)}{tail}; largest, no. {largest + 1}: {terms[largest]}"
    return ParameterText(label, text + tail, tuple(terms))


def listed(names: Any) -> str:
    """Names as in a sentence: a, b and c."""
    names = [str(n) for n in names]
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1] if names else ""


def plain(name: Any) -> str:
    """An effect's name as words."""
    return str(name).replace("_", " ")


def sentence(text: str) -> str:
    """With a capital letter at its start."""
    return text[:1].upper() + text[1:]


def superscript(exponent: int) -> str:
    """A whole number as an exponent."""
    return str(exponent).translate(_SUPERSCRIPT)


def _minus(text: str) -> str:
    return text.replace("-", "−")
