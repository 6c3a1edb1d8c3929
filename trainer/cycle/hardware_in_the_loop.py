"""The hardware-in-the-loop cycle, also called camera in the loop (Chakravarthula et al. 2020, Algorithm 1).

D = identity
repeat K times
    patterns = phase retrieval of the pictures through the model and D
    captures = the camera's pictures of the patterns
    D = trained to take the model's predictions for the patterns to the captures, and then frozen
patterns = phase retrieval of the pictures through the model and D, shown and captured

A picture that is good enough is left alone from then on. Online (section 7 there), each picture has its own D. Where
the model has a learned field at the panel, each picture has its own field too, and its next patterns start from the
ones before. Recorded captures can take the camera's place: one set for each round, as long as there are sets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from firmware_iface.errors import InputError
from runtime.program.progress import Progress
from runtime.solver.pattern_files import write_pattern
from trainer.captures.capture_set import CaptureSet
from trainer.cycle.cycle_settings import CycleSettings
from trainer.cycle.phase_retrieval import retrieve
from trainer.cycle.show_on_bench import BenchDisplay, display_metrics, pairs_by_pattern, rows_of
from trainer.cycle.target_pictures import TargetVolume
from trainer.diagnosis.comparison import with_gains
from trainer.fitting.learned_field import with_refined_field
from trainer.model.model import Model
from trainer.model.model_file import write_model
from trainer.networks.approximator import Approximator, write_approximator
from trainer.training.image_metrics import ImageMetrics
from trainer.training.training_pairs import Pairs, pairs_of
from trainer.training.training_run import train


@dataclass
class CycleState:
    """Where a cycle is.

    Attributes
    ----------
    network : Approximator or None
        The shared D.
    own : dict of str to Approximator
        D of each picture, online.
    models : dict of str to Model
        Model of each picture with its own field, online.
    patterns : dict of str to uint8 array [C, H, W]
        The latest of each picture.
    history : list of dict of str to ImageMetrics
        Metrics of each picture, each time the pictures were shown.
    done : set of str
        Pictures that are left alone.
    pairs : dict of str to list of Pairs
        What D is learned from, by picture.
    captures : list of CaptureSet
        What the fields are learned from.
    """

    network: Approximator | None = None
    own: dict[str, Approximator] = field(default_factory=dict)
    models: dict[str, Model] = field(default_factory=dict)
    patterns: dict[str, np.ndarray] = field(default_factory=dict)
    history: list[dict[str, ImageMetrics]] = field(default_factory=list)
    done: set[str] = field(default_factory=set)
    pairs: dict[str, list[Pairs]] = field(default_factory=dict)
    captures: list[CaptureSet] = field(default_factory=list)

    def network_of(self, name: str) -> Approximator | None:
        """D of a picture; None is the identity."""
        return self.own.get(name, self.network)


def run_cycle(
    model: Model,
    wanted: Sequence[TargetVolume],
    settings: CycleSettings,
    folder: Path,
    display: BenchDisplay | None = None,
    recorded: Sequence[CaptureSet] = (),
    network: Approximator | None = None,
    progress: Progress | None = None,
) -> CycleState:
    """Run the cycle.

    Parameters
    ----------
    model : Model
        Of the bench.
    wanted : sequence of TargetVolume
        The pictures, all on the same planes.
    settings : CycleSettings
        How it is run.
    folder : path
        Where patterns, captures and networks are left, a folder for each round.
    display : BenchDisplay or None
        The bench; None: recorded captures alone, and the last patterns are written but not shown.
    recorded : sequence of CaptureSet
        Captures that take the place of the first rounds' own.
    network : Approximator or None
        D at the start; None is the identity.
    progress : callable or None
        Called with the share done and what is being done.

    Raises
    ------
    InputError
        Where there is neither a bench nor a recorded set for a round, and for pictures on different planes.
    """
    if display is None and len(recorded) < settings.rounds:
        raise InputError(
            f"{settings.rounds} rounds and {len(recorded)} recorded capture sets: give --bench, or one --recorded a "
            "round"
        )
    planes = wanted[0].planes_mm
    if any(one.planes_mm != planes for one in wanted):
        raise InputError("the pictures are on different planes: give them in runs of their own")
    cycle = CycleState(network)
    steps = settings.rounds + 1
    for number in range(steps):
        here = folder / f"round-{number}"

        def say(done: float, what: str = "", number: int = number) -> None:
            if progress:
                progress((number + done) / steps, f"round {number}: {what}")

        last = number == settings.rounds
        sets = recorded[number : number + 1]
        if not sets:
            _retrieve_all(cycle, model, wanted, settings, say)
            _write_patterns(cycle, model, here / "patterns")
        own = (
            _show(cycle, wanted, settings, display, here / "captures", say)
            if display is not None and not sets
            else None
        )
        if last or len(cycle.done) == len(wanted):
            break
        captures = sets[0] if sets else own
        if captures is not None:
            _learn(cycle, model, captures, settings, here, say, by_picture=not sets)
    return cycle


def _retrieve_all(
    cycle: CycleState, model: Model, wanted: Sequence[TargetVolume], settings: CycleSettings, say: Progress
) -> None:
    for k, one in enumerate(wanted):
        if one.name in cycle.done:
            continue
        say(0.3 * k / len(wanted), f"phase retrieval of {one.name}")
        network = cycle.network_of(one.name)
        method = settings.method if network is None else "hardware_in_the_loop"
        through = cycle.models.get(one.name, model)
        # The field of one picture holds near the patterns that it was learned from: begin there.
        start = cycle.patterns[one.name] if one.name in cycle.models else None
        cycle.patterns[one.name] = retrieve(through, one, method, network, settings.iterations, start=start)


def _write_patterns(cycle: CycleState, model: Model, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, gray in cycle.patterns.items():
        for channel, one in zip(model.bench.channels, gray, strict=True):
            write_pattern(folder / f"{name}-{channel.name}.png", one)


def _show(
    cycle: CycleState,
    wanted: Sequence[TargetVolume],
    settings: CycleSettings,
    display: BenchDisplay,
    folder: Path,
    say: Progress,
) -> CaptureSet | None:
    """Capture the pictures that are not yet good enough; their metrics go into the cycle's history."""
    active = {one.name: one for one in wanted if one.name not in cycle.done}
    say(0.3, "showing and capturing")
    captures = display.show({n: cycle.patterns[n] for n in active}, wanted[0].planes_mm, folder)
    model = with_gains(captures, replace(display.model, gain={}), captures.captures)
    metrics = {
        name: display_metrics(pairs, active[name], settings.pretrained.lpips)
        for name, pairs in pairs_by_pattern(captures, model).items()
    }
    cycle.done |= {name for name, one in metrics.items() if settings.good_enough(one)}
    before = cycle.history[-1] if cycle.history else {}
    cycle.history.append({**before, **metrics})
    return captures


def _learn(
    cycle: CycleState,
    model: Model,
    captures: CaptureSet,
    settings: CycleSettings,
    folder: Path,
    say: Progress,
    by_picture: bool,
) -> None:
    """Train D further on all captures so far; online, each picture's D on the captures of that picture alone."""
    say(0.5, "predicting what was captured")
    fitted = with_gains(captures, replace(model, gain={}), captures.captures)
    latest = (
        pairs_by_pattern(captures, fitted)
        if by_picture
        else {"": pairs_of(captures, captures.captures, fitted)}
    )
    for name, pairs in latest.items():
        cycle.pairs.setdefault(name, []).append(pairs)

    def trained(
        pairs: list[Pairs], start: Approximator | None, file: str, begin: float, part: float
    ) -> Approximator:
        network = train(
            _joined(pairs), settings.recipe, settings.steps, start=start, seed=settings.seed,
            pretrained=settings.pretrained,
            progress=lambda step, loss: say(begin + part * step / settings.steps, f"training, loss {loss:.3g}"),
        )  # fmt: skip
        about = {"channels": [c.name for c in model.bench.channels], "effects": list(model.parts)}
        write_approximator(folder / file, network, about)
        return network

    folder.mkdir(parents=True, exist_ok=True)
    if settings.online and by_picture:
        cycle.captures.append(captures)
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
            cycle.own[name] = trained(cycle.pairs[name], start, f"{name}.safetensors", 0.5 + share * k, share)
    elif settings.steps:
        every = [pairs for several in cycle.pairs.values() for pairs in several]
        cycle.network = trained(every, cycle.network, "network.safetensors", 0.5, 0.5)


def _refine_field(cycle: CycleState, model: Model, name: str) -> None:
    """A picture's own field, from all its captures; its D learns what the model with that field leaves."""
    sets = [(captures, rows) for captures in cycle.captures if (rows := rows_of(captures, name))]
    own = with_refined_field(model, sets)
    cycle.models[name] = own
    cycle.pairs[name] = [
        pairs_of(captures, rows, with_gains(captures, replace(own, gain={}), rows)) for captures, rows in sets
    ]


def _joined(several: Sequence[Pairs]) -> Pairs:
    """Pairs of several captures as one, under the white of the brightest."""
    parts: Mapping[str, Any] = {
        name: torch.cat([getattr(pairs, name) for pairs in several])
        for name in ("predicted", "measured", "weight", "noise")
    }
    captures = tuple(row for pairs in several for row in pairs.captures)
    return Pairs(**parts, white=max(pairs.white for pairs in several), captures=captures)
