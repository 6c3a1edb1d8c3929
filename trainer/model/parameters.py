"""Parameters of an effect in a model, for people and for JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from trainer.captures.bench_file import Bench
from trainer.effects.definition import Parameter
from trainer.formatting import measured
from trainer.model.model import EffectInstance


def json_values(present: EffectInstance, bench: Bench) -> dict[str, dict[str, Any]]:
    """{name with unit: {"value", "error", "unit"}}; per-channel values by channel name, maps of pixels left out.

    An error is None before a fit, and NaN where the captures do not determine the value.
    """
    result = {}
    for p in present.effect.parameters:
        if p.per_pixel:
            continue
        errors = None if present.errors is None else present.errors[p.name]
        result[p.key] = {
            "value": _plain(p, present.values[p.name], bench),
            "error": None if errors is None else _plain(p, errors, bench),
            "unit": p.unit,
        }
    return result


def _plain(parameter: Parameter, values: np.ndarray, bench: Bench) -> Any:
    if parameter.per_channel:
        return {c.name: values[k].tolist() for k, c in enumerate(bench.channels)}
    return values.tolist()


def _rms(errors: np.ndarray) -> float:
    """Root mean square of the errors of those values that have one; NaN where none has."""
    known = errors[np.isfinite(errors)]
    return float(np.sqrt((known**2).mean())) if known.size else float("nan")


def describe(present: EffectInstance, bench: Bench) -> str:
    """The effect's parameters that differ from "absent", with units and errors, in one line."""
    words = []
    for p in present.effect.parameters:
        if p.per_pixel:
            continue
        values = present.values[p.name]
        errors = np.zeros_like(values) if present.errors is None else present.errors[p.name]
        label = p.name.replace("_", " ")
        away = values - p.absent_value(bench)
        if values.size == 0 or not np.any(np.abs(away) > 1e-12):
            continue
        if values.ndim == 0:
            words.append(f"{label} {measured(float(values), float(errors), p.unit)}")
        elif p.per_channel and values.ndim == 1:
            for k, channel in enumerate(bench.channels):
                name = f"{label} " if len(bench.channels) == 1 else f"{label} ({channel.name}) "
                words.append(f"{name}{measured(float(values[k]), float(errors[k]), p.unit)}")
        else:
            size, error = float(np.sqrt((away**2).sum())), _rms(errors)
            of_each = ", each colour its own" if present.effect.in_common is not None else ""
            words.append(f"{label} {measured(size, error, p.unit)} in {values.size} terms{of_each}")
    if present.nodes is not None and present.effect.free_form is not None:
        form, (rows, columns) = present.effect.free_form, present.nodes.shape[-2:]
        grid = f"{columns}" if form.curve else f"{rows} x {columns}"
        each = " for each colour" if present.nodes.ndim == 3 else ""
        words.append(f"order {present.order} and a {form.form} of {grid} nodes{each}")
    return ", ".join(words) or "at its absent values"
