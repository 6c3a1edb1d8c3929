"""What one effect does to a test picture: a small virtual bench, its ideal picture, and the picture with the effect.

The picture's pattern is computed once, by phase retrieval on the ideal bench. Everything else is the trainer's own
light path, on a grid that is small enough for a slider: one thread takes 5 to 40 ms a picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from runtime.solver import solve
from runtime.solver.targets import TEST_PICTURE, read_target
from trainer.captures.batches import EARLIER
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.device import one_thread
from trainer.effects.definition import Effect, Parameter
from trainer.effects.own_effect import parameters_of
from trainer.model.bundle_export import baked_path
from trainer.model.model import EffectInstance, Model, Values, absent, instance_with
from trainer.model.model_stages import scene_for, stages_for
from trainer.prediction.camera_light import counts, light_on_camera
from trainer.prediction.predict import Trace, trace
from trainer.prediction.scene import Scene, Stages, bare_stages

ROWS, COLUMNS = 96, 128
DISTANCE_MM = 10.0
ITERATIONS = 80
BRIGHTNESS = 0.6  # of full scale, where the ideal picture is white
WHITE = 99.8  # percentile
CAPTURES = 24  # of effects that differ from capture to capture
SCALES = 20  # range of a slider on either side, where the parameter states none
MOST_NUMBERS = 16  # sliders of an effect

Picture = NDArray[np.float32]


@dataclass(frozen=True)
class EffectPicture:
    """The test picture without and with an effect, at the same laser power.

    Attributes
    ----------
    ideal, with_effect, difference : float32 array [h, w], counts above black
        The difference is with the effect less ideal.
    """

    ideal: Picture
    with_effect: Picture

    @property
    def difference(self) -> Picture:
        """With the effect less ideal."""
        return self.with_effect - self.ideal

    @property
    def excess(self) -> float:
        """Mean squared difference over the variance of the picture with the effect, as `compare` counts it."""
        squared = float(np.mean(self.difference.astype(np.float64) ** 2))
        return squared / max(float(np.var(self.with_effect, dtype=np.float64)), 1e-12) if squared else 0.0

    @property
    def nrmse(self) -> float:
        """Root of `excess`: there is no camera noise here."""
        return math.sqrt(self.excess)

    @property
    def light(self) -> float:
        """Light in the picture with the effect, as a share of the ideal picture's."""
        return float(self.with_effect.sum(dtype=np.float64) / self.ideal.sum(dtype=np.float64))


@dataclass(frozen=True)
class EffectNumber:
    """One number of an effect, as a slider has it.

    Attributes
    ----------
    parameter, term : str
        Its parameter, and the name of its term; "" for a single number.
    index : int
        Among the parameter's numbers.
    unit, about : str
    low, high : float
        Range of the slider, in the unit.
    absent, example : float
        Where the effect is not there, and where it is easy to see.
    """

    parameter: str
    term: str
    index: int
    unit: str
    about: str
    low: float
    high: float
    absent: float
    example: float

    @property
    def label(self) -> str:
        """Name with term and unit, for people."""
        name = self.parameter.replace("_", " ")
        if self.term:
            name = (
                f"{name} {self.term}"
                if self.term.startswith(("P", "every")) or self.term.isdecimal()
                else self.term
            )
        return name if self.unit in ("", "1") else f"{name} ({self.unit})"

    @property
    def step(self) -> float:
        """A round number near a hundredth of the range."""
        rough = (self.high - self.low) / 100
        power = 10 ** math.floor(math.log10(rough))
        return max(s for s in (power, 2 * power, 5 * power) if s <= rough * (1 + 1e-9))


@lru_cache(maxsize=1)
def demonstration_bench() -> Bench:
    """A green bench with a small panel and an iris that keeps its first order alone."""
    camera = Camera(COLUMNS, ROWS, 8.0, True, 12, 64.0, 10500.0, 5.0)
    return Bench(
        "demonstration",
        Panel(COLUMNS, ROWS, 8.0, fill_factor=0.93),
        (Channel("green", 520.0),),
        DISTANCE_MM,
        Iris("square", 0.8),
        camera,
    )


@lru_cache(maxsize=1)
def demonstration_pattern() -> NDArray[np.uint8]:
    """Gray levels [H, W] whose ideal picture is the test picture; takes about a second, once."""
    bench = demonstration_bench()
    path = baked_path(Model(bench), bench.channels[0].name, bench.distance_mm)
    target = read_target(TEST_PICTURE, bench.panel.shape, fit=True)
    gray: NDArray[np.uint8] = solve(path, target, ITERATIONS).gray
    return gray


def numbers_of(effect: Effect, order: int) -> tuple[EffectNumber, ...]:
    """The numbers of an effect on the demonstration bench, in the order of its parameters.

    Parameters
    ----------
    order : int
        Of the effect's map or curve.
    """
    bench = demonstration_bench()
    at_absent = absent(effect, bench, order)
    found = []
    for k, p in enumerate(effect.parameters):
        if p.per_pixel:
            continue
        count = at_absent.values[p.name].size
        single = at_absent.values[p.name].shape[-1:] in ((), (1,)) and not p.count
        terms = ("",) * count if single else _term_names(p, order, count)
        none = p.absent_value(bench)
        low, high = _slider_range(p, none)
        example = _example(p, k == 0, none, high, count)
        for index in range(count):
            found.append(
                EffectNumber(
                    p.name, terms[index], index, p.unit, p.about, low, high, none, float(example[index])
                )
            )
    return tuple(found)


def orders_of(effect: Effect) -> tuple[int, ...]:
    """The effect's orders that have few enough numbers for sliders; its lowest always."""
    bench = demonstration_bench()
    few = [
        order
        for order in effect.orders
        if sum(v.size for v in absent(effect, bench, order).values.values()) <= MOST_NUMBERS
    ]
    return tuple(few) or effect.orders[:1]


def differs_by_capture(effect: Effect) -> bool:
    """Whether the effect gives each capture a gain or a place of its own."""
    sensor = _stages(instance_with(effect, demonstration_bench(), _examples(effect)))[1].sensor
    return sensor.free_capture_gain or sensor.free_capture_shift


def demonstrate(
    effect: Effect,
    numbers: Sequence[float],
    order: int | None = None,
    *,
    by_eye: bool = False,
    capture: int = 0,
) -> EffectPicture:
    """The test picture without and with an effect.

    Parameters
    ----------
    effect : Effect
    numbers : sequence of float
        One for each of `numbers_of`, in the parameters' units.
    order : int, optional
        The effect's lowest without it.
    by_eye : bool
        What the eye sees, without the camera: effects that act on the camera alone change nothing.
    capture : int
        Which capture of a series, for effects that differ from one to the next.

    Returns
    -------
    EffectPicture

    Raises
    ------
    InputError
        Where a user's effect fails: with its file and line.
    """
    order = effect.orders[0] if order is None else order
    bench = demonstration_bench()
    instance = instance_with(effect, bench, _values(effect, numbers, order), order)
    with torch.no_grad(), one_thread():
        scene, stages = _stages(instance)
        before, ideal = _ideal(scene)
        if by_eye and effect.acts_on == "camera":
            return EffectPicture(ideal, ideal)
        if stages.sensor.free_capture_shift:
            dy, dx = (torch.full((ROWS, COLUMNS), float(d)) for d in _of_capture(instance, "pixels", capture))
            stages = replace(stages, sensor=stages.sensor.displaced(dy, dx))
        earlier = None if stages.drive.persistence is None else _patterns_before()
        image = trace(scene, stages, _pattern(), effect.stage, before, earlier).image
        if by_eye:
            bare = bare_stages(scene).sensor
            stages = replace(stages, sensor=replace(bare, irradiance_filter=stages.sensor.irradiance_filter))
        picture = counts(scene, stages, light_on_camera(scene, stages, image), _gain(), None)[0].numpy()
    if stages.sensor.free_capture_gain:
        percent = _of_capture(instance, "%", capture)[0]
        picture = picture * np.float32(max(1 + percent / 100, 0.0))
    return EffectPicture(ideal, picture)


def _slider_range(p: Parameter, none: float) -> tuple[float, float]:
    if p.typical is not None:
        return p.typical
    return max(p.low, none - SCALES * p.scale), min(p.high, none + SCALES * p.scale)


def _example(p: Parameter, first: bool, none: float, high: float, count: int) -> NDArray[np.float64]:
    """Values with which the effect is easy to see: the parameter's own, or half of the range for the first one."""
    values = np.full(count, none)
    given = p.example
    if given is None:
        if first and p.typical is None and count:
            values[0] = (none + high) / 2
        return values
    head = np.atleast_1d(np.asarray(given, float))[:count]
    values[: head.size] = head
    return values


def _term_names(p: Parameter, order: int, count: int) -> tuple[str, ...]:
    names = p.terms(order) if p.terms is not None else ()
    return names if len(names) == count else tuple(str(n + 1) for n in range(count))


def _examples(effect: Effect) -> Mapping[str, NDArray[np.float64]]:
    order = effect.orders[0]
    return _values(effect, [n.example for n in numbers_of(effect, order)], order)


def _values(effect: Effect, numbers: Sequence[float], order: int) -> Values:
    """The numbers, divided among the effect's parameters."""
    shapes = {name: v.shape for name, v in absent(effect, demonstration_bench(), order).values.items()}
    values, start = {}, 0
    for name, shape in shapes.items():
        if effect.parameter(name).per_pixel:
            continue
        count = math.prod(shape)
        values[name] = np.asarray(numbers[start : start + count], float).reshape(shape)
        start += count
    for p in effect.parameters:
        if p.per_pixel:  # drawn, with the spread that a parameter beside it states
            spread = values[f"{p.name}_rms"] * (0.01 if effect.parameter(f"{p.name}_rms").unit == "%" else 1)
            values[p.name] = spread * np.random.default_rng(5).standard_normal(shapes[p.name])
    if start != len(numbers):
        raise ValueError(f"effect '{effect.name}' has {start} numbers, not {len(numbers)}")
    return values


def _stages(instance: EffectInstance) -> tuple[Scene, Stages]:
    bench = demonstration_bench()
    model = Model(bench, (instance,))
    scene = scene_for(model, bench.channels[0].name, bench.distance_mm)
    with parameters_of(instance.effect):
        return scene, stages_for(scene, model.present)


@lru_cache(maxsize=1)
def _pattern() -> Tensor:
    return torch.as_tensor(demonstration_pattern().astype(np.int64))[None]


def _patterns_before() -> Tensor:
    """What a slow panel showed before the pattern: the same picture upside down, [1, EARLIER, H, W]."""
    return _pattern().flip(-2)[:, None].expand(-1, EARLIER, -1, -1)


@lru_cache(maxsize=1)
def _gain() -> Tensor:
    """Counts a unit of light, the same for every effect."""
    bench = demonstration_bench()
    scene = scene_for(Model(bench), bench.channels[0].name, bench.distance_mm)
    bare = bare_stages(scene)
    light = light_on_camera(scene, bare, trace(scene, bare, _pattern()).image)
    white = float(np.percentile(light.numpy(), WHITE))
    return torch.full((1, 1, 1), BRIGHTNESS * bench.camera.full_scale / white)


@lru_cache(maxsize=4)
def _ideal(scene: Scene) -> tuple[Trace, Picture]:
    """The ideal bench's light and picture, on this scene's grid."""
    bare = bare_stages(scene)
    point = trace(scene, bare, _pattern())
    picture = counts(scene, bare, light_on_camera(scene, bare, point.image), _gain(), None)[0].numpy()
    picture.flags.writeable = False
    return point, picture


def _of_capture(instance: EffectInstance, unit: str, capture: int) -> NDArray[np.float64]:
    """Two numbers of one capture of a series, about 0, with the spread that the effect states in this unit."""
    name = next((p.name for p in instance.effect.parameters if p.unit == unit), None)
    spread = 0.0 if name is None else float(np.ravel(instance.values[name])[0])
    series = np.random.default_rng(4).standard_normal((2, CAPTURES))
    series = (series - series.mean(1, keepdims=True)) / series.std(1, keepdims=True)
    numbers: NDArray[np.float64] = spread * series[:, capture % CAPTURES]
    return numbers
