"""For the test of an effect: a small ideal bench, and captures of it with the effect hidden in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.captures.camera_noise import noise_variance
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import Moment
from trainer.captures.capture_writer import CaptureWriter
from trainer.captures.patterns import choose_patterns
from trainer.device import array_of
from trainer.effects.definition import Effect
from trainer.model.model import EffectInstance, Model, absent, instance_with
from trainer.model.model_stages import scene_for, stages_for
from trainer.prediction.camera_light import counts, light_on_camera
from trainer.prediction.predict import trace

BRIGHTNESS = 0.13  # mean signal, share of full scale
SECOND = Moment(1.0, 1.0)  # when predictions stand that are of no capture

ParameterValues = Mapping[str, float | np.ndarray]


def small_bench(rows: int = 72, columns: int = 96) -> Bench:
    """A green bench with a small panel, 6 mm from the camera."""
    camera = Camera(columns, rows, 8.0, True, 12, 64.0, 10500.0, 5.0)
    return Bench("small", Panel(columns, rows, 8.0), (Channel("green", 520.0),), 6.0, Iris(), camera)


def change_when_absent(effect: Effect) -> float:
    """Largest change of a prediction by the effect at its absent values, over the brightest pixel."""
    bench = small_bench()
    model = Model(bench).having(absent(effect, bench))
    with_it = _predict(model, model.present)
    without = _predict(model, ())
    return float((with_it - without).abs().max() / without.max())


def slopes(effect: Effect, values: ParameterValues) -> dict[str, float]:
    """Size of a prediction's derivative by each parameter at these values, by automatic differentiation."""
    bench = small_bench()
    model = Model(bench).having(instance_with(effect, bench, values))
    tensors = {
        n: torch.tensor(v, dtype=torch.float32, requires_grad=True)
        for n, v in model.present[0].values.items()
    }
    prediction = _predict(model, model.present, {effect.name: tensors})
    weights = torch.as_tensor(
        np.random.default_rng(0).standard_normal(prediction.shape), dtype=prediction.dtype
    )
    found = torch.autograd.grad((weights * prediction).sum(), list(tensors.values()), allow_unused=True)
    return {n: 0.0 if g is None else float(g.abs().sum()) for n, g in zip(tensors, found, strict=True)}


def captures_with(
    folder: Path,
    effect: Effect,
    values: ParameterValues,
    patterns: int = 6,
    seed: int = 0,
    order: int | None = None,
) -> CaptureSet:
    """Write and read a capture set of the small bench, with the effect hidden in it and camera noise.

    Parameters
    ----------
    folder : Path
        Where the set is written; new or empty.
    effect : Effect
    values : mapping of str to float or array
        Of the effect's parameters; those that are not named stay absent.
    patterns : int
    seed : int
        Of the patterns and the noise.
    order : int, optional
        The effect's; by default its lowest.

    Returns
    -------
    CaptureSet
    """
    bench = small_bench()
    model = Model(bench).having(instance_with(effect, bench, values, order))
    rng = np.random.default_rng(seed)
    with CaptureWriter(folder, bench) as writer, torch.no_grad():
        for number, pattern in enumerate(choose_patterns(bench, "green", bench.distance_mm, patterns, seed)):
            moment = Moment(float(number), float(number))
            signal = array_of(_predict(model, model.present, gray=pattern.gray, moment=moment)[0].double())
            noisy = signal + np.sqrt(noise_variance(signal, bench.camera)) * rng.standard_normal(signal.shape)
            raw = np.clip(np.rint(noisy + bench.camera.black_level), 0, bench.camera.saturation)
            writer.add(pattern.gray, raw.astype(np.uint16), "green", pattern=f"{number:03d}")
    return read_captures(folder)


def _predict(
    model: Model,
    present: tuple[EffectInstance, ...],
    tensors: Mapping[str, Mapping[str, torch.Tensor]] | None = None,
    gray: np.ndarray | None = None,
    moment: Moment = SECOND,
) -> torch.Tensor:
    """Counts above black [1, h, w] on the model's own grid, with only some of its effects."""
    bench = model.bench
    if gray is None:
        gray = np.random.default_rng(1).integers(0, 256, bench.panel.shape)
    scene = scene_for(model, bench.channels[0].name, bench.distance_mm)
    stages = stages_for(scene, present, tensors, moment)
    point = trace(scene, stages, torch.as_tensor(gray.astype(np.int64))[None])
    gain = torch.full((1, 1, 1), BRIGHTNESS * bench.camera.full_scale)
    return counts(scene, stages, light_on_camera(scene, stages, point.image), gain, None)
