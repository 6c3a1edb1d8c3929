"""A model as the text of its TOML file: written for a person to read and edit.

Numbers are written with all their digits, so reading gives the same model back. Arrays that are too long for a text
are given to the caller to store, under the name ``effect.parameter.value``.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, bench_tables
from trainer.effects.definition import Effect, Parameter
from trainer.effects.effect_catalogue import BUILT_IN
from trainer.model.model import EffectInstance, Model
from trainer.prediction.free_stages import LEARNED
from trainer.prediction.panel_field import NAME

LONGEST = 128  # numbers of an array that stay in the text: every built-in map and curve does
WIDTH = 110
APART = "apart"  # key of an effect whose values each colour has for itself
MAP, CURVE = "map", "curve"  # keys of an effect's free form
RESPONSE = "camera_response"  # the table that says how far it is known

Store = Callable[[str, np.ndarray], str]


def model_text(model: Model, about: Mapping[str, Any] | None, store: Store) -> str:
    """The TOML of a model, without the table that names the file of its long arrays.

    Parameters
    ----------
    about : mapping or None
        Free text, numbers and lists on where the model comes from.
    store : callable
        `(name, array) -> name`, called for each array of more than LONGEST numbers.
    """
    parts = [_head(), *_about(about), _bench(model.bench)]
    parts.append(f"[propagation]\nmethod = {literal(model.method)}")
    if model.gain:
        parts.append(
            "\n".join(
                [
                    "# Camera counts a unit of irradiance and millisecond, by channel; every fit sets them.",
                    "[gain]",
                    *(f"{key(c)} = {literal(float(g))}" for c, g in model.gain.items()),
                ]
            )
        )
    if model.response_known_to is not None:
        parts.append(
            "# The camera's response was fitted up to this share of full scale; for more light, it goes straight on.\n"
            f"[{RESPONSE}]\nknown_to = {literal(float(model.response_known_to))}"
        )
    parts += [_effect(p, model.bench, store) for p in model.present]
    if model.panel_field is not None:
        parts.append(_panel_field(model, store))
    parts += [_learned(stage, maps, store) for stage, maps in model.learned.items()]
    parts += [table_text("[[history]]", record) for record in model.history]
    return "\n\n".join(parts) + "\n"


def allowed(parameter: Parameter) -> str:
    """The physical range of a parameter in words, with its unit."""
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    low, high = parameter.low, parameter.high
    if math.isinf(low) and math.isinf(high):
        return f"any number{', in' + unit if unit else ''}"
    if math.isinf(high):
        return f"{low:g}{unit} or more"
    if math.isinf(low):
        return f"{high:g}{unit} or less"
    return f"{low:g} to {high:g}{unit}"


def literal(value: Any) -> str:
    """TOML for text, a truth value, a number, a list or a table; entries that are None are left out.

    Raises
    ------
    InputError
        For a value of any other type.
    """
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, str):
        text = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else _escape(c) for c in text) + '"'
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, np.ndarray):
        return literal(value.tolist())
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(literal(v) for v in value if v is not None) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key(k)} = {literal(v)}" for k, v in value.items() if v is not None) + " }"
    raise InputError(
        f"a {type(value).__name__} cannot be written to a model file: use text, numbers and lists of them"
    )


def key(name: str) -> str:
    """A TOML key: bare where it can be."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else literal(str(name))


def table_text(header: str, values: Mapping[str, Any]) -> str:
    """A table of plain values."""
    return "\n".join([header, *(f"{key(k)} = {literal(v)}" for k, v in values.items() if v is not None)])


def comment(text: str) -> list[str]:
    """Text as comment lines."""
    return [f"# {line}" for line in textwrap.wrap(" ".join(text.split()), WIDTH - 2)]


def per_channel_rows(parameter: Parameter, array: np.ndarray, bench: Bench) -> list[tuple[str, np.ndarray]]:
    """What an array's rows are called in the file: one "" where the parameter is not a colour's own."""
    if not parameter.per_channel:
        return [("", array)]
    return [(c.name, row) for c, row in zip(bench.channels, array, strict=True)]


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _head() -> str:
    return "\n".join(
        [
            *comment(
                "A model of a bench: what bench.toml says, then the effects that were found, in the order "
                "in which they were added. Values may be edited; 'error' is one standard error and is for "
                "reading only. Take an [[effect]] out to be without it."
            ),
            "schema = 1",
        ]
    )


def _about(about: Mapping[str, Any] | None) -> list[str]:
    return [table_text("[about]", about)] if about else []


def _bench(bench: Bench) -> str:
    tables = bench_tables(bench)
    parts = [
        "# The bench as bench.toml has it. A model serves capture sets of this bench.\n"
        f"[bench]\nname = {literal(tables['name'])}"
    ]
    for name in ("panel", "channel", "propagation", "iris", "camera"):
        rows = tables[name]
        header = f"[[bench.{name}]]" if isinstance(rows, list) else f"[bench.{name}]"
        parts += [table_text(header, row) for row in (rows if isinstance(rows, list) else [rows])]
    return "\n\n".join(parts)


def _effect(present: EffectInstance, bench: Bench, store: Store) -> str:
    effect = present.effect
    lines = comment(f"{effect.about} [{effect.stage}]")
    if (effect.in_common or effect) not in BUILT_IN:
        lines += comment(f"Not built in: name its file, {Path(effect.source).name}, with --effects.")
    lines += ["[[effect]]", f"name = {literal(effect.name)}"]
    order = f"order = {present.order}"
    if len(effect.orders) > 1:
        order += f"  # one of {', '.join(map(str, effect.orders))}; each order has its own number of terms"
    lines.append(order)
    if effect.in_common is not None:
        lines.append(f"{APART} = true  # each colour has values of its own")
    if present.nodes is not None and effect.free_form is not None:
        form, (rows, columns) = effect.free_form, present.nodes.shape[-2:]
        name = store(f"{effect.name}.{form.form}", np.asarray(present.nodes, np.float64))
        unit = "" if form.unit == "1" else f", in {form.unit}"
        nodes = f"{columns} nodes of a cubic" if form.curve else f"{rows} x {columns} nodes of a bicubic"
        nodes = f"for each colour {nodes}" if present.nodes.ndim == 3 else nodes
        lines.append(
            f"{form.form} = {{ array = {literal(name)} }}  # goes on where the polynomials end: {nodes} spline{unit}"
        )
    for parameter in effect.parameters:
        lines += ["", *_parameter(present, parameter, bench, store)]
    return "\n".join(lines)


def _panel_field(model: Model, store: Store) -> str:
    """Maps of a number a pixel are never text."""
    about = (
        "What the captures say of the wave at the panel beyond the effects, a number a pixel. Take the table "
    )
    assert model.panel_field is not None
    named = {name: {"array": store(f"{NAME}.{name}", surface)} for name, surface in model.panel_field.items()}
    return "\n".join([*comment(about + "out to be without it."), table_text(f"[{NAME}]", named)])


def _learned(stage: str, maps: Mapping[str, np.ndarray], store: Store) -> str:
    named = {name: {"array": store(f"{LEARNED}.{stage}.{name}", array)} for name, array in maps.items()}
    about = f"Learned at the {stage}, without a name, after the effects. Take the table out to be without it."
    return "\n".join([*comment(about), table_text(f"[{LEARNED}.{stage}]", named)])


def _parameter(present: EffectInstance, parameter: Parameter, bench: Bench, store: Store) -> list[str]:
    effect, value = present.effect, present.values[parameter.name]
    _check(effect, parameter, value, present.order, bench)
    about = f"{parameter.about}; " if parameter.about else ""
    lines = comment(f"{about}{allowed(parameter)}; absent at {parameter.absent_value(bench):g}")
    lines.append(f"[effect.parameters.{key(parameter.name)}]")
    lines += _numbers(effect, parameter, "value", value, bench, store)
    if present.errors is not None and parameter.name in present.errors:
        lines += _numbers(effect, parameter, "error", present.errors[parameter.name], bench, store)
    return [*lines, f"unit = {literal(parameter.unit)}"]


def _numbers(
    effect: Effect, parameter: Parameter, what: str, array: np.ndarray, bench: Bench, store: Store
) -> list[str]:
    array = np.asarray(array, dtype=np.float64)
    if array.size > LONGEST:
        name = store(f"{effect.name}.{parameter.name}.{what}", array)
        return [f"{what} = {{ array = {literal(name)} }}"]
    lines: list[str] = []
    for channel, row in per_channel_rows(parameter, array, bench):
        name = f"{what}.{key(channel)}" if channel else what
        lines += _row(name, row)
    return lines


def _row(name: str, row: np.ndarray) -> list[str]:
    if row.ndim == 0:
        return [f"{name} = {literal(float(row))}"]
    numbers: Sequence[str] = [literal(float(v)) for v in row]
    line = f"{name} = [{', '.join(numbers)}]"
    if len(line) <= WIDTH:
        return [line]
    wrapped = textwrap.wrap(", ".join(numbers), WIDTH - 4, break_long_words=False, break_on_hyphens=False)
    return [f"{name} = [", *(f"    {w}" for w in wrapped), "]"]


def _check(effect: Effect, parameter: Parameter, value: np.ndarray, order: int, bench: Bench) -> None:
    """What is written must be what can be read."""
    where = f"{effect.name}.{parameter.name}"
    shape = parameter.shape(order, bench)
    if np.shape(value) != shape:
        raise InputError(
            f"{where} has shape {np.shape(value)}, but order {order} has {shape}: the model is not written"
        )
    if not (
        np.all(np.isfinite(value)) and np.all(value >= parameter.low) and np.all(value <= parameter.high)
    ):
        raise InputError(f"{where} is outside {allowed(parameter)}: the model is not written")
