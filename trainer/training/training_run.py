"""A training run: one process or many, resumable to the bit.

A step depends on nothing but the seed, its number and the state of networks and optimisers. The order of pictures and
every random draw are functions of the seed and the step's number. So a run that was killed continues from its last
checkpoint to the same result. torchrun or `fabric run` starts several processes; each has its own pictures, and
gradients are averaged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from trainer.device import computing_on, whole_single_precision
from trainer.networks.approximator import NETWORK, Approximator, Architecture, write_approximator
from trainer.networks.discriminator import Discriminator
from trainer.training.checkpoint import read_checkpoint, write_checkpoint
from trainer.training.image_metrics import prediction_metrics
from trainer.training.losses import (
    adversarial_loss,
    content_loss,
    display_encoded,
    matching_loss,
    where_measured,
)
from trainer.training.pretrained_networks import PretrainedNetworks
from trainer.training.processes import launched_fabric
from trainer.training.recipe import Recipe
from trainer.training.training_pairs import Pairs

EVERY = 500  # steps between checkpoints and between metrics of the held-out pictures

StepReport = Callable[[int, float], None]


def refuse_without_loss(recipe: Recipe, pretrained: PretrainedNetworks) -> None:
    """Raise InputError where nothing would be learned, since no loss has a weight."""
    if recipe.l1 == recipe.adversarial == recipe.matching == 0 and pretrained.perceptual is None:
        raise InputError(
            "every loss has weight zero or lacks its weights file: give --l1 or another a weight"
        )


@whole_single_precision()
@computing_on("cpu")  # Fabric takes to a GPU what it trains
def train(
    pairs: Pairs,
    recipe: Recipe,
    steps: int,
    folder: Path | None = None,
    held_out: Pairs | None = None,
    pretrained: PretrainedNetworks | None = None,
    start: Approximator | None = None,
    teacher: Approximator | None = None,
    seed: int = 0,
    every: int = EVERY,
    about: dict[str, Any] | None = None,
    device: str | None = None,
    progress: StepReport | None = None,
) -> Approximator:
    """A network trained on pairs.

    Parameters
    ----------
    pairs : Pairs
        What is learned from.
    recipe : Recipe
        Architecture, losses and optimiser.
    steps : int
        Total steps of the run.
    folder : path or None
        For checkpoints, TensorBoard's curves and the network; a run in it with the same settings is continued.
    held_out : Pairs or None
        Pairs for the curves of metrics.
    pretrained : PretrainedNetworks or None
        The perceptual loss and LPIPS.
    start : Approximator or None
        Weights to begin from; None is the identity.
    teacher : Approximator or None
        A network whose results are learned instead of the measurements (distillation).
    seed : int
        Of weights, order and dropout.
    every : int
        Steps between checkpoints.
    about : dict or None
        Written into the network's file.
    device : str or None
        "cpu" or "cuda"; None: a GPU where torch finds one.
    progress : callable or None
        Called with the step and its content loss.

    Returns
    -------
    Approximator
        On the CPU, in evaluation mode.

    Raises
    ------
    InputError
        Where the folder holds a run with other settings, or no loss is left.
    """
    return _TrainingRun(
        pairs,
        recipe,
        steps,
        folder,
        pretrained or PretrainedNetworks(),
        start,
        teacher,
        seed,
        every,
        about or {},
        device,
    ).run(held_out, progress)


class _TrainingRun:
    """Networks, optimisers, and the current step."""

    def __init__(
        self,
        pairs: Pairs,
        recipe: Recipe,
        steps: int,
        folder: Path | None,
        pretrained: PretrainedNetworks,
        start: Approximator | None,
        teacher: Approximator | None,
        seed: int,
        every: int,
        about: dict[str, Any],
        device: str | None,
    ) -> None:
        refuse_without_loss(recipe, pretrained)
        self.fabric = launched_fabric(folder, device)
        self.pairs, self.recipe, self.steps = pairs, recipe, steps
        self.folder, self.every, self.seed, self.about = folder, every, seed, about
        self.pretrained = pretrained
        if pretrained.perceptual is not None:  # LPIPS stays where pictures are compared, on the CPU
            pretrained.perceptual.to(self.fabric.device)
        self.teacher = None if teacher is None else teacher.to(self.fabric.device)
        torch.manual_seed(seed)
        network = Approximator(Architecture(recipe.network, recipe.filters, pairs.shape, pairs.colours))
        if start is not None:
            network.load_state_dict(start.state_dict())
        self.network, self.network_adam = self._set_up(network)
        self.discriminator: Any = None
        if recipe.adversarial or recipe.matching:
            self.discriminator, self.discriminator_adam = self._set_up(
                Discriminator(
                    recipe.filters,  # as wide as the generator (Chakravarthula et al. 2020)
                    pairs.colours,
                    recipe.receptive,
                    recipe.critics,
                    recipe.conditional,
                )
            )
        self.step = 0

    def _set_up(self, module: torch.nn.Module) -> tuple[Any, Any]:
        adam = torch.optim.Adam(module.parameters(), lr=self.recipe.rate, betas=self.recipe.betas)
        return self.fabric.setup(module, adam)

    def run(self, held_out: Pairs | None, progress: StepReport | None) -> Approximator:
        self._resume()
        while self.step < self.steps:
            losses = self._step()
            self.step += 1
            if progress:
                progress(self.step, losses["content"])
            if self.folder and (self.step % self.every == 0 or self.step == self.steps):
                self._log(losses, held_out)
                self._save()
        network: Approximator = self._bare(self.network).cpu().eval()
        if self.folder and self.fabric.is_global_zero:
            write_approximator(self.folder / NETWORK, network, {**self.about, "steps": self.step})
        return network

    def _step(self) -> dict[str, float]:
        """One update of the discriminator, if there is one, and one of the network, on one picture for each process."""
        torch.manual_seed(_draw(self.seed, 1, self.step))  # dropout
        given, target, weight = self._picture()
        self.network.train()
        white, recipe = self.pairs.white, self.recipe
        ours = where_measured(display_encoded(self.network(given), white), target, weight)
        condition = display_encoded(given, white)
        losses: dict[str, Tensor] = {}
        if self.discriminator is not None:
            self._bare(self.discriminator).requires_grad_(True)
            both = self.discriminator(torch.cat((target, ours.detach())), torch.cat((condition, condition)))
            real, fake = ([[f[half] for f in scale] for scale in both] for half in (slice(0, 1), slice(1, 2)))
            loss = (self._adversarial(real, True) + self._adversarial(fake, False)) / 2
            self.discriminator_adam.zero_grad()
            self.fabric.backward(loss)
            self.discriminator_adam.step()
            losses["critic"] = loss
        content = content_loss(recipe, ours, target, self.pretrained.perceptual)
        losses["content"], total = content, content
        if self.discriminator is not None:
            # The bare module: the distributed wrapper would wait for gradients of its weights.
            discriminator = self._bare(self.discriminator).requires_grad_(False)
            with self.fabric.autocast():
                judged = discriminator(ours, condition)
                losses["adversarial"] = self._adversarial(judged, True)
                total = total + recipe.adversarial * losses["adversarial"]
                if recipe.matching:
                    losses["matching"] = matching_loss(judged, discriminator(target, condition))
                    total = total + recipe.matching * losses["matching"]
        self.network_adam.zero_grad()
        self.fabric.backward(total)
        self.network_adam.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _adversarial(self, judged: Any, real: bool) -> Tensor:
        return adversarial_loss(judged, real, self.recipe.cross_entropy)

    def _picture(self) -> tuple[Tensor, Tensor, Tensor]:
        """Input irradiance, target picture and weight of this step's picture, [1, C, H, W]."""
        count = len(self.pairs)
        turn = self.step * self.fabric.world_size + self.fabric.global_rank
        order = np.random.default_rng([self.seed, turn // count]).permutation(count)
        k = int(order[turn % count])
        parts = (self.pairs.predicted, self.pairs.measured, self.pairs.weight)
        given, measured, weight = (p[k : k + 1].to(self.fabric.device) for p in parts)
        if self.teacher is not None:
            with torch.no_grad():
                measured = self.teacher(given)
        return given, display_encoded(measured, self.pairs.white), weight

    def _log(self, losses: dict[str, float], held_out: Pairs | None) -> None:
        """Log losses and held-out metrics for TensorBoard."""
        if not self.fabric.is_global_zero:
            return
        values = {f"loss/{name}": value for name, value in losses.items()}
        if held_out is not None:
            network = self._bare(self.network).eval()
            metrics = prediction_metrics(
                held_out, lambda x: network(x.to(self.fabric.device)), self.pretrained.lpips
            )
            values |= {
                f"heldout/{name}": value for name, value in metrics.as_json().items() if value is not None
            }
        self.fabric.log_dict(values, step=self.step)

    def _settings(self) -> dict[str, Any]:
        """Settings that a continued run must share with this one."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "shape": list(self.pairs.shape),
            "perceptual": self.pretrained.perceptual is not None,
            "teacher": self.teacher is not None,
            **self.about,
        }

    def _save(self) -> None:
        if self.folder is None or not self.fabric.is_global_zero:
            return
        state: dict[str, Any] = {"step": self.step}
        for name, module, adam in self._modules():
            state[name] = {"weights": self._bare(module).state_dict(), "adam": adam.state_dict()}
        write_checkpoint(self.folder, self._settings(), state)

    def _resume(self) -> None:
        if self.folder is None:
            return
        state = read_checkpoint(self.folder, self._settings(), self.fabric.device)
        if state is None:
            return
        for name, module, adam in self._modules():
            self._bare(module).load_state_dict(state[name]["weights"])
            adam.load_state_dict(state[name]["adam"])
        self.step = int(state["step"])

    def _modules(self) -> list[tuple[str, Any, Any]]:
        parts = [("network", self.network, self.network_adam)]
        return (
            parts
            if self.discriminator is None
            else [*parts, ("critic", self.discriminator, self.discriminator_adam)]
        )

    @staticmethod
    def _bare(module: Any) -> Any:
        """The module without its distributed wrapper."""
        return module.module if hasattr(module, "module") else module


def _draw(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1)[0])
