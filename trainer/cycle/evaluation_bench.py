"""A virtual bench on which methods are compared: its pictures, captures and models, and the networks learned on it.

Networks learn from captures of photographs that are shown with patterns for the ideal model. The physical model is
found from the usual patterns, and the field at the panel (beyond the physical model) from the networks' captures. Two
other photographs are held out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset, open_headset
from trainer.captures.acquire import acquire_captures
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.cycle.cycle_settings import CycleSettings
from trainer.cycle.hardware_in_the_loop import run_cycle
from trainer.cycle.phase_retrieval import retrieve
from trainer.cycle.show_on_bench import BenchDisplay
from trainer.cycle.target_pictures import HELD_OUT, LEARNED, TargetVolume, photographs
from trainer.diagnosis.comparison import with_gains
from trainer.fitting.learned_field import with_learned_field
from trainer.model.model import Model
from trainer.networks.approximator import Approximator, read_approximator
from trainer.training.pretrained_networks import PretrainedNetworks
from trainer.training.recipe import RECIPES, STEPS, Recipe
from trainer.training.training_pairs import Pairs, pairs_of
from trainer.training.training_run import NETWORK


@dataclass(frozen=True)
class EvaluationSizes:
    """How much an evaluation spends.

    Attributes
    ----------
    filters : int or None
        Channels of the networks' first layers; None: as in their papers.
    steps : int
        Of each training.
    iterations : int
        Of each phase retrieval.
    """

    filters: int | None = 8
    steps: int = 400
    iterations: int = 100

    @staticmethod
    def full() -> EvaluationSizes:
        """The sizes of Chakravarthula et al. 2020."""
        return EvaluationSizes(None, STEPS, 200)


@dataclass
class EvaluationBench:
    """One virtual bench; each part is made when it is first needed.

    Attributes
    ----------
    spec : str
        Name or file of the bench.
    sizes : EvaluationSizes
        How much is spent.
    pretrained : PretrainedNetworks
        The perceptual loss and LPIPS.
    given : Model or None
        The physical model; None: `explain` finds one.
    seed : int
        Of the bench and of each training.
    workers : int or None
        Processes for `explain`; None: one for each core.
    folder : path
        For captures and networks.
    """

    spec: str
    sizes: EvaluationSizes
    pretrained: PretrainedNetworks
    given: Model | None
    seed: int
    workers: int | None
    folder: Path

    @cached_property
    def headset(self) -> VirtualHeadset:
        """A virtual one: only it knows the truth that the oracle needs."""
        return open_headset(self.spec, self.seed)

    @cached_property
    def bench(self) -> Bench:
        return nominal_bench(self.headset)

    @cached_property
    def ideal(self) -> Model:
        return Model(self.bench)

    @cached_property
    def display(self) -> BenchDisplay:
        return BenchDisplay(self.headset, self.bench, self.ideal)

    @cached_property
    def learned(self) -> list[TargetVolume]:
        """Photographs that networks and the field learn from."""
        return photographs(LEARNED, self.bench, mirrored=True)

    @cached_property
    def held_out(self) -> list[TargetVolume]:
        return photographs(HELD_OUT, self.bench)

    @cached_property
    def physics(self) -> Model:
        """The model of the named effects."""
        if self.given is not None:
            if (self.given.bench.panel, self.given.bench.channels) != (self.bench.panel, self.bench.channels):
                raise InputError(f"--model is of another bench than {self.spec}: its panel or colours differ")
            return self.given
        from trainer.diagnosis.explanation import explain
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
        """The model that a method predicts with."""
        if method.startswith("field"):
            return self.field
        return self.physics if method.startswith("physics") or method == "online" else self.ideal

    def captured(self, name: str, pictures: list[TargetVolume] | None) -> CaptureSet:
        """Captures of pictures with patterns for the ideal model; None: of the usual patterns."""
        folder = self.folder / name
        if not folder.exists():
            if pictures is None:
                acquire_captures(self.headset, self.bench, folder, seed=self.seed)
            else:
                patterns = {
                    v.name: retrieve(self.ideal, v, "wirtinger", None, self.sizes.iterations)
                    for v in pictures
                }
                self.display.show(patterns, (self.bench.distance_mm,), folder)
        return read_captures(folder)

    def pairs(self, name: str, pictures: list[TargetVolume], model: Model) -> Pairs:
        """Pairs of captured pictures under a model, without the repeat."""
        captures = self.captured(name, pictures)
        rows = captures.captures[1:]
        fitted = with_gains(captures, replace(model, gain={}), rows)
        return pairs_of(captures, rows, fitted)

    def recipe(self, name: str) -> Recipe:
        """A recipe with the evaluation's number of filters."""
        recipe = RECIPES[name]
        return recipe if self.sizes.filters is None else replace(recipe, filters=self.sizes.filters)

    def settings(self, rounds: int, online: bool = False) -> CycleSettings:
        """A cycle in which no picture is ever good enough, so that all methods run all rounds."""
        recipe, sizes = self.recipe("compact"), self.sizes
        return CycleSettings(
            rounds,
            recipe,
            sizes.steps,
            sizes.iterations,
            good=2.0,
            online=online,
            seed=self.seed,
            pretrained=self.pretrained,
        )

    def through_network(self, method: str) -> tuple[Model, Approximator]:
        """Model and network of a method that has both, from a cycle over the learned pictures."""
        model = self.model_of(method)
        if method in ("physics_network", "field_network"):
            folder = self._cycle(model, 1, f"cycle-{method}") / "round-0"
        else:
            number = {"network_1": 0, "network_2": 1}[method]
            folder = self._cycle(model, 2, "cycle-ideal") / f"round-{number}"
        return model, read_approximator(folder / NETWORK)[0]

    def _cycle(self, model: Model, rounds: int, name: str) -> Path:
        """Folder of a cycle over the learned pictures."""
        folder = self.folder / name
        if not folder.exists():
            run_cycle(model, self.learned, self.settings(rounds), folder, self.display)
        return folder
