"""Facts of captures.csv that the captures contradict: the distance of each plane, and exposures.

A distance that is off by the same length at every plane is an effect, `distance`. Planes that are each off by a length
of their own, as when one is misread, are not one effect but lines of captures.csv to correct. So are exposures whose
captures are all brighter or darker than stated by the same factor: a laser that drifts does not know the exposure.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from runtime.excess import PredictionErrors, joined, removed_excess
from trainer.captures.batches import load, load_batch
from trainer.captures.capture_set import CaptureSet, chosen, opened
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import CaptureRoles
from trainer.diagnosis.bench_facts import EqualFact
from trainer.diagnosis.candidate_fits import CandidateFit
from trainer.diagnosis.screen import screen_batches
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.definition import Effect
from trainer.effects.effect_catalogue import Catalogue
from trainer.fitting.pool import Pool
from trainer.fitting.predictor import Predictor, evaluate_captures
from trainer.fitting.refit import fit_from
from trainer.model.model import Model

CERTAIN = 5.0  # standard errors by which an exposure's captures differ from what is stated
LEAST_EXPOSURE = 0.003  # share by which an exposure is off at least: cameras state theirs to about this
DISTANCE, DRIFT = "distance", "laser_drift"


def plane_facts(
    roles: CaptureRoles,
    model: Model,
    errors: PredictionErrors,
    known: Catalogue,
    pool: Pool,
    thresholds: Thresholds,
    ideal_excess: float,
) -> tuple[EqualFact, ...]:
    """Planes that are each off by a length of their own.

    Parameters
    ----------
    errors : PredictionErrors
        Held-out errors of the best that is known: of the model, or of it with its best candidate. A wrong wavelength
        or pitch, too, makes each plane's distance seem off.

    Returns
    -------
    tuple of EqualFact
        `plane_mm` of each plane that is off, in mm; empty where the captures do not show so.
    """
    planes = roles.captures.planes
    if len(planes) < 2 or DISTANCE not in known:
        return ()
    base = model.without(DISTANCE) if DISTANCE in model.names else model
    rows = {
        z: [[c.capture for c in part if c.plane_mm == z] for part in (roles.fitted, roles.held_out)]
        for z in planes
    }
    if not all(fitted and held for fitted, held in rows.values()):
        return ()
    tasks = [(roles.folder, tuple(f), tuple(h), base, known[DISTANCE]) for f, h in rows.values()]
    fits = pool.map(try_at_plane, tasks)
    after = joined([f.held_out for f in fits])
    after = after.part([after.ids.index(name) for name in errors.ids])
    if not thresholds.worth_adding(removed_excess(errors, after), ideal_excess, 1):
        return ()
    facts = []
    for plane, fit in zip(planes, fits, strict=True):
        present = fit.model.instance(DISTANCE)
        offset = float(present.values["offset"])
        error = 0.0 if present.errors is None else float(present.errors["offset"])
        if abs(offset) > 3 * error:
            facts.append(EqualFact("plane_mm", plane, plane + offset, error))
    return tuple(facts)


def try_at_plane(
    folder: Path, ids: tuple[str, ...], held_ids: tuple[str, ...], model: Model, effect: Effect
) -> CandidateFit:
    """Fit an effect of one plane's captures alone, from where they say it starts; judged on its held-out captures."""
    captures = opened(folder)
    batches = load(captures, chosen(captures, ids))
    with torch.no_grad():
        (screened,) = screen_batches(batches, model, (effect,))
    fitted = fit_from(model, screened.start, batches).model
    return CandidateFit(effect.name, fitted, evaluate_captures(captures, chosen(captures, held_ids), fitted))


def exposure_facts(captures: CaptureSet, rows: Sequence[Capture], model: Model) -> tuple[EqualFact, ...]:
    """Exposures whose captures are all brighter or darker than stated.

    The exposure that most captures of a colour have is taken as right: a factor on all of them is the colour's gain.

    Parameters
    ----------
    rows : sequence of Capture
        That are looked at.
    model : Model
        With its gains; captures' own gains are left out of it.
    """
    exposures = {
        channel: Counter(c.exposure_ms for c in rows if c.channel == channel) for channel in captures.channels
    }
    several = {channel for channel, counted in exposures.items() if len(counted) > 1}
    if not several:
        return ()
    steady = model.without(DRIFT) if DRIFT in model.names else model
    logs: dict[tuple[str, float], list[float]] = {}
    with torch.no_grad():
        for row in rows:
            if row.channel in several:
                batch = load_batch(captures, [row])
                found, weight = Predictor(steady, batch).predict(steady), batch.mask
                gain = float((weight * batch.signal * found).sum() / (weight * found**2).sum())
                logs.setdefault((row.channel, row.exposure_ms), []).append(math.log(max(gain, 1e-9)))
    facts = []
    for channel in sorted(several):
        usual = exposures[channel].most_common(1)[0][0]
        groups = {e: np.array(v) for (c, e), v in logs.items() if c == channel}
        free = sum(g.size - 1 for g in groups.values())
        if free < 1:
            continue
        spread = math.sqrt(sum(float(((g - g.mean()) ** 2).sum()) for g in groups.values()) / free)
        for exposure in sorted(groups):
            off = float(groups[exposure].mean() - groups[usual].mean())
            error = spread * math.sqrt(1 / groups[exposure].size + 1 / groups[usual].size)
            if exposure != usual and abs(off) > max(CERTAIN * error, LEAST_EXPOSURE):
                right = exposure * math.exp(off)
                facts.append(EqualFact("exposure_ms", exposure, right, right * error))
    return tuple(facts)


def facts_sentence(facts: Sequence[EqualFact]) -> str:
    """What to correct in captures.csv, in one sentence; "" for nothing."""
    if not facts:
        return ""
    return f"captures.csv is contradicted by its pictures: correct {' and '.join(map(str, facts))} there."
