"""An effect file for what a probe shows: the template of its stage, with starts that the probe's map gives."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from runtime.bundle.whole_files import whole_file
from trainer.diagnosis.probes import ProbeResult
from trainer.effects.new_effect import write_new_effect
from trainer.effects.pull import Wave, waves
from trainer.formatting import number

# The maps of each probe in which the template's effect would be seen, by the beginning of their title.
SEEN_IN = {
    "drive": ("response, deviation",),
    "panel": ("amplitude multiplied", "phase multiplied"),
    "pupil": ("amplitude passed",),
    "sensor": ("gain over the picture", "light added"),
}


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
    for title, values, unit in found.pictures:
        if title.startswith(SEEN_IN[stage]):
            array = np.squeeze(np.asarray(values, dtype=np.float64))
            words.append(f"  {title}: {_extent(array, unit)}")
            for wave in waves(array, most=2):
                size = _amplitude(array, wave)
                words.append(
                    f"    a wave of {_cycles(wave, array)}, amplitude {number(size)} {unit}".rstrip()
                )
                starts.append(_start(stage, wave, size, array, shape))
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


def _cycles(wave: Wave, array: np.ndarray) -> str:
    cycles = [abs(f) * n for f, n in zip(wave.frequency, array.shape, strict=True)]
    axes = ("",) if array.ndim == 1 else (" down the rows", " along the columns")
    return " and ".join(f"{number(c)} cycles{axis}" for c, axis in zip(cycles, axes, strict=True))


def _amplitude(array: np.ndarray, wave: Wave) -> float:
    """Amplitude of a wave in an array, by projection."""
    places = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in array.shape), indexing="ij")
    angle = 2 * np.pi * sum(f * p for f, p in zip(wave.frequency, places, strict=True))
    shape = wave.cosine * np.cos(angle) + wave.sine * np.sin(angle)
    return float(2 * np.mean((array - array.mean()) * shape))


def _start(
    stage: str, wave: Wave, size: float, array: np.ndarray, shape: tuple[int, int]
) -> dict[str, float]:
    """Starting values of the template's own parameters; {} where the wave is none that it has."""
    cosine, sine = size * wave.cosine, size * wave.sine
    if stage == "drive":
        return {"cosine": cosine, "sine": sine, "cycles": wave.frequency[0] * array.shape[0]}
    fy, fx = (f * n / full for f, n, full in zip(wave.frequency, array.shape, shape, strict=True))
    if stage == "panel":
        return {"cosine": cosine, "sine": sine, "period": 1 / fx} if fx > 3 * abs(fy) else {}
    if stage == "sensor":
        period, angle = 1 / np.hypot(fy, fx), np.degrees(np.arctan2(fy, fx))
        return {"cosine": cosine, "sine": sine, "period": float(period), "angle": float(angle)}
    return {}
