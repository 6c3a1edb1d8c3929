"""What becomes of a bundle's network D when its light path is replaced: refitted, kept, or left out.

D learned what the old light path missed, and part of that may be in the new one. So its adapters learn from the
captures of random grains what the new light path misses, and the test pictures, which no fit has seen, decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import safetensors.numpy

from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT
from runtime.calibration.colour_captures import ColourCaptures
from runtime.camera.view import View, on_panel
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.networks.onnx_approximator import Approximator
from runtime.program.progress import Progress, no_progress
from runtime.refinement.adapter_learning import AdapterLearning
from runtime.refinement.picture_refinement import matched

ROUNDS = 3  # over all captures that are learned from
LEAST_GAIN = 0.01  # relative; a smaller fall of the error does not change what there is

Outcome = Literal["refitted", "kept", "left_out"]
Networks = Mapping[str, bytes]


@dataclass(frozen=True)
class ColourPictures:
    """Captures of one pattern a colour.

    Attributes
    ----------
    simulated : float32 array [C, H, W]
        Irradiance by the new light path, mean 1, on the panel's pixels.
    captured : float32 array [C, H, W]
        The camera's, on the panel's pixels, of any scale.
    """

    simulated: np.ndarray
    captured: np.ndarray


@dataclass(frozen=True)
class NetworkCheck:
    """What becomes of D, and why.

    Attributes
    ----------
    outcome : str
        "refitted", "kept" (as it was) or "left_out".
    errors : mapping of str to float
        By outcome, mean squared difference of amplitude on the pictures that decide. "refitted" is missing where the
        network's export does not allow it.
    adapters : mapping of str to array
        Refitted; empty otherwise.
    """

    outcome: Outcome
    errors: Mapping[Outcome, float]
    adapters: Mapping[str, np.ndarray] = field(default_factory=dict)

    def networks(self, before: Networks) -> dict[str, bytes]:
        """The networks of the new bundle, from those of the old one."""
        if self.outcome == "left_out":
            return {n: data for n, data in before.items() if n not in (APPROXIMATOR, GRADIENT, ADAPTERS)}
        if self.outcome == "refitted":
            return {**before, ADAPTERS: safetensors.numpy.save(dict(self.adapters))}
        return dict(before)


def learned_pictures(
    paths: Mapping[str, LightPath], captures: Mapping[str, ColourCaptures], view: View
) -> list[ColourPictures]:
    """The captures of random grains, each with what the new light paths predict.

    Parameters
    ----------
    paths : mapping of str to LightPath
        By colour, with the drift that was found.
    captures : mapping of str to ColourCaptures
    view : View
        Of the camera.
    """
    count = min(len(one.fitted) for one in captures.values())
    return [
        colour_pictures(
            paths,
            {c: captures[c].fitted[k].gray for c in paths},
            {c: on_panel(captures[c].fitted[k].signal, view, p.grid.shape) for c, p in paths.items()},
        )
        for k in range(count)
    ]


def colour_pictures(
    paths: Mapping[str, LightPath], grays: Mapping[str, np.ndarray], captured: Mapping[str, np.ndarray]
) -> ColourPictures:
    """Captures of one pattern a colour, uint8 [H, W], on the panel's pixels, with what light paths predict of them."""
    simulated = []
    for channel, path in paths.items():
        light = pixel_irradiance(path, irradiance(path, panel_phase(path, grays[channel].astype(np.int64))))
        simulated.append(light / light.mean())
    seen = np.maximum(np.stack([captured[c] for c in paths]), 0)
    return ColourPictures(np.stack(simulated).astype(np.float32), seen.astype(np.float32))


def checked_network(
    approximator: Approximator,
    learned: Sequence[ColourPictures],
    deciding: Sequence[ColourPictures],
    progress: Progress = no_progress,
) -> NetworkCheck:
    """Refit D's adapters, and choose by pictures that they have not seen.

    Parameters
    ----------
    approximator : Approximator
        D as it was; its adapters are changed.
    learned, deciding : sequences of ColourPictures
    progress : callable, optional
        Called with the share done, 0 to 1.
    """
    errors: dict[Outcome, float] = {
        "left_out": float(np.mean([_error(p.simulated, p.captured) for p in deciding])),
        "kept": _error_through(approximator, deciding),
    }
    best: dict[str, np.ndarray] = {}
    if approximator.refinable and approximator.correct_follows:
        learning, least = AdapterLearning(approximator), np.inf
        for number in range(ROUNDS):
            for done, pictures in enumerate(learned):
                progress((number + done / len(learned)) / ROUNDS)
                approximator.irradiance[...] = pictures.simulated
                approximator.correct()
                learning.learn(pictures.simulated, _scaled(pictures.captured, approximator.corrected))
            now = _error_through(approximator, deciding)
            if now >= least:
                break
            least, best = now, {n: a.copy() for n, a in approximator.adapters.items()}
        errors["refitted"] = float(least)
    outcome: Outcome = "kept"
    for other in ("refitted", "left_out"):
        if errors.get(other, np.inf) < (1 - LEAST_GAIN) * errors[outcome]:
            outcome = other
    return NetworkCheck(outcome, errors, best if outcome == "refitted" else {})


def _error_through(approximator: Approximator, pictures: Sequence[ColourPictures]) -> float:
    """Mean squared difference of amplitude between D of what is predicted and what was captured."""
    found = []
    for one in pictures:
        approximator.irradiance[...] = one.simulated
        approximator.correct()
        found.append(_error(approximator.corrected, one.captured))
    return float(np.mean(found))


def _error(light: np.ndarray, captured: np.ndarray) -> float:
    difference = np.sqrt(np.maximum(light, 0)) - np.sqrt(_scaled(captured, light))
    return float(np.mean(difference**2))


def _scaled(captured: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Captured pictures [C, H, W], each scaled to be nearest to the light that is expected."""
    return np.stack([matched(y, d) for y, d in zip(captured, light, strict=True)])
