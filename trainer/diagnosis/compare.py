"""How far a model is from the captures that no fit saw, and where: `compare`.

One capture is in memory at a time. Saturated pixels are left out of every statistic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, joined
from trainer.captures.batches import load_batch
from trainer.captures.camera_noise import compare_repeats
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import capture_roles, split
from trainer.diagnosis.error_budget import ErrorBudget
from trainer.diagnosis.localise import BrightnessSums, CaptureResidual, FieldSums, FrequencySums
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model

PICTURES = 3  # held-out captures whose pictures are kept for the report
PAIRS = 12  # pairs of repeats that the noise is checked on

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Picture:
    """One held-out capture: measured, predicted and difference (measured less predicted), float32 [h, w].

    Counts above black; the difference is NaN where the capture is saturated.
    excess, nrmse : of this capture, None where it has no contrast
    """

    capture: str
    channel: str
    plane_mm: float
    measured: np.ndarray
    predicted: np.ndarray
    difference: np.ndarray
    excess: float | None = None
    nrmse: float | None = None


@dataclass(frozen=True)
class Comparison:
    """What `compare` found.

    model : as it was compared, with its gains; captures : the held-out ones, in the order of `errors`
    gains : least-squares factor from prediction to measurement, a capture (None where nothing was predicted)
    psnr_db : 10 log10(peak^2 / mse) over all held-out pixels; the peak is the camera's full scale less black,
        the mse holds the camera's noise, and there is no scale factor a picture
    field, frequency, brightness : as in `as_json`; tile_px : side of a tile of `field`, pixels
    noise_from_repeats : measured noise variance over the expected one, from captures of the same pattern;
        None where there are none
    """

    model: Model
    captures: tuple[Capture, ...]
    errors: PredictionErrors
    gains: tuple[float | None, ...]
    psnr_db: float | None
    field: list[list[float | None]]
    tile_px: int
    frequency: list[dict[str, float]]
    brightness: list[dict[str, Any]]
    noise_from_repeats: float | None
    pictures: tuple[Picture, ...] = ()
    budget: ErrorBudget | None = None
    """Where the ideal model's error goes; None where nobody asked, or there is no contrast."""

    def by_capture(self) -> list[dict[str, Any]]:
        """One row a held-out capture, in the order of the set."""
        return [
            {
                "capture": c.capture,
                "channel": c.channel,
                "plane_mm": c.plane_mm,
                **summary(self.errors.part([k])),
                "gain": self.gains[k],
            }
            for k, c in enumerate(self.captures)
        ]

    def as_json(self) -> dict[str, Any]:
        """The object that `compare --json` prints; None where there is no such number."""
        rows = self.by_capture()
        order = sorted(range(len(rows)), key=lambda k: self.captures[k].time_s)
        channels = [c.channel for c in self.captures]
        planes = [f"{c.plane_mm:g}" for c in self.captures]
        return {
            "heldout": summary(self.errors),
            "psnr_db": self.psnr_db,
            "by_channel": self._by(channels),
            "by_plane": self._by(planes),
            "by_capture": rows,
            "budget": None if self.budget is None else vars(self.budget),
            "noise_from_repeats": self.noise_from_repeats,
            "where": {
                "field": self.field,
                "tile_px": self.tile_px,
                "frequency": self.frequency,
                "brightness": self.brightness,
                "time": [
                    {
                        "time_s": self.captures[k].time_s,
                        "capture": rows[k]["capture"],
                        "channel": channels[k],
                        "gain": rows[k]["gain"],
                        "excess": rows[k]["excess"],
                    }
                    for k in order
                ],
            },
        }

    def _by(self, labels: Sequence[str]) -> dict[str, dict[str, float | None]]:
        return {
            label: summary(self.errors.part([k for k, other in enumerate(labels) if other == label]))
            for label in dict.fromkeys(labels)
        }


def summary(errors: PredictionErrors) -> dict[str, float | None]:
    """nrmse, noise_nrmse and excess; None where the captures have no contrast to compare with."""
    if not float(errors.variance.sum()) > 0:
        return {"nrmse": None, "noise_nrmse": None, "excess": None}
    return {**errors.as_json()}


def compare(captures: CaptureSet, model: Model, progress: Progress | None = None) -> Comparison:
    """How far a model is from the held-out captures of a set.

    Effects are taken as they are. A channel without a gain gets one from the captures that `diagnose` fits,
    so that the numbers of both agree.
    progress : called with the share that is done, 0 .. 1
    Raises InputError where a picture cannot be read or every held-out picture is saturated.
    """
    parts = split(captures)
    wanted = {c.channel for c in parts.held_out} - set(model.gain)
    for_gain = [c for c in capture_roles(captures).fitted if c.channel in wanted]
    steps = len(for_gain) + len(parts.held_out)

    def done(count: int) -> None:
        if progress:
            progress(min(count / steps, 1.0))

    with torch.no_grad():
        if wanted:
            model = with_gains(captures, model, for_gain, done)
        sums = _Sums(captures, _shown(parts.held_out))
        for count, capture in enumerate(parts.held_out, len(for_gain) + 1):
            sums.add(capture, model)
            done(count)
    if not sums.used:
        raise InputError(
            f"every held-out picture of {captures.folder} is saturated: lower the exposure and capture again"
        )
    return sums.finish(captures, model)


class _Sums:
    """What is gathered while the held-out captures pass by."""

    def __init__(self, captures: CaptureSet, shown: set[str]) -> None:
        self.set, self.shown = captures, shown
        shape = captures.bench.camera.shape
        self.field, self.frequency = FieldSums(shape), FrequencySums(shape)
        self.brightness = BrightnessSums(captures.bench.camera.full_scale)
        self.errors: list[PredictionErrors] = []
        self.gains: list[float | None] = []
        self.used: list[Capture] = []
        self.pictures: list[Picture] = []

    def add(self, capture: Capture, model: Model) -> None:
        """Compare one capture; one without an unsaturated pixel says nothing and is left out."""
        batch = load_batch(self.set, [capture])
        if not bool(batch.mask.any()):
            return
        prediction = Predictor(model, batch).predict(model)
        errors = batch.errors(prediction)
        tensors = (batch.signal, prediction, batch.noise, batch.mask)
        seen = CaptureResidual(*(t[0].double().numpy() for t in tensors))
        self.errors.append(errors)
        self.used.append(capture)
        square = float((seen.weight * seen.predicted**2).sum())
        product = float((seen.weight * seen.predicted * seen.measured).sum())
        self.gains.append(product / square if square > 0 else None)
        for sums in (self.field, self.frequency, self.brightness):
            sums.add(seen)
        if capture.capture in self.shown:
            numbers = summary(errors)
            self.pictures.append(
                Picture(
                    capture.capture,
                    capture.channel,
                    capture.plane_mm,
                    seen.measured.astype(np.float32),
                    seen.predicted.astype(np.float32),
                    np.where(seen.weight > 0, seen.residual, np.nan).astype(np.float32),
                    numbers["excess"],
                    numbers["nrmse"],
                )
            )

    def finish(self, captures: CaptureSet, model: Model) -> Comparison:
        """Everything that was gathered."""
        errors = joined(self.errors)
        pixels = float(errors.pixels.sum())
        mse = float(errors.squared.sum()) / pixels
        peak = captures.bench.camera.full_scale
        return Comparison(
            model,
            tuple(self.used),
            errors,
            tuple(self.gains),
            10 * math.log10(peak**2 / mse) if mse > 0 else None,
            self.field.excess(float(errors.variance.sum()) / pixels),
            self.field.tile,
            self.frequency.rows(),
            self.brightness.rows(),
            noise_from_repeats(captures),
            tuple(self.pictures),
        )


def _shown(held_out: Sequence[Capture]) -> set[str]:
    """Ids of the captures whose pictures are kept: one a colour, then one a plane, then others."""
    first: dict[str, Capture] = {}
    for c in held_out:
        first.setdefault(c.channel, c)
    planes: dict[tuple[str, float], Capture] = {}
    for c in held_out:
        planes.setdefault((c.channel, c.plane_mm), c)
    order = [*first.values(), *planes.values(), *{c.pattern: c for c in held_out}.values(), *held_out]
    return set(list(dict.fromkeys(c.capture for c in order))[:PICTURES])


def noise_from_repeats(captures: CaptureSet) -> float | None:
    """Measured variance of the camera's noise over the expected one, from captures of the same pattern.

    Up to a dozen pairs, a change of brightness between the two taken out; None where no pattern is repeated.
    """
    last: dict[tuple[str, float, str, float], Capture] = {}
    ratios: list[float] = []
    for capture in captures.captures:
        key = (capture.channel, capture.plane_mm, capture.pattern, capture.exposure_ms)
        if key in last and len(ratios) < PAIRS:
            first, second = captures.counts(last[key]), captures.counts(capture)
            repeats = compare_repeats(first, second, captures.bench.camera)
            if repeats is not None:
                ratios.append(repeats.ratio)
        last[key] = capture
    return float(np.mean(ratios)) if ratios else None
