"""Open a simulated bench by its name or by the path of its TOML file."""

from __future__ import annotations

import tomllib
from pathlib import Path

from firmware_iface.errors import InputError
from firmware_iface.virtual.bench_description import BenchDescription, read_bench
from firmware_iface.virtual.named_benches import named_bench


def load_bench(spec: str) -> BenchDescription:
    """A bench by name or from a file.

    Parameters
    ----------
    spec : str
        `virtual:NAME` (see `named_benches`) or the path of a TOML file.

    Returns
    -------
    BenchDescription

    Raises
    ------
    InputError
        Where there is no such bench, or the file does not describe one.
    """
    if spec.startswith("virtual:"):
        return named_bench(spec.removeprefix("virtual:"))
    path = Path(spec)
    if not path.is_file():
        raise InputError(f"there is no bench '{spec}'; give virtual:NAME or the path of a TOML file.")
    try:
        with path.open("rb") as file:
            tables = tomllib.load(file)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name} is not TOML ({error}); correct that place.") from error
    return read_bench(tables, path.name)
