"""Seed Algorithm 1, the hardware-in-the-loop cycle.

D = identity
repeat K times
    patterns = phase retrieval of the pictures through the model and D
    captures = what the camera sees of the patterns
    D = trained to take what the model says of the patterns to the captures, and then frozen
patterns = phase retrieval of the pictures through the model and D, shown and captured

A picture that is good enough is left alone from then on. Online (seed section 7), each picture has a D of its own, and
where the model has a learned field at the panel, a field of its own, with which the patterns before are bettered.
Captures that were recorded stand in for the camera's: one set a round, as long as there are sets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from firmware_iface.errors import InputError
from runtime.solver.pattern_files import write_pattern
from trainer.captures.capture_set import CaptureSet
from trainer.cycle.retrieval import ITERATIONS, Volume, retrieve
from trainer.cycle.show_on_bench import Stage, display_likeness, rows_of, seen_pairs
from trainer.diagnosis.compare import with_gains
from trainer.fitting.learn_field import with_refined_field
from trainer.model.model import Model
from trainer.model.model_file import write_model
from trainer.networks.approximator import Approximator, write_approximator
from trainer.training.likeness import Likeness
from trainer.training.pairs import Pairs, pairs_of
from trainer.training.recipe import Recipe
from trainer.training.train import Judges, train

GOOD_LPIPS, GOOD_SSIM = 0.5, 0.95  # 1 - LPIPS is the seed's; SSIM stands in where LPIPS has no weights

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Settings:
    """How a cycle is run.

    rounds : K. recipe, steps : of each training; with 0 steps there is no network. method : of phase retrieval, through
    the model alone in the first round and through D after it. good : 1 - LPIPS (SSIM without weights) from which a
    picture is left alone; None: GOOD_LPIPS, GOOD_SSIM. online : each picture has its own D, and its own field
    """

    rounds: int
    recipe: Recipe
    steps: int
    iterations: int = ITERATIONS
    method: str = "hardware_in_the_loop"
    good: float | None = None
    online: bool = False
    seed: int = 0
    judges: Judges = field(default_factory=Judges)

    def good_enough(self, found: Likeness) -> bool:
        """Whether a picture is left alone."""
        if found.one_minus_lpips is not None:
            return found.one_minus_lpips > (GOOD_LPIPS if self.good is None else self.good)
        return found.ssim > (GOOD_SSIM if self.good is None else self.good)


@dataclass
class Cycle:
    """Where a cycle stands.

    network : shared D; own : D of each picture, online. models : model with its own field of each picture, online
    patterns : the latest of each picture, uint8 [C, H, W]. history : of each showing, how near each picture came
    done : pictures that are left alone. seen, taken : what D and the fields are learned from
    """

    network: Approximator | None = None
    own: dict[str, Approximator] = field(default_factory=dict)
    models: dict[str, Model] = field(default_factory=dict)
    patterns: dict[str, np.ndarray] = field(default_factory=dict)
    history: list[dict[str, Likeness]] = field(default_factory=list)
    done: set[str] = field(default_factory=set)
    seen: dict[str, list[Pairs]] = field(default_factory=dict)
    taken: list[CaptureSet] = field(default_factory=list)

    def network_of(self, name: str) -> Approximator | None:
        """What a picture is looked at through; None is the identity."""
        return self.own.get(name, self.network)


def run_cycle(
    model: Model,
    wanted: Sequence[Volume],
    settings: Settings,
    folder: Path,
    stage: Stage | None = None,
    recorded: Sequence[CaptureSet] = (),
    network: Approximator | None = None,
    progress: Progress | None = None,
) -> Cycle:
    """Run the cycle; patterns, captures and networks are left in `folder`, a folder a round.

    stage : the bench; None: recorded captures alone, and the last patterns are written but not shown
    network : a D to begin with; none: the identity
    Raises InputError where there is neither a bench nor a recorded set for a round.
    """
    if stage is None and len(recorded) < settings.rounds:
        raise InputError(
            f"{settings.rounds} rounds and {len(recorded)} recorded capture sets: give --bench, or one --recorded a "
            "round"
        )
    planes = wanted[0].planes_mm
    if any(one.planes_mm != planes for one in wanted):
        raise InputError("the pictures are on different planes: give them in runs of their own")
    cycle = Cycle(network)
    steps = settings.rounds + 1
    for number in range(steps):
        here = folder / f"round-{number}"

        def say(share: float, what: str, number: int = number) -> None:
            if progress:
                progress((number + share) / steps, f"round {number}: {what}")

        last = number == settings.rounds
        sets = recorded[number : number + 1]
        if not sets:
            _retrieve_all(cycle, model, wanted, settings, say)
            _write_patterns(cycle, model, here / "patterns")
        shown = (
            _show(cycle, wanted, settings, stage, here / "captures", say)
            if stage is not None and not sets
            else None
        )
        if last or len(cycle.done) == len(wanted):
            break
        captures = sets[0] if sets else shown
        if captures is not None:
            _learn(cycle, model, captures, settings, here, say, by_picture=not sets)
    return cycle


def _retrieve_all(
    cycle: Cycle, model: Model, wanted: Sequence[Volume], settings: Settings, say: Progress
) -> None:
    for k, one in enumerate(wanted):
        if one.name in cycle.done:
            continue
        say(0.3 * k / len(wanted), f"phase retrieval of {one.name}")
        network = cycle.network_of(one.name)
        method = settings.method if network is None else "hardware_in_the_loop"
        through = cycle.models.get(one.name, model)
        # A field of one picture is true near the patterns that it was learned from: begin there.
        start = cycle.patterns[one.name] if one.name in cycle.models else None
        cycle.patterns[one.name] = retrieve(through, one, method, network, settings.iterations, start=start)


def _write_patterns(cycle: Cycle, model: Model, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, gray in cycle.patterns.items():
        for channel, one in zip(model.bench.channels, gray, strict=True):
            write_pattern(folder / f"{name}-{channel.name}.png", one)


def _show(
    cycle: Cycle, wanted: Sequence[Volume], settings: Settings, stage: Stage, folder: Path, say: Progress
) -> CaptureSet | None:
    """Capture the pictures that are not yet good enough; what was seen of each goes into the cycle's history."""
    active = {one.name: one for one in wanted if one.name not in cycle.done}
    say(0.3, "showing and capturing")
    captures = stage.show({n: cycle.patterns[n] for n in active}, wanted[0].planes_mm, folder)
    model = with_gains(captures, replace(stage.model, gain={}), captures.captures)
    found = {
        name: display_likeness(seen, active[name], settings.judges.lpips)
        for name, seen in seen_pairs(captures, model).items()
    }
    cycle.done |= {name for name, one in found.items() if settings.good_enough(one)}
    before = cycle.history[-1] if cycle.history else {}
    cycle.history.append({**before, **found})
    return captures


def _learn(
    cycle: Cycle,
    model: Model,
    captures: CaptureSet,
    settings: Settings,
    folder: Path,
    say: Progress,
    by_picture: bool,
) -> None:
    """Train D further on all that was seen so far; online, each picture's D on what was seen of it alone."""
    say(0.5, "predicting what was captured")
    fitted = with_gains(captures, replace(model, gain={}), captures.captures)
    latest = (
        seen_pairs(captures, fitted) if by_picture else {"": pairs_of(captures, captures.captures, fitted)}
    )
    for name, pairs in latest.items():
        cycle.seen.setdefault(name, []).append(pairs)

    def taught(
        pairs: list[Pairs], start: Approximator | None, file: str, begin: float, part: float
    ) -> Approximator:
        network = train(
            joined(pairs), settings.recipe, settings.steps, start=start, seed=settings.seed, judges=settings.judges,
            progress=lambda step, loss: say(begin + part * step / settings.steps, f"training, loss {loss:.3g}"),
        )  # fmt: skip
        about = {"channels": [c.name for c in model.bench.channels], "effects": list(model.parts)}
        write_approximator(folder / file, network, about)
        return network

    folder.mkdir(parents=True, exist_ok=True)
    if settings.online and by_picture:
        cycle.taken.append(captures)
        active = [name for name in latest if name not in cycle.done]
        for k, name in enumerate(active):
            share = 0.5 / len(active)
            if model.panel_field is not None:
                say(0.5 + share * k, f"refining the field at the panel for {name}")
                _refine_field(cycle, model, name)
                write_model(folder / f"{name}.toml", cycle.models[name])
            if not settings.steps:
                continue
            start = cycle.network_of(name)
            cycle.own[name] = taught(cycle.seen[name], start, f"{name}.safetensors", 0.5 + share * k, share)
    elif settings.steps:
        every = [pairs for several in cycle.seen.values() for pairs in several]
        cycle.network = taught(every, cycle.network, "network.safetensors", 0.5, 0.5)


def _refine_field(cycle: Cycle, model: Model, name: str) -> None:
    """A picture's own field, from all that was captured of it; its D sees what the model with that field says."""
    sets = [(captures, rows) for captures in cycle.taken if (rows := rows_of(captures, name))]
    own = with_refined_field(model, sets)
    cycle.models[name] = own
    cycle.seen[name] = [
        pairs_of(captures, rows, with_gains(captures, replace(own, gain={}), rows)) for captures, rows in sets
    ]


def joined(several: Sequence[Pairs]) -> Pairs:
    """Pairs of several captures as one, under the white of the brightest."""
    parts: Mapping[str, Any] = {
        name: torch.cat([getattr(pairs, name) for pairs in several])
        for name in ("predicted", "measured", "weight", "noise")
    }
    captures = tuple(row for pairs in several for row in pairs.captures)
    return Pairs(**parts, white=max(pairs.white for pairs in several), captures=captures)
