"""What each method predicts, and what the camera sees of each method's patterns, on pictures held out.

Networks learn from captures of photographs that are shown with patterns for the ideal model, the physical model
from the usual patterns, the field at the panel (beyond the physical model) from the networks' captures. Two other
photographs are held out; all numbers are means over them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from firmware_iface.virtual import VirtualHeadset, open_headset
from trainer.captures.acquire import capture_set
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.cycle.loop import Cycle, Settings, run_cycle
from trainer.cycle.retrieval import Volume, retrieve
from trainer.cycle.show_on_bench import Stage, display_likeness, seen_pairs, with_iris_beside
from trainer.cycle.test_pictures import HELD_OUT, LEARNED, in_depth, photographs
from trainer.fitting.gains import with_gains
from trainer.fitting.learn_field import with_learned_field
from trainer.model.model import Model
from trainer.networks.approximator import Approximator, read_approximator
from trainer.training.likeness import Likeness, evaluate, mean_likeness, noise_floor
from trainer.training.pairs import Pairs, pairs_of
from trainer.training.recipe import RECIPES, STEPS, Recipe
from trainer.training.train import NETWORK, Judges, train

PREDICTION = (
    "ideal", *(name for name in RECIPES if name != "compact"), "physics", "physics_compact", "field", "field_compact",
)  # fmt: skip
DISPLAY = (
    "gerchberg_saxton", "double_phase", "wirtinger", "wirtinger_no_zero_order", "network_1", "network_2", "physics",
    "physics_network", "online", "field", "field_network", "field_online",
)  # fmt: skip
STACK = ("wirtinger", "network_1", "physics", "physics_network", "field")
METHODS = tuple(dict.fromkeys((*PREDICTION, *DISPLAY)))
DEPTHS = (0.9, 1.0, 1.1)  # planes of the stack, in units of the bench's distance
ONLINE = {"online": 2, "field_online": 4}  # rounds of refinement; a field is quick to refine
ORACLE_ITERATIONS = 300  # beyond the best pattern of the methods: from there on it gains little

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Sizes:
    """How much is spent: widths of the networks (None: as published), steps of a training, of a descent."""

    filters: int | None = 8
    steps: int = 400
    iterations: int = 100

    @staticmethod
    def full() -> Sizes:
        """As published."""
        return Sizes(None, STEPS, 200)


def run_evaluation(
    spec: str,
    methods: Sequence[str] = METHODS,
    sizes: Sizes | None = None,
    judges: Judges | None = None,
    model: Model | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """The object that `evaluate --json` prints.

    spec : of a virtual bench. methods : of METHODS, those to be compared. model : of the bench's physics; without it,
    `explain` finds one. Raises InputError for an unknown method or bench, and a bench without a truth to ask.
    """
    for name in methods:
        if name not in METHODS:
            raise InputError(f"there is no method '{name}': {nearest(name, METHODS)}")
    with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
        bench = _Comparison(spec, sizes or Sizes(), judges or Judges(), model, seed, workers, Path(folder))
        return bench.table(methods, progress or (lambda done, what: None))


@dataclass
class _Comparison:
    """One bench, and what is learned on it; each part is made when first asked for."""

    spec: str
    sizes: Sizes
    judges: Judges
    given: Model | None
    seed: int
    workers: int | None
    folder: Path
    patterns: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    @cached_property
    def headset(self) -> VirtualHeadset:
        """Only a virtual bench knows the truth that an oracle is asked for."""
        return open_headset(self.spec, self.seed)

    @cached_property
    def bench(self) -> Bench:
        return nominal_bench(self.headset)

    @cached_property
    def ideal(self) -> Model:
        return Model(self.bench)

    @cached_property
    def learned(self) -> list[Volume]:
        return photographs(LEARNED, self.bench, mirrored=True)

    @cached_property
    def held_out(self) -> list[Volume]:
        return photographs(HELD_OUT, self.bench)

    @cached_property
    def physics(self) -> Model:
        """The model of the named effects."""
        if self.given is not None:
            if (self.given.bench.panel, self.given.bench.channels) != (self.bench.panel, self.bench.channels):
                raise InputError(f"--model is of another bench than {self.spec}: its panel or colours differ")
            return self.given
        from trainer.diagnosis.explain import explain
        from trainer.effects.effect_catalogue import catalogue
        from trainer.fitting.pool import open_pool

        captures = self.captured("usual", None)
        with open_pool(self.workers) as pool:
            return explain(captures, self.ideal, catalogue(), pool).model

    @cached_property
    def field(self) -> Model:
        """The physical model with a field learned at the panel, from the captures that networks learn from."""
        captures = self.captured("learned", self.learned)
        rows = captures.captures[1:]
        fitted = with_gains(captures, replace(self.physics, gain={}, panel_field=None), rows)
        return with_learned_field(captures, rows, fitted)

    def model_of(self, method: str) -> Model:
        """The model that a method looks through."""
        if method.startswith("field"):
            return self.field
        return self.physics if method.startswith("physics") or method == "online" else self.ideal

    def captured(self, name: str, pictures: list[Volume] | None) -> CaptureSet:
        """Captures of pictures with patterns for the ideal model; None: of the usual patterns."""
        folder = self.folder / name
        if not folder.exists():
            if pictures is None:
                capture_set(self.headset, self.bench, folder, seed=self.seed)
            else:
                patterns = {
                    v.name: retrieve(self.ideal, v, "wirtinger", None, self.sizes.iterations)
                    for v in pictures
                }
                Stage(self.headset, self.bench, self.ideal).show(patterns, (self.bench.distance_mm,), folder)
        return read_captures(folder)

    def pairs(self, name: str, pictures: list[Volume], model: Model) -> Pairs:
        """Pairs of captured pictures under a model, the repeat left out."""
        captures = self.captured(name, pictures)
        rows = captures.captures[1:]
        fitted = with_gains(captures, replace(model, gain={}), rows)
        return pairs_of(captures, rows, fitted)

    def recipe(self, name: str) -> Recipe:
        """A recipe, as wide as is to be spent."""
        recipe = RECIPES[name]
        return recipe if self.sizes.filters is None else replace(recipe, filters=self.sizes.filters)

    def predicted(self, method: str) -> Likeness:
        """How near a method's prediction is to the captures of the held-out pictures."""
        model = self.model_of(method)
        unseen = self.pairs("held-out", self.held_out, model)
        if method in ("ideal", "physics", "field"):
            return evaluate(unseen, None, self.judges.lpips)
        seen = self.pairs("learned", self.learned, model)
        recipe = self.recipe(method.removeprefix("physics_").removeprefix("field_"))
        network = train(seen, recipe, self.sizes.steps, judges=self.judges, seed=self.seed)
        return evaluate(unseen, network, self.judges.lpips)

    def cycle(self, model: Model, rounds: int, name: str) -> Path:
        """Where a cycle over the learned pictures has left its networks."""
        folder = self.folder / name
        if not folder.exists():
            stage = Stage(self.headset, self.bench, self.ideal)
            run_cycle(model, self.learned, self.settings(rounds), folder, stage)
        return folder

    def settings(self, rounds: int, online: bool = False) -> Settings:
        """A cycle in which no picture is ever good enough, so that all methods go the whole way."""
        recipe, sizes = self.recipe("compact"), self.sizes
        return Settings(
            rounds,
            recipe,
            sizes.steps,
            sizes.iterations,
            good=2.0,
            online=online,
            seed=self.seed,
            judges=self.judges,
        )

    def through(self, method: str) -> tuple[Model, Approximator]:
        """Model and network of a method that looks through one."""
        model = self.model_of(method)
        if method in ("physics_network", "field_network"):
            folder = self.cycle(model, 1, f"cycle-{method}") / "round-0"
        else:
            number = {"network_1": 0, "network_2": 1}[method]
            folder = self.cycle(model, 2, "cycle-ideal") / f"round-{number}"
        return model, read_approximator(folder / NETWORK)[0]

    def solved(self, method: str, wanted: Volume) -> np.ndarray:
        """A method's patterns for a picture."""
        count = self.sizes.iterations
        if method in ("network_1", "network_2", "physics_network", "field_network"):
            model, network = self.through(method)
            return retrieve(model, wanted, "hardware_in_the_loop", network, count)
        if method in ("physics", "field"):
            return retrieve(self.model_of(method), wanted, "wirtinger", None, count)
        return retrieve(self.ideal, wanted, method, None, count)

    def displayed(self, method: str) -> Likeness:
        """What the camera sees of a method's patterns for the held-out pictures."""
        if method in ("online", "field_online"):
            return self._online(method)
        patterns = {one.name: self.solved(method, one) for one in self.held_out}
        headset = with_iris_beside(self.headset) if method == "wirtinger_no_zero_order" else self.headset
        if headset is self.headset:
            self.patterns[method] = patterns
        return self.look(headset, patterns, f"shown-{method}")

    def look(self, headset: Any, patterns: dict[str, np.ndarray], name: str) -> Likeness:
        """What a camera sees of patterns."""
        return self.look_at(headset, patterns, self.held_out, name)

    def look_at(
        self, headset: Any, patterns: dict[str, np.ndarray], wanted: list[Volume], name: str
    ) -> Likeness:
        """The same for any volumes on common planes."""
        captures = Stage(headset, self.bench, self.ideal).show(
            patterns, wanted[0].planes_mm, self.folder / name
        )
        seen = seen_pairs(captures, with_gains(captures, self.ideal, captures.captures))
        return mean_likeness([display_likeness(seen[one.name], one, self.judges.lpips) for one in wanted])

    def _online(self, method: str) -> Likeness:
        settings = self.settings(ONLINE[method], True)
        network: Approximator | None = None
        if method == "online":
            model, network = self.through("physics_network")
        else:  # the field alone
            model, settings = self.field, replace(settings, steps=0)
        stage = Stage(self.headset, self.bench, self.ideal)
        folder = self.folder / method
        cycle: Cycle = run_cycle(model, self.held_out, settings, folder, stage, network=network)
        self.patterns[method] = cycle.patterns
        return mean_likeness(list(cycle.history[-1].values()))

    def oracle(self) -> Likeness:
        """The best that one who knows the true bench finds, from the best pattern of the methods that were shown."""
        patterns = {}
        if not self.patterns:
            self.patterns["wirtinger"] = {one.name: self.solved("wirtinger", one) for one in self.held_out}
        for one in self.held_out:
            best = []
            for c, channel in enumerate(self.bench.channels):
                wanted = one.irradiance[0, c].astype(np.float64)
                starts = [several[one.name][c] for several in self.patterns.values()]
                judged = [self._true_psnr(gray, wanted, channel.name) for gray in starts]
                start = starts[int(np.argmax(judged))]
                found = self.headset.oracle_pattern(
                    wanted, channel.name, self.bench.distance_mm, ORACLE_ITERATIONS, start
                )
                better = self._true_psnr(found, wanted, channel.name) > max(judged)
                best.append(found if better else start)
            patterns[one.name] = np.stack(best)
        return self.look(self.headset, patterns, "shown-oracle")

    def _true_psnr(self, gray: np.ndarray, wanted: np.ndarray, channel: str) -> float:
        from runtime.solver import quality

        return quality(self.headset.true_irradiance(gray, channel, self.bench.distance_mm), wanted).psnr_db

    def stack(self, method: str) -> Likeness:
        """What the camera sees of a stack of planes, of which the networks have seen the middle one at most."""
        planes = [round(share * self.bench.distance_mm, 6) for share in DEPTHS]
        wanted = [in_depth(one, planes) for one in self.held_out]
        patterns = {one.name: self.solved(method, one) for one in wanted}
        return self.look_at(self.headset, patterns, wanted, f"stack-{method}")

    def table(self, methods: Sequence[str], say: Progress) -> dict[str, Any]:
        """All rows."""
        parts: list[tuple[str, tuple[str, ...], Callable[[str], Likeness]]] = [
            ("prediction", PREDICTION, self.predicted),
            ("display", DISPLAY, self.displayed),
            ("stack", STACK, self.stack),
        ]
        count = 2 + sum(name in known for _, known, _ in parts for name in methods)
        done = 0
        result: dict[str, Any] = {}
        for part, known, of in parts:
            result[part] = []
            for name in (n for n in known if n in methods):
                say(done / count, f"{part}: {name}")
                done += 1
                result[part].append({"method": name, **of(name).as_json()})
        say(done / count, "the camera's noise")
        unseen = self.pairs("held-out", self.held_out, self.ideal)
        result["noise_floor"] = noise_floor(unseen, self.judges.lpips, self.seed).as_json()
        say((done + 1) / count, "asking the oracle")
        result["oracle"] = self.oracle().as_json()
        say(1.0, "done")
        return result
