"""A model from the tables of its TOML file, checked strictly: each error names the key and what is allowed there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from runtime.lightpath.propagation import METHODS
from trainer.captures.bench_file import Bench, read_bench
from trainer.effects.definition import Effect, Parameter, apart
from trainer.effects.effect_catalogue import Catalogue, find_effect
from trainer.model.model import EffectInstance, Model
from trainer.model.model_text import APART, CURVE, MAP, RESPONSE, allowed
from trainer.prediction.free_stages import LEARNED, LEARNED_STAGES, learned_stage
from trainer.prediction.panel_field import NAME, UNITS

SCHEMA = 1
_TOP = (
    "schema",
    "about",
    "arrays",
    "bench",
    "propagation",
    "gain",
    RESPONSE,
    "effect",
    NAME,
    LEARNED,
    "history",
)

Arrays = Mapping[str, np.ndarray]


def model_of(tables: Mapping[str, Any], known: Catalogue, read_arrays: Callable[[Any], Arrays]) -> Model:
    """The model that a file's tables describe.

    Parameters
    ----------
    tables : mapping
        The whole file.
    known : Catalogue
        Effects by name.
    read_arrays : callable
        Called with the table `arrays`, where there is one; gives the long arrays by name.

    Raises
    ------
    InputError
        Where anything does not fit; it names the key and what is allowed there.
    """
    only_keys(tables, _TOP, "")
    schema = tables.get("schema")
    if type(schema) is not int or schema != SCHEMA:
        raise InputError(f"schema is {shown(schema)}: this reader knows schema = {SCHEMA}")
    bench = _bench(tables.get("bench"))
    arrays = read_arrays(tables["arrays"]) if "arrays" in tables else {}
    _plain(table_at(tables.get("about", {}), "about"), "about")
    present: list[EffectInstance] = []
    for number, row in enumerate(_rows(tables, "effect"), 1):
        one = _effect(row, number, known, bench, arrays)
        if any(p.effect.name == one.effect.name for p in present):
            raise InputError(f"effect {number} is a second '{one.effect.name}': keep one of them")
        present.append(one)
    history = []
    for number, row in enumerate(_rows(tables, "history"), 1):
        _plain(row, f"history {number}")
        history.append(dict(row))
    learned = _panel_field(tables[NAME], bench, arrays) if NAME in tables else None
    gain = _gain(tables.get("gain", {}), bench)
    others = _learned(tables.get(LEARNED, {}), bench, arrays)
    known_to = _response_known_to(tables[RESPONSE]) if RESPONSE in tables else None
    return Model(bench, tuple(present), gain, _method(tables), tuple(history), learned, others, known_to)


def _panel_field(given: Any, bench: Bench, arrays: Arrays) -> dict[str, np.ndarray]:
    """The maps of the panel's learned field, each a finite number a pixel."""
    table = table_at(given, NAME)
    only_keys(table, UNITS, f"{NAME}.")
    maps = {}
    for name in UNITS:
        entry = table.get(name)
        array = _array(entry, f"{NAME}.{name}", arrays)
        if array is None:
            raise InputError(
                f"{NAME}.{name} is {shown(entry)}: write {{ array = ... }}, or take [{NAME}] out"
            )
        if array.shape != bench.panel.shape or not np.isfinite(array).all():
            raise InputError(
                f"{NAME}.{name} is not a finite number for each of the panel's {bench.panel.height} x "
                f"{bench.panel.width} pixels: learn the field again"
            )
        maps[name] = array.astype(np.float32)
    return maps


def _learned(given: Any, bench: Bench, arrays: Arrays) -> dict[str, dict[str, np.ndarray]]:
    """What was learned at stages: arrays of the names and shapes that each stage has."""
    table = table_at(given, LEARNED)
    only_keys(table, LEARNED_STAGES, f"{LEARNED}.")
    found: dict[str, dict[str, np.ndarray]] = {}
    for stage, rows in table.items():
        where = f"{LEARNED}.{stage}"
        shapes = learned_stage(bench, stage).shapes
        only_keys(table_at(rows, where), shapes, f"{where}.")
        found[stage] = {}
        for name, (shape, _) in shapes.items():
            array = _array(rows.get(name), f"{where}.{name}", arrays)
            if array is None or array.shape != shape or not np.isfinite(array).all():
                raise InputError(
                    f"{where}.{name} is not an array of {' x '.join(map(str, shape))} finite numbers: take [{where}] "
                    "out, or learn it again with: hololoop-trainer explain CAPTURES --model MODEL --learn --out NEW"
                )
            found[stage][name] = array.astype(np.float32)
    return found


def _array(given: Any, where: str, arrays: Arrays) -> np.ndarray | None:
    """The array that an entry names; None where it names none."""
    if not (isinstance(given, Mapping) and list(given) == ["array"] and isinstance(given["array"], str)):
        return None
    if given["array"] not in arrays:
        raise InputError(
            f"{where} names the array {shown(given['array'])}: {nearest(given['array'], arrays)}"
        )
    return arrays[given["array"]]


def _bench(given: Any) -> Bench:
    table = table_at(given, "bench")
    if "schema" in table:
        raise InputError("bench.schema is not known: take it out, the file's own schema covers it")
    try:
        return read_bench({"schema": 1, **table})
    except InputError as error:
        raise InputError(f"bench: {str(error).replace('bench.toml', '[bench]')}") from None


def _method(tables: Mapping[str, Any]) -> str:
    table = table_at(tables.get("propagation"), "propagation")
    only_keys(table, ("method",), "propagation.")
    method = table.get("method")
    if method not in METHODS[:2]:
        raise InputError(f"propagation.method is {shown(method)}: write one of {', '.join(METHODS[:2])}")
    return str(method)


def _gain(given: Any, bench: Bench) -> dict[str, float]:
    table = table_at(given, "gain")
    only_keys(table, [c.name for c in bench.channels], "gain.")
    gain = {}
    for channel, value in table.items():
        gain[channel] = _above_0(value, f"gain.{channel}")
    return gain


def _response_known_to(given: Any) -> float:
    table = table_at(given, RESPONSE)
    only_keys(table, ["known_to"], f"{RESPONSE}.")
    return _above_0(table.get("known_to"), f"{RESPONSE}.known_to")


def _above_0(value: Any, where: str) -> float:
    found = _number(value, where, "a finite number above 0")
    if not 0 < found < math.inf:
        raise InputError(f"{where} is {shown(value)}: write a finite number above 0")
    return found


def _effect(
    row: Mapping[str, Any], number: int, known: Catalogue, bench: Bench, arrays: Arrays
) -> EffectInstance:
    name = row.get("name")
    if not isinstance(name, str):
        raise InputError(f"effect {number} has name {shown(name)}: write the name of an effect, as text")
    try:
        effect = find_effect(known, name)
    except InputError as error:
        raise InputError(f"{error}; an effect that is not built in needs its file, with --effects") from None
    only_keys(row, ("name", "order", APART, MAP, CURVE, "parameters"), f"effect '{name}': ")
    if type(row.get(APART, False)) is not bool:
        raise InputError(f"effect '{name}': {APART} is {shown(row[APART])}: write true or false")
    if row.get(APART):
        effect = apart(effect)
    order = row.get("order")
    if type(order) is not int or order not in effect.orders:
        orders = ", ".join(map(str, effect.orders))
        raise InputError(f"effect '{name}': order is {shown(order)}: write one of {orders}")
    given = table_at(row.get("parameters"), f"effect '{name}': parameters")
    only_keys(given, [p.name for p in effect.parameters], f"effect '{name}': parameters.")
    values: dict[str, np.ndarray] = {}
    errors: dict[str, np.ndarray] = {}
    for p in effect.parameters:
        where = f"{name}.{p.name}"
        if p.name not in given:  # the effect had no such parameter when the file was written
            values[p.name] = np.full(p.shape(order, bench), p.absent_value(bench))
            errors[p.name] = np.zeros(p.shape(order, bench))
            continue
        table = table_at(given[p.name], where)
        only_keys(table, ("value", "error", "unit"), f"{where}.")
        if table.get("unit") != p.unit:
            raise InputError(
                f"{where}.unit is {shown(table.get('unit'))}: write '{p.unit}', and the value in it"
            )
        values[p.name] = _numbers(table.get("value"), f"{where}.value", p, order, bench, arrays)
        if "error" in table:
            errors[p.name] = _numbers(table["error"], f"{where}.error", p, order, bench, arrays)
    nodes = None
    for key in (MAP, CURVE):
        if key in row:
            nodes = _nodes(row[key], key, effect, bench, arrays)
    fitted = any("error" in given[name] for name in given)
    return EffectInstance(effect, order, values, errors if fitted else None, nodes)


def _nodes(given: Any, key: str, effect: Effect, bench: Bench, arrays: Arrays) -> np.ndarray:
    """The nodes of an effect's free-form map or curve."""
    where = f"effect '{effect.name}': {key}"
    form = effect.free_form
    if form is None or form.form != key:
        raise InputError(f"{where} is given, and this effect has no {key}: take it out")
    array = _array(given, where, arrays)
    if array is None:
        raise InputError(f"{where} is {shown(given)}: write {{ array = ... }}, or take it out")
    of_each = not form.curve and effect.in_common is not None and array.ndim == 3
    fits = array.ndim == 2 + of_each and array.shape[-1] >= 4 and np.isfinite(array).all()
    fits = fits and (not of_each or array.shape[0] == len(bench.channels))
    if form.curve and not (fits and array.shape[0] in (1, len(bench.channels))):
        raise InputError(
            f"{where} is not a row, or a row a colour, of at least 4 finite numbers: fit it again"
        )
    if not form.curve and not (fits and array.shape[-2] >= 4):
        raise InputError(
            f"{where} is not a table, or with {APART} a table a colour, of at least 4 x 4 finite numbers: fit it again"
        )
    return array.astype(np.float64)


def _numbers(
    given: Any, where: str, parameter: Parameter, order: int, bench: Bench, arrays: Arrays
) -> np.ndarray:
    """The numbers of a value or an error, of the shape that the order asks for."""
    shape = parameter.shape(order, bench)
    is_value = where.endswith(".value")
    array = _array(given, where, arrays)
    if array is not None:
        if array.shape != shape:
            raise InputError(
                f"{where} has shape {array.shape} in the arrays' file: order {order} has {shape}"
            )
        array = array.astype(np.float64)
    elif parameter.per_channel:
        names = [c.name for c in bench.channels]
        if not isinstance(given, Mapping):
            raise InputError(
                f"{where} is {shown(given)}: write one a channel, as {where.split('.')[-1]}.{names[0]} = ..."
            )
        only_keys(given, names, f"{where}.")
        array = np.array(
            [_row(given.get(n), f"{where}.{n}", shape[1:], order, parameter, is_value) for n in names]
        )
    elif isinstance(given, Mapping):
        raise InputError(f"{where} has a value a colour: write one for all, or {APART} = true in the effect")
    else:
        array = np.array(_row(given, where, shape, order, parameter, is_value))
    _in_range(array, where, parameter, is_value)
    return array.reshape(shape)


def _row(
    given: Any, where: str, shape: tuple[int, ...], order: int, parameter: Parameter, is_value: bool
) -> Any:
    expected = f"{allowed(parameter)}" if is_value else "a number from 0 on"
    if not shape:
        return _number(given, where, expected)
    if not isinstance(given, list) or len(given) != shape[0]:
        found = f"{len(given)} numbers" if isinstance(given, list) else shown(given)
        raise InputError(f"{where} is {found}: order {order} has a list of {shape[0]}, each {expected}")
    return [_number(v, f"{where}[{i}]", expected) for i, v in enumerate(given)]


def _in_range(array: np.ndarray, where: str, parameter: Parameter, is_value: bool) -> None:
    if is_value:
        wrong = ~(np.isfinite(array) & (array >= parameter.low) & (array <= parameter.high))
    else:
        wrong = array < 0  # NaN is allowed: the captures do not determine the value
    if wrong.any():
        expected = allowed(parameter) if is_value else "a number from 0 on"
        raise InputError(f"{where} is {float(array[wrong].reshape(-1)[0]):g}: write {expected}")


def table_at(given: Any, where: str) -> Mapping[str, Any]:
    """A value that must be a table; InputError names `where` it is."""
    if not isinstance(given, Mapping):
        what = "missing" if given is None else shown(given)
        raise InputError(f"{where} is {what}: write the table [{where.split(': ')[-1]}]")
    return given


def _rows(tables: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    rows = tables.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError(f"{name} is {shown(rows)}: write [[{name}]] with two brackets, once for each")
    return rows


def only_keys(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Raise InputError where a table has a key that is not known."""
    names = list(known)
    for key in table:
        if key not in names:
            raise InputError(f"{where}{key[:60]!s} is not known: {nearest(key, names)}")


def _number(given: Any, where: str, expected: str) -> float:
    if isinstance(given, (int, float)) and not isinstance(given, bool):
        with suppress(OverflowError):
            return float(given)
    raise InputError(f"{where} is {shown(given)}: write {expected}")


def _plain(value: Any, where: str) -> None:
    """Text, truth values, numbers, lists and tables only."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            _plain(part, f"{where}.{name[:60]}")
    elif isinstance(value, list):
        for part in value:
            _plain(part, where)
    elif not isinstance(value, (str, bool, int, float)):
        raise InputError(f"{where} is {shown(value)}: write text, a number, or a list of them")


def shown(value: Any) -> str:
    """A value as an error message shows it: on one line, not too long."""
    if value is None:
        return "missing"
    try:
        return " ".join(repr(value).split())[:60]
    except ValueError:  # a whole number too long to print
        return "a number too long to print"
