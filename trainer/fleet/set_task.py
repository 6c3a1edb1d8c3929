"""What a worker does with one capture set of a fleet: explain it, or fit a model to it again."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from trainer.captures.capture_set import CaptureSet, opened
from trainer.captures.check_set import errors_unless_misread
from trainer.captures.signal_present import with_signal
from trainer.diagnosis.explanation import explain
from trainer.effects.definition import Parameter
from trainer.effects.effect_catalogue import Catalogue, catalogue
from trainer.fitting.pool import open_pool
from trainer.fleet.recalibration import recalibrate
from trainer.fleet.set_facts import time_of
from trainer.fleet.set_result import FittedNumber, SetFacts, SetResult
from trainer.model.model import EffectInstance, Model
from trainer.model.model_file import read_model
from trainer.model.model_stages import ideal_irradiance


@dataclass(frozen=True)
class SetTask:
    """A capture set to work on; pictures travel as the folder's path.

    Attributes
    ----------
    facts : SetFacts
    model : Path or None
        The model to fit again; None: explain the set from the ideal one.
    effects : tuple of Path
        Files of a user's own effects.
    """

    facts: SetFacts
    model: Path | None = None
    effects: tuple[Path, ...] = ()


def finished(task: SetTask) -> SetResult:
    """The result of a set. What fails is in the result, so that other sets go on."""
    begin = time.monotonic()
    try:
        result = _result(task)
    except MemoryError:
        result = failed(task, InputError("there is not enough memory for it: use fewer workers"))
    except Exception as error:
        result = failed(task, error)
    return replace(result, seconds=time.monotonic() - begin)


def failed(task: SetTask, error: Exception) -> SetResult:
    """The result of a set on which an error ended the work."""
    known = isinstance(error, InputError)
    text = str(error) if known else f"{type(error).__name__}: {error}"
    return SetResult(task.facts, " ".join(text.split()) or type(error).__name__, _text(task.model))


def _result(task: SetTask) -> SetResult:
    captures = opened(Path(task.facts.folder))
    time_of(captures)  # which says what is wrong with it
    known = catalogue(task.effects)
    model = None if task.model is None else read_model(task.model, known, captures.bench)
    warnings = _warnings(captures)
    found = SetResult(
        task.facts,
        model=_text(task.model),
        warnings=warnings,
        captures_sha256=captures.content_hash(),
        captures=len(captures),
    )
    if model is None:
        return _explained(found, captures, known)
    again = recalibrate(captures, model)
    return replace(
        found,
        verdict="complete" if again.complete else "incomplete",
        excess_before=again.before.excess,
        excess_after=again.after.excess,
        noise_nrmse=again.after.noise_nrmse,
        numbers=fitted_numbers(again.model),
    )


def _explained(found: SetResult, captures: CaptureSet, known: Catalogue) -> SetResult:
    with open_pool(1) as here:  # sets are shared out among workers, and each is one worker's
        explanation = explain(captures, Model(captures.bench), known, here)
    first, last = explanation.steps[0].held_out, explanation.steps[-1].held_out
    alike = {s.added: ", ".join(s.indistinguishable_from) for s in explanation.steps if s.added}
    return replace(
        found,
        verdict=explanation.diagnosis.verdict,
        excess_before=first.excess,
        excess_after=last.excess,
        noise_nrmse=last.noise_nrmse,
        indistinguishable=tuple((name, others) for name, others in alike.items() if others),
        numbers=fitted_numbers(explanation.model),
    )


def _warnings(captures: CaptureSet) -> tuple[str, ...]:
    """What is wrong with a set that can still be used.

    Raises
    ------
    InputError
        Where every number would be wrong, or no capture can be used.
    """
    said = [p.message for p in errors_unless_misread(captures.folder, ideal_irradiance) if p.kind != "dark"]
    _, left_out = with_signal(captures)
    return (*said, *(f"left out capture {name} ({why})" for name, why in left_out.items()))


def fitted_numbers(model: Model) -> tuple[FittedNumber, ...]:
    """The numbers of a model's effects; maps with a number for each pixel and nodes of free-form maps are left out."""
    return tuple(n for p in model.present for n in _numbers(p, model))


def _numbers(present: EffectInstance, model: Model) -> Iterator[FittedNumber]:
    for parameter in present.effect.parameters:
        if parameter.per_pixel:
            continue
        values = present.values[parameter.name]
        errors = present.errors[parameter.name] if present.errors else np.full(values.shape, math.nan)
        absent = parameter.absent_value(model.bench)
        for place in product(*map(range, values.shape)):
            channel = model.bench.channels[place[0]].name if parameter.per_channel else None
            rest = place[1:] if parameter.per_channel else place
            yield FittedNumber(
                present.effect.name,
                present.effect.stage,
                parameter.name,
                channel,
                rest[0] + 1 if rest else None,
                _term_name(parameter, present.order, rest[0]) if rest else None,
                float(values[place]),
                float(errors[place]),
                absent,
                parameter.unit,
            )


def _term_name(parameter: Parameter, order: int, index: int) -> str | None:
    names = parameter.terms(order) if parameter.terms else ()
    return names[index] if index < len(names) else None


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
