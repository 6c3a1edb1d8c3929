"""Every method on one virtual bench: what it predicts, and what the camera sees of its patterns.

All numbers are means over two photographs that no method has learned from.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError, nearest
from runtime.program.progress import Progress, no_progress
from trainer.cycle.evaluation_bench import EvaluationBench, EvaluationSizes
from trainer.cycle.hardware_in_the_loop import run_cycle
from trainer.cycle.phase_retrieval import retrieve
from trainer.cycle.show_on_bench import (
    BenchDisplay,
    display_metrics,
    headset_beside_zero_order,
    pairs_by_pattern,
)
from trainer.cycle.target_pictures import TargetVolume, in_depth
from trainer.diagnosis.comparison import with_gains
from trainer.model.model import Model
from trainer.networks.approximator import Approximator
from trainer.training.image_metrics import ImageMetrics, mean_metrics, noise_floor, prediction_metrics
from trainer.training.pretrained_networks import PretrainedNetworks
from trainer.training.recipe import RECIPES
from trainer.training.training_run import train

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
ORACLE_ITERATIONS = 300  # from the best pattern of the methods on; more gain little


def run_evaluation(
    spec: str,
    methods: Sequence[str] = METHODS,
    sizes: EvaluationSizes | None = None,
    pretrained: PretrainedNetworks | None = None,
    model: Model | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Metrics of methods on one virtual bench.

    Parameters
    ----------
    spec : str
        Name or file of a virtual bench.
    methods : sequence of str
        Of `METHODS`, those to be compared.
    sizes : EvaluationSizes or None
        How much is spent.
    pretrained : PretrainedNetworks or None
        The perceptual loss and LPIPS.
    model : Model or None
        Of the bench's physics; None: `explain` finds one.
    seed : int
        Of the bench and of each training.
    workers : int or None
        Processes for `explain`; None: one for each core.
    progress : callable or None
        Called with the share done and what is being done.

    Returns
    -------
    dict
        Keys `prediction`, `display`, `stack`, `noise_floor` and `oracle` of `evaluate --json`.

    Raises
    ------
    InputError
        For an unknown method or bench, and for a model of another bench.
    """
    for name in methods:
        if name not in METHODS:
            raise InputError(f"there is no method '{name}': {nearest(name, METHODS)}")
    with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
        bench = EvaluationBench(
            spec,
            sizes or EvaluationSizes(),
            pretrained or PretrainedNetworks(),
            model,
            seed,
            workers,
            Path(folder),
        )
        return _MethodComparison(bench).table(methods, progress or no_progress)


@dataclass
class _MethodComparison:
    """The rows of the table; `patterns` are those of each method shown so far, by picture."""

    on: EvaluationBench
    patterns: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def predicted(self, method: str) -> ImageMetrics:
        """Metrics of a method's prediction against the captures of the held-out pictures."""
        model = self.on.model_of(method)
        held_out = self.on.pairs("held-out", self.on.held_out, model)
        if method in ("ideal", "physics", "field"):
            return prediction_metrics(held_out, None, self.on.pretrained.lpips)
        fitted = self.on.pairs("learned", self.on.learned, model)
        recipe = self.on.recipe(method.removeprefix("physics_").removeprefix("field_"))
        network = train(fitted, recipe, self.on.sizes.steps, pretrained=self.on.pretrained, seed=self.on.seed)
        return prediction_metrics(held_out, network, self.on.pretrained.lpips)

    def solved(self, method: str, wanted: TargetVolume) -> np.ndarray:
        """A method's patterns for a picture."""
        count = self.on.sizes.iterations
        if method in ("network_1", "network_2", "physics_network", "field_network"):
            model, network = self.on.through_network(method)
            return retrieve(model, wanted, "hardware_in_the_loop", network, count)
        if method in ("physics", "field"):
            return retrieve(self.on.model_of(method), wanted, "wirtinger", None, count)
        return retrieve(self.on.ideal, wanted, method, None, count)

    def displayed(self, method: str) -> ImageMetrics:
        """Metrics of the camera's pictures of a method's patterns for the held-out pictures."""
        if method in ("online", "field_online"):
            return self._online(method)
        patterns = {one.name: self.solved(method, one) for one in self.on.held_out}
        headset = (
            headset_beside_zero_order(self.on.headset)
            if method == "wirtinger_no_zero_order"
            else self.on.headset
        )
        if headset is self.on.headset:
            self.patterns[method] = patterns
        return self.shown(headset, patterns, self.on.held_out, f"shown-{method}")

    def shown(
        self, headset: Any, patterns: dict[str, np.ndarray], wanted: list[TargetVolume], name: str
    ) -> ImageMetrics:
        """Metrics of the camera's pictures of patterns, for targets on the same planes."""
        display = BenchDisplay(headset, self.on.bench, self.on.ideal)
        captures = display.show(patterns, wanted[0].planes_mm, self.on.folder / name)
        pairs = pairs_by_pattern(captures, with_gains(captures, self.on.ideal, captures.captures))
        return mean_metrics(
            [display_metrics(pairs[one.name], one, self.on.pretrained.lpips) for one in wanted]
        )

    def _online(self, method: str) -> ImageMetrics:
        settings = self.on.settings(ONLINE[method], True)
        network: Approximator | None = None
        if method == "online":
            model, network = self.on.through_network("physics_network")
        else:  # the field alone
            model, settings = self.on.field, replace(settings, steps=0)
        folder = self.on.folder / method
        cycle = run_cycle(model, self.on.held_out, settings, folder, self.on.display, network=network)
        self.patterns[method] = cycle.patterns
        return mean_metrics(list(cycle.history[-1].values()))

    def oracle(self) -> ImageMetrics:
        """Metrics of patterns computed with the true bench known, from the best of the methods' patterns on."""
        patterns = {}
        if not self.patterns:
            self.patterns["wirtinger"] = {one.name: self.solved("wirtinger", one) for one in self.on.held_out}
        for one in self.on.held_out:
            best = []
            for c, channel in enumerate(self.on.bench.channels):
                wanted = one.irradiance[0, c].astype(np.float64)
                starts = [several[one.name][c] for several in self.patterns.values()]
                psnr = [self._true_psnr(gray, wanted, channel.name) for gray in starts]
                start = starts[int(np.argmax(psnr))]
                improved = self.on.headset.oracle_pattern(
                    wanted, channel.name, self.on.bench.distance_mm, ORACLE_ITERATIONS, start
                )
                better = self._true_psnr(improved, wanted, channel.name) > max(psnr)
                best.append(improved if better else start)
            patterns[one.name] = np.stack(best)
        return self.shown(self.on.headset, patterns, self.on.held_out, "shown-oracle")

    def _true_psnr(self, gray: np.ndarray, wanted: np.ndarray, channel: str) -> float:
        from runtime.solver import quality

        return quality(
            self.on.headset.true_irradiance(gray, channel, self.on.bench.distance_mm), wanted
        ).psnr_db

    def stack(self, method: str) -> ImageMetrics:
        """Metrics of a stack of planes; the networks have learned from the middle one at most."""
        planes = [round(share * self.on.bench.distance_mm, 6) for share in DEPTHS]
        wanted = [in_depth(one, planes) for one in self.on.held_out]
        patterns = {one.name: self.solved(method, one) for one in wanted}
        return self.shown(self.on.headset, patterns, wanted, f"stack-{method}")

    def table(self, methods: Sequence[str], say: Progress) -> dict[str, Any]:
        """All rows, as `run_evaluation` returns them."""
        parts: list[tuple[str, tuple[str, ...], Callable[[str], ImageMetrics]]] = [
            ("prediction", PREDICTION, self.predicted),
            ("display", DISPLAY, self.displayed),
            ("stack", STACK, self.stack),
        ]
        count = 2 + sum(name in known for _, known, _ in parts for name in methods)
        done = 0
        result: dict[str, Any] = {}
        for part, known, metrics_of in parts:
            result[part] = []
            for name in (n for n in known if n in methods):
                say(done / count, f"{part}: {name}")
                done += 1
                result[part].append({"method": name, **metrics_of(name).as_json()})
        say(done / count, "the camera's noise")
        held_out = self.on.pairs("held-out", self.on.held_out, self.on.ideal)
        result["noise_floor"] = noise_floor(held_out, self.on.pretrained.lpips, self.on.seed).as_json()
        say((done + 1) / count, "asking the oracle")
        result["oracle"] = self.oracle().as_json()
        say(1.0, "done")
        return result
