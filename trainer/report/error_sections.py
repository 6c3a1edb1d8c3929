"""A report's sections on the error: numbers, measured and predicted pictures, and where the error lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from trainer.formatting import number, percent
from trainer.report.charts import failure_chart
from trainer.report.failure_plots import brightness_plot, frequency_plot, time_plot
from trainer.report.heat_maps import (
    LARGEST,
    HeatMap,
    from_zero,
    heat_map,
    place,
    symmetric,
)
from trainer.report.palettes import DIFFERENCE, ERROR, IRRADIANCE

DETAIL = 160  # side, pixels, of the piece of a large picture that is shown pixel by pixel


def facts(compared: Any, heldout: Any, found: Any) -> list[tuple[str, str, str]]:
    """The numbers at the head of the page: (what it is, value, what it means)."""
    rows: list[tuple[str, str, str]] = []
    if heldout:
        nrmse, noise = heldout["nrmse"], heldout["noise_nrmse"]
        times = f"{number(nrmse / noise, 2)} times the noise" if nrmse and noise else ""
        rows.append(("held-out error", percent(nrmse), times))
        rows.append(("camera noise alone", percent(noise), "what no model can remove"))
        rows.append(("excess", number(heldout["excess"]), "0 is perfect"))
    if compared and compared.get("psnr_db") is not None:
        rows.append(("PSNR", f"{number(compared['psnr_db'])} dB", "against the camera's full scale"))
    if compared and compared.get("noise_from_repeats") is not None:
        ratio = compared["noise_from_repeats"]
        agrees = "agrees with bench.toml" if 0.8 < ratio < 1.25 else "bench.toml's noise is off"
        rows.append(("noise seen in repeats", f"{number(ratio)} ×", agrees))
    if compared and compared.get("budget"):
        rows += _budget(compared["budget"])
    if found and found.get("ideal_excess") is not None and not compared:
        rows.append(("excess of the ideal model", number(found["ideal_excess"]), "bench.toml alone"))
    return rows


def _budget(budget: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """The parts of the ideal model's error; the network's only where there is one."""
    words = {
        "named_physics": "named physics explains",
        "network": "what was learned explains",
        "noise": "the camera's noise is",
        "unexplained": "unexplained",
    }
    total = sum(budget.values())
    return [
        (words[name], percent(part / total), "of the ideal model's squared error")
        for name, part in budget.items()
        if name != "network" or part
    ]


def pictures(compared: Sequence[Any]) -> list[dict[str, Any]]:
    """Measured, predicted and difference of each capture, the first two on one scale."""
    groups = []
    for number_of, p in enumerate(compared):
        what = f"capture {p.capture}, {p.channel}, {p.plane_mm:g} mm"
        error = "" if p.excess is None else f"error {percent(p.nrmse)}, excess {number(p.excess)}"
        groups.append({"heading": what, "note": error, "maps": _triple(p, what, None)})
        if number_of == 0 and max(p.measured.shape) > LARGEST:
            top, left = _worst(p.difference, DETAIL)
            note = "where the difference is largest, pixel by pixel"
            maps = _triple(p, what, (top, left))
            groups.append({"heading": f"detail of {what}", "note": note, "maps": maps})
    return groups


def _triple(p: Any, what: str, corner: tuple[int, int] | None) -> list[HeatMap]:
    extent, arrays = None, [p.measured, p.predicted, p.difference]
    if corner is not None:
        top, left = corner
        arrays = [a[top : top + DETAIL, left : left + DETAIL] for a in arrays]
        extent = (float(top), float(left), float(arrays[0].shape[0]), float(arrays[0].shape[1]))
    light, apart = from_zero(arrays[:2]), symmetric(arrays[2:])
    rms = float(np.sqrt(np.nanmean(arrays[2] ** 2))) if np.isfinite(arrays[2]).any() else float("nan")
    saturated = float(np.mean(~np.isfinite(arrays[2])))
    lost = f"; {percent(saturated, 2)} saturated, gray" if saturated else ""
    size = min(arrays[2].shape) // 4
    y, x = _worst(arrays[2], size)
    where = place((y + size / 2) / arrays[2].shape[0], (x + size / 2) / arrays[2].shape[1])
    maps = []
    for name, array in zip(("measured", "predicted"), arrays, strict=False):
        alt = (
            f"{name.capitalize()} picture of {what}: mean {number(float(array.mean()))} counts, brightest in "
            f"the {_brightest(array)}; same colour scale as its neighbour, 0 to {number(light[1])} counts."
        )
        maps.append(heat_map(name, array, alt, "counts above black", light, IRRADIANCE, extent))
    alt = (
        f"Measured less predicted for {what}: rms {number(rms)} counts, largest in the {where}; colours are "
        f"symmetric about zero, to ± {number(apart[1])} counts{lost}."
    )
    note = f"rms {number(rms)} counts, own scale, symmetric about 0{lost}"
    title = "measured − predicted"
    maps.append(heat_map(title, arrays[2], alt, "counts", apart, DIFFERENCE, extent, note=note))
    return maps


def _worst(difference: np.ndarray, size: int) -> tuple[int, int]:
    """Corner of the size x size piece, on a grid of half that, with the largest squared difference."""
    height, width = difference.shape
    size = max(1, min(size, height, width))
    squared = np.where(np.isfinite(difference), difference, 0).astype(np.float64) ** 2
    total = np.zeros((height + 1, width + 1))
    total[1:, 1:] = squared.cumsum(0).cumsum(1)
    rows, columns = (np.arange(0, n - size + 1, max(1, size // 2)) for n in (height, width))
    sums = (
        total[np.ix_(rows + size, columns + size)]
        - total[np.ix_(rows, columns + size)]
        - total[np.ix_(rows + size, columns)]
        + total[np.ix_(rows, columns)]
    )
    i, j = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return int(rows[i]), int(columns[j])


def _brightest(array: np.ndarray) -> str:
    size = max(1, min(array.shape) // 4)
    y, x = _worst(np.sqrt(np.maximum(array, 0)), size)
    return place((y + size / 2) / array.shape[0], (x + size / 2) / array.shape[1])


def where(compared: dict[str, Any], shape: tuple[int, int] | None) -> dict[str, Any] | None:
    """The error over the field, over frequency, brightness and time, and by colour and plane."""
    if not compared.get("where"):
        return None
    parts = compared["where"]
    columns = {
        key: [{"name": name, **row} for name, row in compared.get(key, {}).items()]
        for key in ("by_channel", "by_plane")
    }
    everything = [r["excess"] for rows in columns.values() for r in rows if r["excess"] is not None]
    made = (("frequency", frequency_plot), ("brightness", brightness_plot), ("time", time_plot))
    plots = [make(parts[key]) for key, make in made if parts.get(key)]
    return {
        "field": _field(parts, shape),
        "plots": [(plot, failure_chart(plot)) for plot in plots],
        "by_channel": columns["by_channel"],
        "by_plane": columns["by_plane"] if len(columns["by_plane"]) > 1 else [],
        "longest": max([*everything, 1e-9]),
        "captures": compared.get("by_capture") or [],
    }


def _field(parts: dict[str, Any], shape: tuple[int, int] | None) -> tuple[HeatMap, str] | None:
    """The map of excess over the field, and a sentence on it."""
    if not parts.get("field"):
        return None
    grid = np.array([[np.nan if v is None else v for v in row] for row in parts["field"]], dtype=float)
    if not np.isfinite(grid).any():
        return None
    tile = parts.get("tile_px") or 1
    height, width = shape or (grid.shape[0] * tile, grid.shape[1] * tile)
    i, j = np.unravel_index(int(np.nanargmax(grid)), grid.shape)
    middle, worst = float(np.nanmedian(grid)), float(grid[i, j])
    at = f"row {min(int((i + 0.5) * tile), height)}, column {min(int((j + 0.5) * tile), width)}"
    spot = f"{place((i + 0.5) / grid.shape[0], (j + 0.5) / grid.shape[1])} ({at})"
    if middle > 0 and worst < 4 * middle:
        words = "the error is spread over the whole picture: "
        words += f"median excess {number(middle)}, at worst {number(worst)} in the {spot}."
    else:
        words = f"the error is largest in the {spot}: excess {number(worst)} there, median {number(middle)}."
    alt = f"Excess over the picture in tiles of {tile} pixels, dark is small: {words}"
    top = float(np.nanmax(grid))
    picture = heat_map(
        "excess by place",
        grid,
        alt,
        "excess",
        (0.0, top if top > 0 else 1e-6),
        ERROR,
        (0.0, 0.0, float(height), float(width)),
        note=f"tiles of {tile} × {tile} pixels; their mean is the excess of the whole",
    )
    return picture, words
