"""Open a simulated bench by its name or by the path of its TOML file."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from firmware_iface.virtual.bench_description import BenchDescription, read_bench
from firmware_iface.virtual.defect_kind import Defect
from firmware_iface.virtual.measured_field import MeasuredField, measured_field
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
    if _is_data_sheet(tables):
        raise InputError(
            f"{spec} is the bench.toml of a capture set: it says what is known of a bench, not where its devices are. "
            "Give the headset's configuration (hololoop-runtime serve --help; capture takes this file as --known), or "
            "virtual:NAME; to simulate this bench, add the line [simulation] to a copy."
        )
    bench = read_bench(tables, path.name)
    return replace(bench, defects=tuple(_with_file(d, bench, path.parent) for d in bench.defects))


def _with_file(defect: Defect, bench: BenchDescription, folder: Path) -> Defect:
    """A defect whose file is found from any folder, and can be used with the bench's channels."""
    if not isinstance(defect, MeasuredField) or not defect.file:
        return defect
    found = replace(defect, file=str(folder / defect.file))
    for channel in bench.channels:
        measured_field(found, channel.wavelength_nm, 2, 2)
    return found


def _is_data_sheet(tables: dict[str, Any]) -> bool:
    """Whether the tables are of a capture set's bench.toml, and neither of a simulation nor of a configuration."""
    camera = tables.get("camera")
    measured = "iris" in tables or (isinstance(camera, dict) and "full_well_e" in camera)
    return "schema" in tables and measured and not {"defect", "simulation", "service"} & set(tables)
