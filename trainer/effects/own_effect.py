"""Calls of an effect's functions. Where they are a user's own, what goes wrong is said with the file and the line.

Built-in effects are called as they are. What a user's function returns is checked each time: the type, the shape of
each tensor that changed, and that all numbers are finite, which is little work next to one Fourier transform.
"""

from __future__ import annotations

import inspect
import math
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import torch

from firmware_iface.errors import InputError, nearest
from trainer.effects.definition import Effect
from trainer.effects.evidence import Evidence
from trainer.effects.stage_check import stage_faults
from trainer.prediction.stages import Sensor

BUILT_IN = "built in"


class OwnEffectError(InputError):
    """A user's effect failed: one sentence that says which, where, and what came back."""


def applied(effect: Effect, stage: Any, arguments: Mapping[str, Any]) -> Any:
    """The stage with the effect.

    Parameters
    ----------
    effect : Effect
    stage : Drive, Panel, Pupil or Sensor
    arguments : mapping of str to Tensor
        Parameters by name, and `order` where the effect takes it.

    Raises
    ------
    OwnEffectError
        Where a user's function fails, or returns something other than such a stage with finite numbers.
    """
    if effect.source == BUILT_IN:
        return effect.apply(stage, **arguments)
    with _located(effect, effect.apply):
        result = effect.apply(stage, **arguments)
    kind = type(stage).__name__
    if not isinstance(result, type(stage)):
        _refuse(
            effect, effect.apply, f"returned {_what(result)}", f"return the {kind} that it is given, changed"
        )
    fault = next(stage_faults(stage, result), None)
    if fault is not None:
        at = ", ".join(f"{n} = {_value(v)}" for n, v in arguments.items())
        _refuse(effect, effect.apply, f"returned a {kind} whose {fault[0]} at {at}", fault[1])
    if isinstance(result, Sensor) and result.response is not None and result.response is not stage.response:
        return replace(result, response=_checked_curve(effect, result.response))
    return result


def starts_of(effect: Effect, evidence: Sequence[Evidence]) -> list[dict[str, Any]]:
    """Starting points that the effect estimates from the captures; none where it estimates none.

    Raises
    ------
    OwnEffectError
        Where a user's function fails, or returns something other than a list of {parameter: finite value}.
    """
    if effect.starts is None:
        return []
    if effect.source == BUILT_IN:
        return effect.starts(evidence)
    wanted = "return a list of {parameter: value}"
    with _located(effect, effect.starts, "starts"):
        result = effect.starts(evidence)
        listed = isinstance(result, Iterable) and not isinstance(result, Mapping | str)
        found = list(result) if listed else []  # a generator runs here
    if not listed:
        _refuse(effect, effect.starts, f"returned {_what(result)}", wanted, "starts")
    for one in found:
        if not isinstance(one, Mapping):
            _refuse(effect, effect.starts, f"returned a list with {_what(one)}", wanted, "starts")
        _check_values(effect, effect.starts, one, evidence, "starts")
    return found


def measured_by(effect: Effect, evidence: Sequence[Evidence], order: int) -> dict[str, Any]:
    """Values that the effect measures on the captures; none where it measures none.

    Raises
    ------
    OwnEffectError
        Where a user's function fails, or returns something other than {parameter: finite value}.
    """
    if effect.measure is None:
        return {}
    if effect.source == BUILT_IN:
        return effect.measure(evidence)
    with _located(effect, effect.measure, "measure"):
        result = effect.measure(evidence)
    if not isinstance(result, Mapping):
        _refuse(effect, effect.measure, f"returned {_what(result)}", "return {parameter: value}", "measure")
    _check_values(effect, effect.measure, result, evidence, "measure", order)
    return dict(result)


def line_in_file(error: BaseException, file: str) -> int | None:
    """The last line of a file that an error passed through; None where it did not."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return error.lineno
    inside = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    return inside[-1] if inside else None


@contextmanager
def parameters_of(effect: Effect) -> Iterator[None]:
    """A block that computes the shapes and absent values of the effect's parameters.

    Raises
    ------
    OwnEffectError
        Where a function in a user's Parameter fails.
    """
    if effect.source == BUILT_IN:
        yield
        return
    with _located(effect, effect.apply, "a Parameter"):
        yield


@contextmanager
def _located(effect: Effect, function: Callable[..., Any], role: str = "") -> Iterator[None]:
    """A block that calls a user's function: its errors name the effect, the file and the line."""
    try:
        yield
    except (OwnEffectError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        file, line = effect.source, line_in_file(error, effect.source)
        if line is None:  # the function is from another file
            file, line = _place(effect, function)
            line = line_in_file(error, file) or line
        raise OwnEffectError(f"{_name(effect, role)} ({_at(file, line)}): {_said(error)}") from error


def _refuse(
    effect: Effect, function: Callable[..., Any], fault: str, wanted: str, role: str = ""
) -> NoReturn:
    raise OwnEffectError(f"{_name(effect, role)} ({_at(*_place(effect, function))}) {fault}: {wanted}")


def _name(effect: Effect, role: str) -> str:
    return f"{role} of effect '{effect.name}'" if role else f"effect '{effect.name}'"


def _at(file: str, line: int | None) -> str:
    return file if line is None else f"{file}, line {line}"


def _place(effect: Effect, function: Callable[..., Any]) -> tuple[str, int | None]:
    """File of a function, and the line of its `def`."""
    try:
        lines, first = inspect.getsourcelines(function)
        file = inspect.getsourcefile(function) or effect.source
    except (OSError, TypeError):
        return effect.source, None
    defined = (k for k, text in enumerate(lines) if text.lstrip().startswith("def "))
    return file, first + next(defined, 0)


def _said(error: BaseException) -> str:
    if isinstance(error, SystemExit):
        return "it ends the program (SystemExit): raise an error that says why instead"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _what(result: Any) -> str:
    return "None" if result is None else f"a value of type {type(result).__name__}"


def _value(value: Any) -> str:
    if not isinstance(value, torch.Tensor):
        return str(value)
    numbers = value.detach().reshape(-1).tolist()
    shown = ", ".join(f"{n:.4g}" for n in numbers[:3]) + (", ..." if len(numbers) > 3 else "")
    return shown if value.ndim == 0 else f"[{shown}]"


def _checked_curve(
    effect: Effect, curve: Callable[[torch.Tensor], torch.Tensor]
) -> Callable[[torch.Tensor], torch.Tensor]:
    """A response curve whose errors name the effect, and whose result is checked."""

    def checked(share: torch.Tensor) -> torch.Tensor:
        with _located(effect, effect.apply, "response curve"):
            result = curve(share)
        if not isinstance(result, torch.Tensor) or result.shape != share.shape:
            got = (
                f"a tensor of shape {list(result.shape)}"
                if isinstance(result, torch.Tensor)
                else _what(result)
            )
            wanted = f"return a tensor of the signal's shape {list(share.shape)}"
            _refuse(effect, effect.apply, f"returned {got}", wanted, "response curve")
        if not bool(torch.isfinite(result.detach()).all()) and bool(torch.isfinite(share.detach()).all()):
            wanted = "let it give finite numbers for every share of full scale, negative ones too"
            _refuse(effect, effect.apply, "returned NaN or infinite values", wanted, "response curve")
        return result

    return checked


def _check_values(
    effect: Effect,
    function: Callable[..., Any],
    values: Mapping[str, Any],
    evidence: Sequence[Evidence],
    role: str,
    order: int | None = None,
) -> None:
    bench = evidence[0].scene.bench
    known = {p.name: p for p in effect.parameters}
    for name, value in values.items():
        if name not in known:
            _refuse(effect, function, f"names a parameter {name!r}", nearest(str(name), known), role)
        shape = known[name].shape(effect.orders[0] if order is None else order, bench)
        try:
            numbers = np.asarray(value, dtype=float)
        except (TypeError, ValueError, RuntimeError):
            _refuse(
                effect,
                function,
                f"gives {_what(value)} for '{name}'",
                f"give {_numbers(shape)}",
                role,
            )
        if not np.isfinite(numbers).all():
            _refuse(
                effect,
                function,
                f"gives NaN or an infinite value for '{name}'",
                "leave such a starting point out" if role == "starts" else "give a finite value",
                role,
            )
        if numbers.size != math.prod(shape) and not _broadcasts(numbers.shape, shape):
            got = f"an array of shape {list(numbers.shape)}"
            _refuse(effect, function, f"gives {got} for '{name}'", f"give {_numbers(shape)}", role)


def _numbers(shape: tuple[int, ...]) -> str:
    return f"a number, or an array of shape {list(shape)}" if shape else "a number"


def _broadcasts(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    try:
        return np.broadcast_shapes(shape, wanted) == wanted
    except ValueError:
        return False
