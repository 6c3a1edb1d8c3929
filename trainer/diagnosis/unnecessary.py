"""Effects that a model does as well without."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.batches import Batch, load, signal_variance
from trainer.captures.capture_set import chosen, opened
from trainer.captures.capture_table import ids_of
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.verdict import Thresholds
from trainer.fitting.dependence import Dependence, dependence
from trainer.fitting.gauss_newton import HOLD, FitResult, fit
from trainer.fitting.idle_effects import most_telling
from trainer.fitting.least_squares_gain import with_gain
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import Predictor, evaluate_captures, excess_on, telling
from trainer.fitting.refit import settled
from trainer.model.model import Model

FEW_STEPS = 3
# An effect is needed where the most telling capture of each colour and plane says so: where it changes that picture, in
# a way that a straight-line step of the others could not, by CHANGES times what is left or makes a difference, or where
# the others, fitted to that capture alone, leave NEEDED times as much there. All captures leave no less. Fitted to the
# end there, they may as well be compared with what is left, where they leave NEEDED times what makes a difference.
CHANGES, NEEDED, NEEDED_AT_LAST = 30.0, 10.0, 1.5
# Of what makes a difference: where no more is left without an effect that is read off the captures, and has no numbers
# whose work others could do, these need no fit.
NOTHING = 0.1


def without_one(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    names: Sequence[str],
    thresholds: Thresholds,
    ideal_excess: float,
    pool: Pool,
    thorough: bool = True,
) -> tuple[str, Model, PredictionErrors] | None:
    """The model without one of the named effects, if there is one that it does as well without.

    Parameters
    ----------
    errors : PredictionErrors
        Of `model` on the held-out captures.
    thorough : bool
        Refit the others to the end, and where something is unexplained raise their orders, to see whether they do its
        work. A few steps of the fit without it.

    Returns
    -------
    (str, Model, PredictionErrors) or None
        What was left out, and the model without it, refitted.
    """
    ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
    least = thresholds.least(ideal_excess)
    if not names:
        return None
    numbers = dependence(model, most_telling(model, load(roles.captures, roles.fitted)))
    names = _in_doubt(numbers, names, least)
    raising = thorough and not thresholds.complete(errors.excess, ideal_excess)
    where = roles.folder, ids, held, model
    for first in range(0, len(names), pool.workers):  # as many at a time as there are processes
        some = names[first : first + pool.workers]
        iterations = 12 if thorough else FEW_STEPS
        tasks = [
            (*where, name, _begun_without(numbers, name), errors.excess, raising, iterations, least)
            for name in some
        ]
        for name, found in zip(some, pool.map_here_if_one(fitted_without, tasks), strict=True):
            if found is not None and not thresholds.worth_adding(
                removed_excess(found[1], errors), ideal_excess, 1
            ):
                return name, *found
    return None


def _in_doubt(numbers: Dependence, names: Sequence[str], least: float) -> list[str]:
    """Those of the named effects that are not clearly needed."""
    left = max(excess_on(numbers.model, numbers.batches), least)
    clear = CHANGES * signal_variance(numbers.batches) * left
    return [name for name in names if numbers.change_without({name}) < clear]


def _begun_without(numbers: Dependence, name: str) -> Model:
    """The model without an effect, the others with its work, unless that differs from capture to capture."""
    model = numbers.model
    return model.without(name) if model.instance(name).effect.measure else numbers.without([name])


def fitted_without(
    folder: Path,
    ids: tuple[str, ...],
    held_ids: tuple[str, ...],
    model: Model,
    name: str,
    rest: Model,
    with_it: float,
    raising: bool,
    iterations: int,
    least: float,
) -> tuple[Model, PredictionErrors] | None:
    """A model without one effect, the others fitted together, and its errors on held-out captures.

    A task for any process.

    Parameters
    ----------
    folder : Path
        Of the capture set.
    ids, held_ids : tuple of str
        Captures to fit, and captures to judge by.
    rest : Model
        Where the fit without the effect begins.
    with_it : float
        Excess of the model on the held-out captures.
    raising : bool
        Raise orders as far as that helps.
    iterations : int
        Of the fit, where orders are not raised.
    least : float
        Excess that makes no difference.

    Returns
    -------
    (Model, PredictionErrors) or None
        None where a few captures show already that the model needs the effect.
    """
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    rest = with_gain(rest, [Predictor(rest, b) for b in batches])  # it may have had the gains' work
    # what shows from capture to capture does not in one
    measured = model.instance(name).effect.measure is not None
    few = [telling(rest, b, 2 if measured else 1) for b in batches]
    left = excess_on(model, few)
    if measured and excess_on(rest, few) < left + NOTHING * least:
        errors = evaluate_captures(captures, chosen(captures, held_ids), rest)
        if errors.excess < with_it + NOTHING * least:
            return rest, errors
    near = fit(rest, rest.names, few, FEW_STEPS, hold=HOLD)
    if near.errors.excess > NEEDED * max(left, least):
        return None

    def to_the_end(start: Model, some: Sequence[Batch]) -> FitResult:
        return settled(start, some) if raising else fit(start, start.names, some, iterations)

    most = max(NEEDED_AT_LAST * left, NEEDED * least)
    if near.errors.excess > most and to_the_end(near.model, few).errors.excess > most:
        return None
    fitted = to_the_end(rest, batches)
    return fitted.model, evaluate_captures(captures, chosen(captures, held_ids), fitted.model)
