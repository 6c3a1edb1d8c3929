"""What the studio's worker processes do. Each task is called with `say` first, as `trainer.studio.jobs` describes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from runtime.program.outputs import emptied
from runtime.program.progress import Progress
from runtime.program.threads import cores
from trainer.captures.batches import load
from trainer.captures.block_means import blocks
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.captures.capture_table import ids_of
from trainer.captures.check_set import check_captures
from trainer.captures.held_out import capture_roles
from trainer.captures.problems import Problem
from trainer.diagnosis.addition import add
from trainer.diagnosis.candidate_fits import try_effect
from trainer.diagnosis.capture_errors import CaptureErrors, capture_errors
from trainer.diagnosis.diagnosis import Diagnosis, diagnose, ideal_errors, with_previews
from trainer.diagnosis.error_budget import error_budget
from trainer.diagnosis.explanation import explain
from trainer.diagnosis.previews import CandidatePreview, previews
from trainer.diagnosis.ranking import RankedEffect, rank
from trainer.diagnosis.screen import screen_batches
from trainer.diagnosis.telling import screened_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue, find_effect, forget_effect_files
from trainer.fitting.gains import with_gains
from trainer.fitting.learned_field import learn_field
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.history import recorded
from trainer.model.model import Model
from trainer.model.model_stages import ideal_irradiance
from trainer.networks.approximator import Approximator, read_approximator, write_approximator
from trainer.report.heat_maps import from_zero, symmetric
from trainer.studio.jobs import Say

SHOWN_PX = 480  # along a picture's longer side, where the whole of it is shown
SMALL_PX = 60_000  # of a picture: below, processes of a pool cost more time than they save
PROGRESS_S = 0.15  # between two words on progress


@dataclass(frozen=True)
class CapturePrediction:
    """One capture, measured and predicted, for the page.

    Attributes
    ----------
    capture : str
    measured, predicted : float32 array [h, w], counts above black
    valid : bool array [h, w]
        False where saturated.
    levels : dict of float32 arrays [3, h', w']
        Measured, predicted and difference (counts; NaN where saturated) as means of blocks, by the blocks' side: 1
        where the whole picture fits the page so, and else 2, 4 and so on until it does.
    light, apart : float, counts
        Ends of the colour scales: of both pictures, and of the difference.
    errors : CaptureErrors or None
        None where every pixel is saturated.
    """

    capture: str
    measured: np.ndarray
    predicted: np.ndarray
    valid: np.ndarray
    levels: dict[int, np.ndarray]
    light: float
    apart: float
    errors: CaptureErrors | None


def block_side(pixels: int) -> int:
    """Side of the blocks, a power of two, with which that many pixels fit the page."""
    return 1 << max(0, (-(-pixels // SHOWN_PX) - 1).bit_length())


def check(say: Say, folder: Path) -> list[Problem]:
    """Everything that is wrong with a capture set."""
    return check_captures(folder, ideal_irradiance)


def fit_gains(say: Say, folder: Path, model: Model) -> Model:
    """The model with the gains that it lacks."""
    captures = opened(folder)
    return with_gains(captures, model, capture_roles(captures).fitted)


def predict(
    say: Say, folder: Path, model: Model, capture: str, network: Path | None, effects_version: int
) -> CapturePrediction:
    """One capture, measured and predicted, and where they differ."""
    captures = opened(folder)
    row = chosen(captures, (capture,))[0]
    learned = None if network is None else _network_in(network, network.stat().st_mtime_ns)
    residual, errors = capture_errors(captures, row, model, learned)
    measured, predicted = residual.measured.astype(np.float32), residual.predicted.astype(np.float32)
    return shown_as(capture, measured, predicted, residual.mask > 0, errors)


@lru_cache(maxsize=1)
def _network_in(path: Path, time_ns: int) -> Approximator:
    return read_approximator(path)[0]


def shown_as(
    capture: str, measured: np.ndarray, predicted: np.ndarray, valid: np.ndarray, errors: CaptureErrors | None
) -> CapturePrediction:
    """A capture and its prediction with all that the page needs to show them."""
    apart = np.where(valid, measured - predicted, np.nan).astype(np.float32)
    whole = block_side(max(measured.shape))
    sides = [2**k for k in range(1, whole.bit_length())] or [1]
    levels = {
        s: np.stack([blocks(a, s).astype(np.float32) for a in (measured, predicted, apart)]) for s in sides
    }
    least = levels[whole]
    return CapturePrediction(
        capture,
        measured,
        predicted,
        valid,
        levels,
        from_zero([least[0], least[1]])[1],
        symmetric([least[2]])[1],
        errors,
    )


def find_missing(say: Say, folder: Path, model: Model, effects: Sequence[Path]) -> Diagnosis:
    """What `diagnose` does, and what each candidate would change."""
    captures, known = _begin(folder, effects)
    with open_pool(_workers(captures)) as pool:
        found = diagnose(captures, model, known, pool, Thresholds(), _progress(say))
    say("progress", (0.97, "drawing what each candidate would change"))
    return with_previews(captures, found)


def add_effect(
    say: Say, folder: Path, model: Model, name: str, effects: Sequence[Path]
) -> tuple[Model, Diagnosis | None]:
    """What `add` does; with the verdict where the model is then complete."""
    captures, known = _begin(folder, effects)
    model = _recorded_start(captures, model)
    found = add(captures, model, find_effect(known, name), _progress(say, 0.9))
    return found.model, _complete(captures, found.model, effects)


def explain_all(say: Say, folder: Path, model: Model, effects: Sequence[Path]) -> Diagnosis:
    """What `explain` does; each better model is said as ("model", model) at once."""
    captures, known = _begin(folder, effects)
    start = model

    def save(better: Model) -> None:
        if better.names != start.names or better.history[:-1] != start.history:
            say("model", better)

    with open_pool(_workers(captures)) as pool:
        found = explain(captures, model, known, pool, Thresholds(), save, _progress(say))
    return with_previews(captures, found.diagnosis)


def try_own(
    say: Say, folder: Path, model: Model, names: Sequence[str], effects: Sequence[Path]
) -> tuple[list[RankedEffect], list[CandidatePreview]]:
    """Fit effects of the user's own next to what is present, as `diagnose` does, and draw what they would change."""
    captures, known = _begin(folder, effects)
    roles = capture_roles(captures)
    model = with_gains(captures, model, roles.fitted)
    before = evaluate_captures(captures, roles.held_out, model)
    ideal = ideal_errors(roles, model) if model.present else before
    screened = screened_captures(roles, model)
    progress, fits = _progress(say), []
    for k, name in enumerate(names):
        progress(k / len(names), f"fitting {name}")
        one = find_effect(known, name)
        batches = load(captures, screened)
        start = screen_batches(batches, model, (one,))[0].start
        ids, held = ids_of(roles.fitted), ids_of(roles.held_out)
        fits.append(try_effect(folder, ids, held, model, start, True))
    ranking = rank(before, fits, known, Thresholds(), ideal.excess, len(known))
    return ranking, previews(captures, model, ranking)


def learn_panel_field(say: Say, folder: Path, model: Model) -> tuple[Model, float, float]:
    """A field learned at the panel, with the held-out excess before and after."""
    captures = opened(folder)
    _share_threads(captures)
    model = _recorded_start(captures, model)
    progress = _progress(say)
    found = learn_field(
        captures, model, lambda done, what="": progress(done, "learning the field at the panel")
    )
    return found.model, found.before.excess, found.after.excess


def train_network(say: Say, folder: Path, model: Model, steps: int, out: Path) -> tuple[Path, float, float]:
    """A network trained beyond the model: its file, and the held-out excess without and with it."""
    from trainer.training.recipe import recipe_named
    from trainer.training.training_run import NETWORK, train
    from trainer.training.training_sets import training_sets

    captures = opened(folder)
    _share_threads(captures)
    progress = _progress(say)
    sets = training_sets(
        captures, model, progress=lambda done, what="": progress(0.1 * done, "predicting what the model says")
    )
    emptied(out)
    out.mkdir(parents=True, exist_ok=True)
    network = train(
        sets.fitted, recipe_named("compact"), steps, out, sets.held_out, about=sets.about,
        progress=lambda step, loss: progress(0.1 + 0.8 * step / steps, f"step {step} of {steps}, loss {loss:.3g}"),
    )  # fmt: skip
    progress(0.9, "comparing with captures that the network has not seen")
    before, after = (error_budget(captures, sets.model, one).unexplained for one in (None, network))
    about = {**sets.about, "steps": steps, "excess_before": before, "excess_after": after}
    write_approximator(out / NETWORK, network, about)
    return out / NETWORK, before, after


def _begin(folder: Path, effects: Sequence[Path]) -> tuple[CaptureSet, Any]:
    forget_effect_files()
    captures = opened(folder)
    _share_threads(captures)
    return captures, catalogue(effects)


def _share_threads(captures: CaptureSet) -> None:
    """One thread for small pictures: on those, threads wait for each other longer than they work."""
    torch.set_num_threads(1 if _is_small(captures) else cores())


def _workers(captures: CaptureSet) -> int:
    return 1 if _is_small(captures) else cores()


def _is_small(captures: CaptureSet) -> bool:
    return captures.bench.panel.width * captures.bench.panel.height < SMALL_PX


def _progress(say: Say, end: float = 1.0) -> Progress:
    """Passes on how far the work is, not more often than a person can see."""
    last: list[Any] = ["", 0.0]

    def progress(done: float, what: str = "") -> None:
        now = time.monotonic()
        what = what or str(last[0])
        if what != last[0] or now - float(last[1]) > PROGRESS_S:
            last[:] = [what, now]
            say("progress", (end * done, what))

    return progress


def _recorded_start(captures: CaptureSet, model: Model) -> Model:
    """The model with its own errors as the first record of its history, where it has none."""
    if model.history:
        return model
    roles = capture_roles(captures)
    model = with_gains(captures, model, roles.fitted)
    return recorded(model, None, evaluate_captures(captures, roles.held_out, model))


def _complete(captures: CaptureSet, model: Model, effects: Sequence[Path]) -> Diagnosis | None:
    """The verdict where it is "complete", which needs no search."""
    with open_pool(1) as pool:
        roles = capture_roles(captures)
        errors = evaluate_captures(captures, roles.held_out, with_gains(captures, model, roles.fitted))
        ideal = ideal_errors(roles, model)
        if not Thresholds().complete(errors.excess, ideal.excess):
            return None
        return diagnose(captures, model, catalogue(effects), pool, ideal=ideal, thorough=False)
