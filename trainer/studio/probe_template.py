"""An effect file for what a probe shows: the template of its stage, with starts that the probe's map gives."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from runtime.bundle.whole_files import whole_file
from trainer.diagnosis.probes import ProbeResult
from trainer.diagnosis.proposals.probe_maps import maps_of
from trainer.diagnosis.proposals.wave_shape import waves_in, waves_in_gray
from trainer.effects.new_effect import write_new_effect
from trainer.formatting import number

# The maps of each probe in which the template's effect would be seen, by the beginning of their title.
SEEN_IN = {
    "drive": ("response, deviation",),
    "panel": ("amplitude multiplied", "phase multiplied"),
    "pupil": ("amplitude passed",),
    "sensor": ("gain over the picture", "light added"),
}

ALONG_A_ROW = 0.95  # cosine of the angle up to which a wave counts as the panel template's columns


def write_effect_of_probe(
    name: str,
    stage: str,
    found: ProbeResult | None,
    shape: tuple[int, int],
    folder: Path,
    taken: Iterable[str],
) -> Path:
    """Write NAME.py and its test into a folder.

    Parameters
    ----------
    name : str
        Of the effect.
    stage : str
    found : ProbeResult or None
        The stage's fitted probe; without it the file is the template alone.
    shape : (int, int), pixels
        Of the panel, or of the camera for the sensor's stage.
    folder : Path
    taken : iterable of str
        Names of effects that exist already.

    Returns
    -------
    Path
        The effect's file.

    Raises
    ------
    InputError
        As from `write_new_effect`.
    """
    path = write_new_effect(name, stage, folder, taken)[0]
    if found is not None:
        text = path.read_text(encoding="utf-8")
        with whole_file(path, "w") as stream:
            stream.write(filled(text, stage, found, shape))
    return path


def filled(text: str, stage: str, found: ProbeResult, shape: tuple[int, int]) -> str:
    """A template's text with what a probe shows: in words in its docstring, in numbers in its starts."""
    words, starts = [], []
    places = {m.place.title: m for m in maps_of(found, shape) if m.place.title in SEEN_IN[stage]}
    for title, values, unit in found.pictures:
        if title.startswith(SEEN_IN[stage]):
            words.append(f"  {title}: {_extent(np.squeeze(np.asarray(values, dtype=np.float64)), unit)}")
            one = next(m for name, m in places.items() if title.startswith(name))
            for wave in waves_in_gray(one) if stage == "drive" else waves_in(one):
                words += textwrap.wrap(wave.describe(wave.starts), 110, initial_indent="    ")
                starts.append(_start(stage, wave.starts))
    told = "\n".join(words) or "  nothing in the maps that this effect could be seen in"
    removed = number(found.removed.value)
    head = f"What the {stage} probe showed when this file was written (excess removed: {removed}):\n"
    text = text.replace('\n"""\n', f'\n\n{head}{told}\n"""\n', 1)
    given = [s for s in starts if s]
    if given:
        lines = "".join(f"        {{{', '.join(f'{k!r}: {v:.4g}' for k, v in s.items())}}},\n" for s in given)
        known = f"    seen_by_probe: list[dict[str, float]] = [\n{lines}    ]\n".replace("'", '"')
        text = re.sub(r'(    """Where fits start[^\n]*"""\n)', lambda m: m.group(1) + known, text, count=1)
        text = re.sub(r"\n    return \[\n", "\n    return seen_by_probe + [\n", text, count=1)
        text = text.replace("\n    return found\n", "\n    return seen_by_probe + found\n", 1)
    return text


def _extent(array: np.ndarray, unit: str) -> str:
    low, high = float(np.nanmin(array)), float(np.nanmax(array))
    return (
        f"from {number(low)} to {number(high)} {unit}, rms about its mean {number(float(np.nanstd(array)))}"
    )


def _start(stage: str, seen: dict[str, Any]) -> dict[str, float]:
    """Starting values of the template's own parameters; {} where the wave is none that it has."""
    if stage == "pupil":
        return {}
    names = {"drive": ("cosine", "sine", "cycles"), "sensor": ("cosine", "sine", "period", "angle")}
    if stage != "panel":
        return {n: float(seen[n]) for n in names[stage]}
    along = math.cos(math.radians(float(seen["angle"])))
    if abs(along) < ALONG_A_ROW:
        return {}
    return {
        "cosine": float(seen["cosine"]),
        "sine": float(seen["sine"]),
        "period": float(seen["period"]) / along,
    }
