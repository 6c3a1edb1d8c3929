"""Model files: TOML that a person reads and edits, with long arrays next to it as safetensors.

Reading is strict. Writing is whole or not at all: long arrays are written first, to a file of a new name, and the
TOML, which names that file with its SHA-256, is replaced last.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file
from trainer.captures.bench_file import Bench, bench_tables
from trainer.effects.effect_catalogue import Catalogue
from trainer.model.model import Model
from trainer.model.model_tables import Arrays, model_of, only_keys, shown, table_at
from trainer.model.model_text import model_text, table_text

_COMPARED = ("panel", "channel", "iris", "camera")


def write_model(path: Path | str, model: Model, about: Mapping[str, Any] | None = None) -> None:
    """Write a model, whole or not at all, replacing one that is there.

    Parameters
    ----------
    about : mapping, optional
        Free text, numbers and lists on where the model comes from, for the table [about]. Entries that are None are
        left out, here and in the history.

    Raises
    ------
    InputError
        If the file cannot be written, or a value is outside its physical range.
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

    Parameters
    ----------
    known : Catalogue
        Effects by name.
    bench : Bench, optional
        The capture set's; the model's must have the same panel, channels, iris and camera.

    Raises
    ------
    InputError
        If the file cannot be read or anything in it does not fit; it names the key and what is allowed.
    """
    path = Path(path)
    tables = _tables(path)
    try:
        model = model_of(tables, known, partial(_arrays, path))
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


def _arrays(path: Path, given: Any) -> Arrays:
    table = table_at(given, "arrays")
    only_keys(table, ("file", "sha256"), "arrays.")
    name, digest = table.get("file"), table.get("sha256")
    if not isinstance(name, str) or not re.fullmatch(r"[^/\\\0]+\.safetensors", name):
        raise InputError(
            f"arrays.file is {shown(name)}: write the name of a .safetensors file next to the model"
        )
    if not isinstance(digest, str):
        raise InputError(f"arrays.sha256 is {shown(digest)}: write the file's SHA-256 as text")
    try:
        data = path.with_name(name).read_bytes()
    except OSError as error:
        raise InputError(
            f"arrays.file {name} cannot be read ({error.strerror}): put it next to the model"
        ) from None
    if hashlib.sha256(data).hexdigest() != digest.lower():
        raise InputError(
            f"arrays.file {name} is not the one that was written: its SHA-256 differs, put that one back"
        )
    try:
        return safetensors.numpy.load(data)
    except (SafetensorError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"arrays.file {name} is not a safetensors file of numbers ({shown(error)})"
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
            what, first, second = f"{table}.{key} is", shown(a.get(key)), shown(b.get(key))
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
    """`<stem>.safetensors`, or one with part of the hash where that name is taken: no file is overwritten."""
    plain = path.with_name(f"{path.stem}.safetensors")
    try:
        free = not plain.exists() or plain.read_bytes() == data
    except OSError:
        free = False
    return plain.name if free else f"{path.stem}-{digest[:8]}.safetensors"
