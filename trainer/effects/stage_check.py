"""What is wrong with a stage that an effect returned: types, shapes and numbers of the values that it changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from trainer.prediction.stages import Drive, Panel, Pupil, Sensor

_CURVES = {"response": "the signal", "capture_blur": "its amount"}

Shape = tuple[int, ...]
Fault = tuple[str, str]  # what is wrong, after "whose"; what is wanted


@dataclass(frozen=True)
class _Wanted:
    """The form of one value of a stage.

    Attributes
    ----------
    shape : Shape or None
        None for any.
    text : str
        The shape, as the stage's description has it.
    exact : bool
        The shape itself; otherwise whatever broadcasts to it.
    count : int
        1 for a tensor; 2 for a pair of tensors, 3 for three.
    complex : bool
        Complex numbers are allowed.
    """

    shape: Shape | None
    text: str
    exact: bool = False
    count: int = 1
    complex: bool = False


def stage_faults(before: Any, after: Any) -> Iterator[Fault]:
    """What is wrong with the values of a stage that an effect changed, the first in the stage's order first.

    Parameters
    ----------
    before, after : Drive, Panel, Pupil or Sensor
        Without and with the effect.

    Yields
    ------
    (str, str)
        What is wrong, and what is wanted.
    """
    wanted = _FORMS[type(before)](before)
    for field in fields(before):
        name, old, new = field.name, getattr(before, field.name), getattr(after, field.name)
        if new is old:
            continue
        if name in wanted:
            yield from _tensor_faults(name, new, wanted[name], optional=field.default is None)
        elif name in _CURVES:  # the sensor's
            if new is not None and not callable(new):
                yield f"{name} is {_kind(new)}", f"give a function of {_CURVES[name]}"
        elif isinstance(old, Tensor):
            yield from _tensor_faults(name, new, _Wanted(tuple(old.shape), str(list(old.shape))), False)
        elif not isinstance(new, type(old)) and not isinstance(new, int | float):
            yield f"{name} is {_kind(new)}", f"give a value of type {type(old).__name__}"


_COUNTED = {1: "a tensor", 2: "a pair of tensors", 3: "three tensors"}


def _tensor_faults(name: str, value: Any, wanted: _Wanted, optional: bool) -> Iterator[Fault]:
    what = f"{_COUNTED[wanted.count]} {wanted.text}"
    if value is None and optional:
        return
    if wanted.count > 1:
        if not isinstance(value, tuple | list) or len(value) != wanted.count:
            yield f"{name} is {_kind(value)}", f"give {what}"
            return
        parts = list(value)
    else:
        parts = [value]
    for part in parts:
        if isinstance(part, int | float) and not wanted.exact:
            part = torch.tensor(float(part))
        if not isinstance(part, Tensor):
            yield f"{name} is {_kind(part)}", f"give {what}"
            return
        if not _fits(tuple(part.shape), wanted):
            yield f"{name} has the shape {list(part.shape)}", f"give {what}"
            return
        if part.is_complex() and not wanted.complex:
            yield f"{name} is complex", f"give real numbers, {what}"
            return
        if not _finite(part.detach()):
            yield (
                f"{name} has NaN or infinite values",
                "correct the formula, or narrow the Parameter's low and high",
            )
            return


def _fits(shape: Shape, wanted: _Wanted) -> bool:
    if wanted.shape is None:
        return True
    if wanted.exact:
        return shape == wanted.shape
    try:
        return tuple(torch.broadcast_shapes(shape, wanted.shape)) == wanted.shape
    except RuntimeError:
        return False


def _finite(values: Tensor) -> bool:
    """Whether all numbers are finite; a finite sum shows that in one pass."""
    return bool(torch.isfinite(values.sum())) or bool(torch.isfinite(values).all())


def _kind(value: Any) -> str:
    return "None" if value is None else f"of type {type(value).__name__}"


def _drive(drive: Drive) -> dict[str, _Wanted]:
    levels, surface = tuple(drive.level.shape), tuple(drive.y.shape)
    return {
        "response": _Wanted(levels, f"[{levels[0]}], one phase for each gray level", exact=True),
        "gain": _Wanted(surface, f"[H, W] = {list(surface)}"),
        "crosstalk": _Wanted(None, "[sub-pixels, taps]", count=2),
        "offset": _Wanted(surface, f"[H, W] = {list(surface)}"),
        "factor": _Wanted(levels, f"[{levels[0]}], one for each gray level", exact=True, complex=True),
        "components": _Wanted(None, "[K, C], [K, C] and [K]", count=3, complex=True),
        "persistence": _Wanted((1,), "of one number"),
    }


def _panel(panel: Panel) -> dict[str, _Wanted]:
    surface = tuple(panel.y.shape)
    field = _Wanted(surface, f"[H, W] = {list(surface)}", complex=True)
    return {"source": field, "leak": field, "reflected": field, "aperture": _Wanted((2,), "[2]", exact=True)}


def _pupil(pupil: Pupil) -> dict[str, _Wanted]:
    band = tuple(torch.broadcast_shapes(pupil.fy.shape, pupil.fx.shape))
    image = tuple(torch.broadcast_shapes(pupil.iy.shape, pupil.ix.shape))
    number = _Wanted((1,), "of one number")
    return {
        "distance": number,
        "half_width": number,
        "roundness": number,
        "stretch": number,
        "rotation": number,
        "edge": number,
        "centre": _Wanted((1,), "of one number", count=2),
        "path_difference": _Wanted(band, f"[n, m] = {list(band)}"),
        "transmission": _Wanted(band, f"[n, m] = {list(band)}", complex=True),
        "lines": _Wanted(None, "[lines]", count=2),
        "nominal_offset": number,
        "irradiance_filter": _Wanted(image, f"over (iy, ix) = {list(image)}", complex=True),
    }


def _sensor(sensor: Sensor) -> dict[str, _Wanted]:
    picture = tuple(sensor.y.shape)
    image = tuple(torch.broadcast_shapes(sensor.iy.shape, sensor.ix.shape))
    transfer = _Wanted(image, f"over (iy, ix) = {list(image)}", complex=True)
    counts = _Wanted(picture, f"[h, w] = {list(picture)}")
    return {
        "irradiance_filter": transfer,
        "blur": transfer,
        "displacement": _Wanted(picture, f"[h, w] = {list(picture)}", exact=True, count=2),
        "gain": counts,
        "offset": counts,
    }


_FORMS: dict[type, Callable[[Any], dict[str, _Wanted]]] = {
    Drive: _drive,
    Panel: _panel,
    Pupil: _pupil,
    Sensor: _sensor,
}
