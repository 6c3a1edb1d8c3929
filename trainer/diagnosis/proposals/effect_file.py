"""The Python file of a proposed effect: short, readable, and loaded like any file of a user's own effects."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from runtime.bundle.whole_files import whole_file
from trainer.diagnosis.proposals.probe_maps import Place
from trainer.diagnosis.proposals.reading import Number, Reading, Values

WIDTH = 110
DIGITS = 6  # of the starts


def write_effect(path: Path, name: str, place: Place, reading: Reading, values: Values | None = None) -> None:
    """Write an effect's file.

    Parameters
    ----------
    path : Path
    name : str
        Of the effect.
    place : Place
        Where it acts.
    reading : Reading
        What it is.
    values : mapping of str to number or array, optional
        Where fits start, by parameter; without it, what was read off the probe.
    """
    with whole_file(path, "w") as stream:
        stream.write(effect_text(name, place, reading, values))


def effect_text(name: str, place: Place, reading: Reading, values: Values | None = None) -> str:
    """The text of an effect's file, as from `write_effect`."""
    stage = place.stage
    stage_type = stage.capitalize()
    body = [*place.before, *reading.code, *place.after]
    code = "\n".join(body)
    in_time = "moment." in code
    taken = [*(f"{n.name}: Tensor" for n in reading.numbers), *(["*", "moment: Moment"] if in_time else [])]
    arguments = ", ".join(taken)
    imports = ["import math"] if "math." in code else []
    imports += ["from collections.abc import Sequence"]
    imports += ["from dataclasses import replace"] if "replace(" in code else []
    imports += ["from typing import Any"]
    names = ["Parameter", stage_type, "effect", *(["Moment"] if in_time else [])]
    further = []
    for line in reading.imports:
        if line.startswith("from trainer.effects import "):
            names += line.removeprefix("from trainer.effects import ").split(", ")
        else:
            further.append(line)
    names.sort(key=lambda n: (not n[0].isupper(), n))
    torch = ["import torch"] if "torch." in code else []
    lines = [
        f'"""{name}, an effect of the {stage}, as the {stage} probe shows it. Written by hololoop-trainer propose.',
        "",
        *textwrap.wrap(f"What was seen: {reading.describe(values or reading.starts)}.", WIDTH),
        *textwrap.wrap(f"The effect {place.what}.", WIDTH),
        "",
        f"Look for it in captures:  hololoop-trainer explain CAPTURES --effects {name}.py --out model.toml",
        '"""',
        "",
        "from __future__ import annotations",
        "",
        *imports,
        "",
        *torch,
        "from torch import Tensor",
        "",
        *further,
        f"from trainer.effects import {', '.join(names)}",
        "",
        "# Where fits start: read off the probe"
        + ("." if values is None else ", then fitted to the captures."),
        *_seen(reading.numbers, values or {}),
        "",
        "",
        "def _starts(evidence: Sequence[Any]) -> list[dict[str, Any]]:",
        '    """Where fits start."""',
        "    return [SEEN]",
        "",
        "",
        "@effect(",
        f'    stage="{stage}",',
        f'    acts_on="{place.acts_on}",',
        f'    formula=r"{reading.formula}",',
        "    parameters=[",
        *(line for n in reading.numbers for line in _parameter(n)),
        "    ],",
        "    starts=_starts,",
        ")",
        f"def {name}({stage}: {stage_type}, {arguments}) -> {stage_type}:",
        f'    """{reading.about}',
        "",
        *textwrap.wrap(f"It {place.what}.", WIDTH - 4, initial_indent="    ", subsequent_indent="    "),
        '    """',
        code,
        "",
    ]
    return "\n".join(lines)


def _seen(numbers: tuple[Number, ...], values: Values) -> list[str]:
    lines = ["SEEN: dict[str, Any] = {"]
    for n in numbers:
        value = np.asarray(values.get(n.name, n.start), dtype=float)
        if value.ndim == 0:
            lines.append(f'    "{n.name}": {_text(float(value))},')
        else:
            whole = ", ".join(_text(float(v)) for v in value)
            wrapped = textwrap.wrap(whole, WIDTH - 8, initial_indent=" " * 8, subsequent_indent=" " * 8)
            lines += [f'    "{n.name}": [', *wrapped, "    ],"]
    return [*lines, "}"]


def _parameter(n: Number) -> list[str]:
    absent = f"absent={_text(n.absent)}, " if n.absent else ""
    count = f"count={n.size}, " if isinstance(n.start, tuple) else ""
    return [
        "        Parameter(",
        f'            "{n.name}",',
        f'            "{n.unit}",',
        f"            scale={_text(n.scale)},",
        *([f"            {absent.rstrip(', ')},"] if absent else []),
        f"            low={_text(n.low)},",
        f"            high={_text(n.high)},",
        *([f"            {count.rstrip(', ')},"] if count else []),
        f'            about="{n.about}",',
        "        ),",
    ]


def _text(value: float) -> str:
    return f"{value:.{DIGITS}g}"
