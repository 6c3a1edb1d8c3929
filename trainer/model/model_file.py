"""Model files: TOML that a person reads and edits, with long arrays beside it as safetensors.

Reading is strict and says which key is wrong and what is allowed there. Writing is whole or not at all: long
arrays go to a file of their own name first, and the TOML, which names it with its SHA-256, takes its place
last.
"""

from __future__ import annotations

import hashlib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from firmware_iface.errors import InputError, nearest
from runtime.bundle.whole_files import whole_file
from runtime.lightpath.propagation import METHODS
from trainer.captures.bench_file import Bench, bench_tables, read_bench
from trainer.effects.definition import Parameter
from trainer.effects.effect_catalogue import Catalogue, find_effect
from trainer.model.model import EffectInstance, Model
from trainer.model.model_text import allowed, model_text, table_text
from trainer.prediction.panel_field import NAME, UNITS

SCHEMA = 1
_TOP = ("schema", "about", "arrays", "bench", "propagation", "gain", "effect", NAME, "history")
_COMPARED = ("panel", "channel", "iris", "camera")

Arrays = Mapping[str, np.ndarray]


def write_model(path: Path | str, model: Model, about: Mapping[str, Any] | None = None) -> None:
    """Write a model, whole or not at all, over one that is there.

    about : free text, numbers and lists on where the model comes from, kept in the table [about]
    Entries of `about` and of the history that are None are left out. Raises InputError if the file cannot be
    written, or a value is outside its physical range.
    """
    path = Path(path)
    arrays: dict[str, np.ndarray] = {}

    def store(name: str, array: np.ndarray) -> str:
        arrays[name] = np.ascontiguousarray(array)
        return name

    text = model_text(model, about, store)
    used, before = "", _array_file(path)
    if arrays:
        data = safetensors.numpy.save(arrays)
        digest = hashlib.sha256(data).hexdigest()
        used = _name_for(path, data, digest)
        with whole_file(path.with_name(used)) as binary:
            binary.write(data)
        table = table_text("[arrays]", {"file": used, "sha256": digest})
        text = text.replace("schema = 1\n", f"schema = 1\n\n# Arrays too long for a text.\n{table}\n", 1)
    with whole_file(path, "w") as stream:
        stream.write(text)
    if before and before != used:
        with suppress(OSError):
            path.with_name(before).unlink()


def read_model(path: Path | str, known: Catalogue, bench: Bench | None = None) -> Model:
    """The model of a file.

    known : effects by name
    bench : the capture set's; the model's must have the same panel, channels, iris and camera
    Raises InputError, naming the key and what is allowed, if the file cannot be read or anything in it does
    not fit.
    """
    path = Path(path)
    tables = _tables(path)
    try:
        model = _model(tables, known, path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if bench is not None:
        _compare(path, model.bench, bench)
    return model


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise InputError(
            f"model {path} cannot be read ({error.strerror}): give the path of a model's TOML"
        ) from None
    except (ValueError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise InputError(f"{path} is not TOML ({reason}): correct that line") from None


def _model(tables: Mapping[str, Any], known: Catalogue, path: Path) -> Model:
    _only(tables, _TOP, "")
    schema = tables.get("schema")
    if type(schema) is not int or schema != SCHEMA:
        raise InputError(f"schema is {_shown(schema)}: this reader knows schema = {SCHEMA}")
    bench = _bench(tables.get("bench"))
    arrays = _arrays(path, tables["arrays"]) if "arrays" in tables else {}
    _plain(_table(tables.get("about", {}), "about"), "about")
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
    return Model(bench, tuple(present), gain, _method(tables), tuple(history), learned)


def _panel_field(given: Any, bench: Bench, arrays: Arrays) -> dict[str, np.ndarray]:
    """The maps of the panel's learned field, each a finite number a pixel."""
    table = _table(given, NAME)
    _only(table, UNITS, f"{NAME}.")
    maps = {}
    for name in UNITS:
        entry = table.get(name)
        array = _array(entry, f"{NAME}.{name}", arrays)
        if array is None:
            raise InputError(
                f"{NAME}.{name} is {_shown(entry)}: write {{ array = ... }}, or take [{NAME}] out"
            )
        if array.shape != bench.panel.shape or not np.isfinite(array).all():
            raise InputError(
                f"{NAME}.{name} is not a finite number for each of the panel's {bench.panel.height} x "
                f"{bench.panel.width} pixels: learn the field again"
            )
        maps[name] = array.astype(np.float32)
    return maps


def _array(given: Any, where: str, arrays: Arrays) -> np.ndarray | None:
    """The array that an entry names; None where it names none."""
    if not (isinstance(given, Mapping) and list(given) == ["array"] and isinstance(given["array"], str)):
        return None
    if given["array"] not in arrays:
        raise InputError(
            f"{where} names the array {_shown(given['array'])}: {nearest(given['array'], arrays)}"
        )
    return arrays[given["array"]]


def _bench(given: Any) -> Bench:
    table = _table(given, "bench")
    if "schema" in table:
        raise InputError("bench.schema is not known: take it out, the file's own schema covers it")
    try:
        return read_bench({"schema": 1, **table})
    except InputError as error:
        raise InputError(f"bench: {str(error).replace('bench.toml', '[bench]')}") from None


def _method(tables: Mapping[str, Any]) -> str:
    table = _table(tables.get("propagation"), "propagation")
    _only(table, ("method",), "propagation.")
    method = table.get("method")
    if method not in METHODS[:2]:
        raise InputError(f"propagation.method is {_shown(method)}: write one of {', '.join(METHODS[:2])}")
    return str(method)


def _gain(given: Any, bench: Bench) -> dict[str, float]:
    table = _table(given, "gain")
    _only(table, [c.name for c in bench.channels], "gain.")
    gain = {}
    for channel, value in table.items():
        gain[channel] = _number(value, f"gain.{channel}", "a finite number above 0")
        if not 0 < gain[channel] < math.inf:
            raise InputError(f"gain.{channel} is {_shown(value)}: write a finite number above 0")
    return gain


def _effect(
    row: Mapping[str, Any], number: int, known: Catalogue, bench: Bench, arrays: Arrays
) -> EffectInstance:
    name = row.get("name")
    if not isinstance(name, str):
        raise InputError(f"effect {number} has name {_shown(name)}: write the name of an effect, as text")
    try:
        effect = find_effect(known, name)
    except InputError as error:
        raise InputError(f"{error}; an effect that is not built in needs its file, with --effects") from None
    _only(row, ("name", "order", "parameters"), f"effect '{name}': ")
    order = row.get("order")
    if type(order) is not int or order not in effect.orders:
        orders = ", ".join(map(str, effect.orders))
        raise InputError(f"effect '{name}': order is {_shown(order)}: write one of {orders}")
    given = _table(row.get("parameters"), f"effect '{name}': parameters")
    _only(given, [p.name for p in effect.parameters], f"effect '{name}': parameters.")
    values: dict[str, np.ndarray] = {}
    errors: dict[str, np.ndarray] = {}
    for p in effect.parameters:
        where = f"{name}.{p.name}"
        table = _table(given.get(p.name), where)
        _only(table, ("value", "error", "unit"), f"{where}.")
        if table.get("unit") != p.unit:
            raise InputError(
                f"{where}.unit is {_shown(table.get('unit'))}: write '{p.unit}', and the value in it"
            )
        values[p.name] = _numbers(table.get("value"), f"{where}.value", p, order, bench, arrays)
        if "error" in table:
            errors[p.name] = _numbers(table["error"], f"{where}.error", p, order, bench, arrays)
    return EffectInstance(effect, order, values, errors or None)


def _numbers(
    given: Any, where: str, parameter: Parameter, order: int, bench: Bench, arrays: Arrays
) -> np.ndarray:
    """The numbers of a value or an error, of the shape that the order asks for."""
    shape = parameter.shape(order, len(bench.channels))
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
                f"{where} is {_shown(given)}: write one a channel, as {where.split('.')[-1]}.{names[0]} = ..."
            )
        _only(given, names, f"{where}.")
        array = np.array(
            [_row(given.get(n), f"{where}.{n}", shape[1:], order, parameter, is_value) for n in names]
        )
    else:
        array = np.array(_row(given, where, shape, order, parameter, is_value))
    _in_range(array, where, parameter, is_value)
    return array.reshape(shape)


def _row(
    given: Any, where: str, shape: tuple[int, ...], order: int, parameter: Parameter, is_value: bool
) -> Any:
    kind = f"{allowed(parameter)}" if is_value else "a number from 0 on"
    if not shape:
        return _number(given, where, kind)
    if not isinstance(given, list) or len(given) != shape[0]:
        found = f"{len(given)} numbers" if isinstance(given, list) else _shown(given)
        raise InputError(f"{where} is {found}: order {order} has a list of {shape[0]}, each {kind}")
    return [_number(v, f"{where}[{i}]", kind) for i, v in enumerate(given)]


def _in_range(array: np.ndarray, where: str, parameter: Parameter, is_value: bool) -> None:
    if is_value:
        wrong = ~(np.isfinite(array) & (array >= parameter.low) & (array <= parameter.high))
    else:
        wrong = array < 0  # not a number: the data say nothing of it
    if wrong.any():
        kind = allowed(parameter) if is_value else "a number from 0 on"
        raise InputError(f"{where} is {float(array[wrong].reshape(-1)[0]):g}: write {kind}")


def _arrays(path: Path, given: Any) -> Arrays:
    table = _table(given, "arrays")
    _only(table, ("file", "sha256"), "arrays.")
    name, digest = table.get("file"), table.get("sha256")
    if not isinstance(name, str) or not re.fullmatch(r"[^/\\\0]+\.safetensors", name):
        raise InputError(
            f"arrays.file is {_shown(name)}: write the name of a .safetensors file beside the model"
        )
    if not isinstance(digest, str):
        raise InputError(f"arrays.sha256 is {_shown(digest)}: write the file's SHA-256 as text")
    try:
        data = path.with_name(name).read_bytes()
    except OSError as error:
        raise InputError(
            f"arrays.file {name} cannot be read ({error.strerror}): put it beside the model"
        ) from None
    if hashlib.sha256(data).hexdigest() != digest.lower():
        raise InputError(
            f"arrays.file {name} is not the one that was written: its SHA-256 differs, put that one back"
        )
    try:
        return safetensors.numpy.load(data)
    except (SafetensorError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"arrays.file {name} is not a safetensors file of numbers ({_shown(error)})"
        ) from None


def _compare(path: Path, model: Bench, captures: Bench) -> None:
    ours, theirs = bench_tables(model), bench_tables(captures)
    for table in _COMPARED:
        a, b = ours[table], theirs[table]
        if a == b:
            continue
        if isinstance(a, list):
            what, first, second = "the channels are", _channels(a), _channels(b)
        else:
            key = next(k for k in {**a, **b} if a.get(k) != b.get(k))
            what, first, second = f"{table}.{key} is", _shown(a.get(key)), _shown(b.get(key))
        raise InputError(
            f"{path} is a model of another bench: {what} {first} there and {second} in the capture set's "
            "bench.toml; use a model of this bench, or correct the one that is wrong"
        )


def _channels(rows: Iterable[Mapping[str, Any]]) -> str:
    return " + ".join(f"{row['name']} {row['wavelength_nm']:g} nm" for row in rows)


def _array_file(path: Path) -> str:
    """The arrays' file, of the name that this module gives, that a model already there uses; "" for none."""
    try:
        name = _tables(path).get("arrays", {}).get("file", "")
    except (InputError, AttributeError):
        return ""
    pattern = re.escape(path.stem) + r"(-[0-9a-f]{8})?\.safetensors"
    return name if isinstance(name, str) and re.fullmatch(pattern, name) else ""


def _name_for(path: Path, data: bytes, digest: str) -> str:
    """`<stem>.safetensors`, or one with part of the hash where that name is another's: nothing is written
    over.
    """
    plain = path.with_name(f"{path.stem}.safetensors")
    try:
        free = not plain.exists() or plain.read_bytes() == data
    except OSError:
        free = False
    return plain.name if free else f"{path.stem}-{digest[:8]}.safetensors"


def _table(given: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        what = "missing" if given is None else _shown(given)
        raise InputError(f"{where} is {what}: write the table [{where.split(': ')[-1]}]")
    return given


def _rows(tables: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    rows = tables.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise InputError(f"{name} is {_shown(rows)}: write [[{name}]] with two brackets, once for each")
    return rows


def _only(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    names = list(known)
    for key in table:
        if key not in names:
            raise InputError(f"{where}{key[:60]!s} is not known: {nearest(key, names)}")


def _number(given: Any, where: str, kind: str) -> float:
    if isinstance(given, (int, float)) and not isinstance(given, bool):
        with suppress(OverflowError):
            return float(given)
    raise InputError(f"{where} is {_shown(given)}: write {kind}")


def _plain(value: Any, where: str) -> None:
    """Text, truth values, numbers, lists and tables only."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            _plain(part, f"{where}.{name[:60]}")
    elif isinstance(value, list):
        for part in value:
            _plain(part, where)
    elif not isinstance(value, (str, bool, int, float)):
        raise InputError(f"{where} is {_shown(value)}: write text, a number, or a list of them")


def _shown(value: Any) -> str:
    if value is None:
        return "missing"
    try:
        return " ".join(repr(value).split())[:60]
    except ValueError:  # a whole number too long to print
        return "a number too long to print"
