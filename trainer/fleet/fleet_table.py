"""The table of a fleet run, a Parquet file: one row for each fitted number of each set.

Rows are long rather than wide, because effects and the orders of their maps differ from set to set. What is true of a
whole set stands in each of its rows; a set that failed, or whose model has no effect, has one row without an effect.
The file's metadata, under the key "hololoop", says what the run was asked for.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file
from trainer.fleet.set_result import FittedNumber, SetFacts, SetResult

if TYPE_CHECKING:
    import pyarrow as pa

KEY = b"hololoop"
FORMAT = 1
# Columns in their order, with their types. Those of a set come before and after those of a number.
OF_SET = {
    "folder": "string",
    "headset": "string",
    "headset_from": "string",
    "time": "time",
    "time_from": "string",
    "captures": "int32",
    "captures_sha256": "string",
    "model": "string",
    "verdict": "string",
    "excess_before": "float64",
    "excess_after": "float64",
    "noise_nrmse": "float64",
}
OF_NUMBER = {
    "effect": "string",
    "stage": "string",
    "indistinguishable_from": "string",
    "parameter": "string",
    "channel": "string",
    "term": "int32",
    "term_name": "string",
    "value": "float64",
    "error": "float64",
    "absent": "float64",
    "unit": "string",
}
AT_THE_END = {"failed": "string", "warnings": "list", "seconds": "float64", "stamp": "string"}
COLUMNS = {**OF_SET, **OF_NUMBER, **AT_THE_END}
FACTS = ("folder", "headset", "headset_from", "time", "time_from", "stamp")


def write_table(path: Path, results: Sequence[SetResult], settings: Mapping[str, Any]) -> None:
    """Write the results of a run, whole or not at all, replacing a table that is there.

    Parameters
    ----------
    settings : mapping
        What the run was asked for, as JSON can hold it.

    Raises
    ------
    InputError
        Where it cannot be written, or pyarrow is not installed.
    """
    pa, parquet = arrow()
    about = json.dumps({"fleet": FORMAT, "settings": settings}, sort_keys=True)
    schema = _schema(pa).with_metadata({KEY: about.encode()})
    table = pa.Table.from_pylist([row for r in results for row in _rows(r)], schema=schema)
    with whole_file(path) as stream:
        parquet.write_table(table, stream, compression="zstd")


def read_table(path: Path) -> tuple[list[SetResult], dict[str, Any]]:
    """The results in a table that `write_table` wrote, and what the run was asked for.

    Raises
    ------
    InputError
        Where it is no such table, or pyarrow is not installed.
    """
    pa, parquet = arrow()
    wrong = InputError(
        f"--out {path} is there already and is no table of fleet: give another name, or --overwrite to replace it"
    )
    try:
        # As one piece: pyarrow opens a path more than once, and a run may replace the file in between.
        table = parquet.read_table(pa.BufferReader(path.read_bytes()))
        about = json.loads((table.schema.metadata or {})[KEY])
        if about["fleet"] != FORMAT or not table.schema.equals(_schema(pa)):
            raise wrong
        rows = table.to_pylist()
    except (pa.ArrowInvalid, OSError, KeyError, ValueError, TypeError):
        raise wrong from None
    sets: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        sets.setdefault(row["folder"], []).append(row)
    return [_result(group) for group in sets.values()], about["settings"]


def arrow() -> tuple[Any, Any]:
    """pyarrow and its Parquet, which take a moment to import and are not part of the extra `trainer`.

    Raises
    ------
    InputError
        Where they are not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError("fleet writes its table with pyarrow: pip install 'hololoop[cluster]'") from error
    return pyarrow, parquet


def _schema(pa: Any) -> pa.Schema:
    types = {
        "string": pa.string(),
        "int32": pa.int32(),
        "float64": pa.float64(),
        "time": pa.timestamp("us", tz="UTC"),
        "list": pa.list_(pa.string()),
    }
    return pa.schema([(name, types[kind]) for name, kind in COLUMNS.items()])


def _rows(result: SetResult) -> list[dict[str, Any]]:
    common = {**asdict(result.facts)}
    for name in COLUMNS:
        if name not in common and name not in OF_NUMBER:
            common[name] = getattr(result, name)
    common["warnings"] = list(result.warnings)
    alike = dict(result.indistinguishable)
    rows = []
    for number in result.numbers:
        own = asdict(number)
        own["error"] = number.error if math.isfinite(number.error) else None
        rows.append({**common, **own, "indistinguishable_from": alike.get(number.effect)})
    return rows or [common]


def _result(rows: Sequence[Mapping[str, Any]]) -> SetResult:
    first = rows[0]
    numbers = []
    alike: dict[str, str] = {}
    for row in rows:
        if row["effect"] is None:
            continue
        own = {name: row[name] for name in OF_NUMBER if name != "indistinguishable_from"}
        own["error"] = math.nan if own["error"] is None else own["error"]
        numbers.append(FittedNumber(**own))
        if row["indistinguishable_from"]:
            alike[row["effect"]] = row["indistinguishable_from"]
    others = [n for n in (*OF_SET, *AT_THE_END) if n not in FACTS and n != "warnings"]
    return SetResult(
        SetFacts(**{name: first[name] for name in FACTS}),
        warnings=tuple(first["warnings"] or ()),
        numbers=tuple(numbers),
        indistinguishable=tuple(alike.items()),
        **{name: first[name] for name in others},
    )
