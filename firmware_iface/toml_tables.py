"""Reading one TOML table into a frozen dataclass, with errors that name the key.

A field made with `parameter` carries its range and what it means; `read_table` enforces names and ranges.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from firmware_iface.errors import InputError, nearest

T = TypeVar("T")


def parameter(
    default: Any = dataclasses.MISSING,
    about: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    choices: tuple[Any, ...] = (),
) -> Any:
    """A dataclass field with a meaning and a range.

    Parameters
    ----------
    default : object
        Without it, the key is required.
    about : str
        What the value means, for messages.
    low, high : float
        Range, inclusive.
    choices : tuple
        Where given, the only values allowed.
    """
    metadata = {"about": about, "low": low, "high": high, "choices": choices}
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def read_table(cls: type[T], table: Mapping[str, Any], where: str, ignore: tuple[str, ...] = ()) -> T:
    """Build `cls` from a TOML table.

    Parameters
    ----------
    cls : type
        A dataclass whose fields were made with `parameter`.
    table : mapping
        As read from TOML.
    where : str
        How to name the table in an error, for example "[panel] of bench.toml".
    ignore : tuple of str
        Keys of the table that are not fields.

    Returns
    -------
    cls

    Raises
    ------
    InputError
        For an unknown or missing key, a wrong type, or a value out of range.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    if not isinstance(table, Mapping):
        raise InputError(f"{where} is not a table; write it as a table of key = value lines.")
    for key in table:
        if key not in fields and key not in ignore:
            raise InputError(f"{where} has an unknown key '{key}'; {nearest(key, fields)}")
    values: dict[str, Any] = {}
    for name, f in fields.items():
        if name in table:
            values[name] = checked(f, table[name], where)
        elif f.default is dataclasses.MISSING:
            raise InputError(f"{where} lacks the key '{name}'; add {name} = ... ({f.metadata['about']}).")
    return cls(**values)


def check_instance(instance: Any, where: str) -> None:
    """Check the types and ranges of a dataclass made in code.

    Raises
    ------
    InputError
        As `read_table` does.
    """
    for f in dataclasses.fields(instance):
        if f.metadata:
            checked(f, getattr(instance, f.name), where)


def checked(f: dataclasses.Field[Any], value: Any, where: str) -> Any:
    """The value of one field, converted to its declared type.

    Raises
    ------
    InputError
        Where it does not fit.
    """
    kind = str(f.type)
    name = f"'{f.name}' in {where}"
    if kind == "float":
        value = _number(value, name)
    elif kind == "int":
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{name} is {value!r}; give a whole number.")
    elif kind == "bool":
        if not isinstance(value, bool):
            raise InputError(f"{name} is {value!r}; give true or false.")
    elif kind == "str":
        if not isinstance(value, str):
            raise InputError(f"{name} is {value!r}; give a text in quotes.")
    elif kind == "tuple[float, ...]":
        if not isinstance(value, list | tuple):
            raise InputError(f"{name} is {value!r}; give a list of numbers.")
        value = tuple(_number(v, name) for v in value)
    choices = f.metadata.get("choices", ())
    if choices and value not in choices:
        raise InputError(f"{name} is {value!r}; use one of " + ", ".join(map(repr, choices)) + ".")
    low, high = f.metadata.get("low", -math.inf), f.metadata.get("high", math.inf)
    if kind in ("float", "int") and not low <= value <= high:
        raise InputError(f"{name} is {value!r}; give a value from {low:g} to {high:g}.")
    return value


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} is {value!r}; give a finite number.")
    return float(value)
