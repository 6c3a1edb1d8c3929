"""How far a model is from the held-out captures, and where: `compare`.

One capture is in memory at a time. Saturated pixels are left out of every statistic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, joined
from runtime.program.progress import Progress
from trainer.captures.batches import load_batch
from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import compare_repeats
from trainer.captures.camera_numbers import repeated_pairs
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import capture_roles, split
from trainer.diagnosis.error_budget import ErrorBudget
from trainer.diagnosis.localise import BrightnessSums, FieldSums, FrequencySums, residual_of
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model

PICTURES = 3  # held-out captures whose pictures are kept for the report


@dataclass(frozen=True)
class CapturePicture:
    """One held-out capture, measured and predicted.

    Attributes
    ----------
    capture, channel : str
        Names of the capture and of its colour.
    plane_mm : float, mm
    measured, predicted : float32 array [h, w], counts above black
    difference : float32 array [h, w], counts
        Measured less predicted; NaN where the capture is saturated.
    excess, nrmse : float or None
        Of this capture; None where it has no contrast.
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
    """The errors of a model on held-out captures, and where they are.

    Attributes
    ----------
    model : Model
        As it was compared, with its gains.
    captures : tuple of Capture
        The held-out ones, in the order of `errors`.
    gains : tuple of float or None
        Least-squares factor from prediction to measurement, one a capture; None where nothing was predicted.
    psnr_db : float or None, dB
        10 log10(peak^2 / mse) over all held-out pixels. The peak is the camera's full scale less black, the mse
        includes the camera's noise, and no picture has a scale factor of its own.
    field : list of lists
        Excess of each tile, [row][column]; None for a tile that is saturated in every capture.
    tile_px : int, pixels
        Side of a tile of `field`.
    frequency, brightness : list of dict
        Rows of `FrequencySums` and of `BrightnessSums`.
    noise_from_repeats : float or None
        Measured noise variance over the expected one, from captures of the same pattern; None where no pattern is
        repeated.
    camera : Camera
        With the full well and read noise that were used: stated, or measured from repeats.
    pictures : tuple of CapturePicture
        A few of the captures, for the report.
    budget : ErrorBudget or None
        Where the ideal model's error goes; None where it was not computed, or there is no contrast.
    is_held_out : bool
        False where there is only one pattern, so that what is judged is what was fitted.
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
    camera: Camera
    pictures: tuple[CapturePicture, ...] = ()
    budget: ErrorBudget | None = None
    is_held_out: bool = True

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
        """The object that `compare --json` prints; None where there is no such number.

        Keys `heldout`, `held_out` (false where the captures hold one pattern), `psnr_db`, `by_channel`,
        `by_plane`, `by_capture`, `budget`, `noise_from_repeats`, `camera` (the noise that was used,
        and whether it was measured from repeats) and `where`,
        which has `field`, `tile_px`, `frequency`, `brightness` and `time`.
        """
        rows = self.by_capture()
        order = sorted(range(len(rows)), key=lambda k: self.captures[k].time_s)
        channels = [c.channel for c in self.captures]
        planes = [f"{c.plane_mm:g}" for c in self.captures]
        return {
            "heldout": summary(self.errors),
            "held_out": self.is_held_out,
            "psnr_db": self.psnr_db,
            "by_channel": self._by(channels),
            "by_plane": self._by(planes),
            "by_capture": rows,
            "budget": None if self.budget is None else vars(self.budget),
            "noise_from_repeats": self.noise_from_repeats,
            "camera": {
                "full_well_e": self.camera.full_well_e,
                "read_noise_e": self.camera.read_noise_e,
                "measured": self.camera != self.model.bench.camera,
            },
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
    """Keys `nrmse`, `noise_nrmse` and `excess`; None where the captures have no contrast to compare with."""
    if not float(errors.variance.sum()) > 0:
        return {"nrmse": None, "noise_nrmse": None, "excess": None}
    return {**errors.as_json()}


def compare(captures: CaptureSet, model: Model, progress: Progress | None = None) -> Comparison:
    """How far a model is from the held-out captures of a set.

    Effects are taken as they are. A channel without a gain gets one from the captures that `diagnose` fits,
    so that the numbers of both agree.

    Parameters
    ----------
    progress : callable, optional
        Called with the share that is done, 0 .. 1.

    Raises
    ------
    InputError
        Where a picture cannot be read, or no picture can be used: all without light, or saturated.
    """
    divided = split(captures)
    without_gain = {c.channel for c in divided.held_out} - set(model.gain)
    for_gain = [c for c in capture_roles(captures).fitted if c.channel in without_gain]
    steps = len(for_gain) + len(divided.held_out)

    def done(count: int) -> None:
        if progress:
            progress(min(count / steps, 1.0))

    with torch.no_grad():
        if without_gain:
            model = with_gains(captures, model, for_gain, done)
        sums = _Sums(captures, _kept_pictures(divided.held_out))
        for count, capture in enumerate(divided.held_out, len(for_gain) + 1):
            sums.add(capture, model)
            done(count)
    if not sums.used:
        raise InputError(
            f"every held-out picture of {captures.folder} is saturated: lower the exposure and capture again"
        )
    return sums.finish(captures, model, divided.is_held_out)


class _Sums:
    """Sums over the held-out captures, and the pictures that are kept of them."""

    def __init__(self, captures: CaptureSet, kept: set[str]) -> None:
        self.set, self.kept = captures, kept
        shape = captures.bench.camera.shape
        self.field, self.frequency = FieldSums(shape), FrequencySums(shape)
        self.brightness = BrightnessSums(captures.bench.camera.full_scale)
        self.errors: list[PredictionErrors] = []
        self.gains: list[float | None] = []
        self.used: list[Capture] = []
        self.pictures: list[CapturePicture] = []

    def add(self, capture: Capture, model: Model) -> None:
        """Compare one capture; one without an unsaturated pixel is left out."""
        batch = load_batch(self.set, [capture])
        if not bool(batch.mask.any()):
            return
        prediction = Predictor(model, batch).predict(model)
        errors = batch.errors(prediction)
        residual = residual_of(batch, prediction)
        self.errors.append(errors)
        self.used.append(capture)
        self.gains.append(residual.gain)
        for sums in (self.field, self.frequency, self.brightness):
            sums.add(residual)
        if capture.capture in self.kept:
            numbers = summary(errors)
            self.pictures.append(
                CapturePicture(
                    capture.capture,
                    capture.channel,
                    capture.plane_mm,
                    residual.measured.astype(np.float32),
                    residual.predicted.astype(np.float32),
                    np.where(residual.mask > 0, residual.residual, np.nan).astype(np.float32),
                    numbers["excess"],
                    numbers["nrmse"],
                )
            )

    def finish(self, captures: CaptureSet, model: Model, is_held_out: bool) -> Comparison:
        """The comparison that the sums give."""
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
            captures.noise_camera(),
            tuple(self.pictures),
            is_held_out=is_held_out,
        )


def _kept_pictures(held_out: Sequence[Capture]) -> set[str]:
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
    ratios = []
    for one, other in repeated_pairs(captures.captures):
        repeats = compare_repeats(captures.counts(one), captures.counts(other), captures.bench.camera)
        if repeats is not None:
            ratios.append(repeats.ratio)
    return float(np.mean(ratios)) if ratios else None
