"""Training: one process or many, resumable to the bit.

Everything that a step depends on is the seed, its number and the state of networks and optimisers; the order of
pictures and every random draw are functions of the first two. So a run that was killed goes on from its last
checkpoint as if nothing had happened. Many processes are started by torchrun or `fabric run`; each sees its own
pictures, and gradients are averaged.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_file
from trainer.networks.approximator import Approximator, Architecture, write_approximator
from trainer.networks.perceptual import Lpips, Perceptual
from trainer.training.likeness import evaluate
from trainer.training.losses import Critic, content_loss, matching_loss, picture, where_seen
from trainer.training.pairs import Pairs
from trainer.training.recipe import Recipe

CHECKPOINT, NETWORK = "checkpoint.pt", "network.safetensors"
EVERY = 500  # steps between checkpoints and looks at the held-out pictures

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class Judges:
    """Networks of others, from the user's weight files: the perceptual loss and the LPIPS of the curves."""

    perceptual: Perceptual | None = None
    lpips: Lpips | None = None


def train(
    pairs: Pairs,
    recipe: Recipe,
    steps: int,
    folder: Path | None = None,
    held_out: Pairs | None = None,
    judges: Judges | None = None,
    start: Approximator | None = None,
    teacher: Approximator | None = None,
    seed: int = 0,
    every: int = EVERY,
    about: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Approximator:
    """A network trained on pairs, on the CPU, in evaluation mode.

    folder : for checkpoints, TensorBoard's curves and the network; a run that is there with the same settings goes on
    held_out : pairs that the curves are measured on. start : weights to begin from; none: the identity
    teacher : a network whose results stand in for the measurements (distillation). about : goes into the file
    progress : called with the step and its content loss
    Raises InputError where the folder holds a run with other settings, or nothing is left to learn from.
    """
    return _Run(
        pairs, recipe, steps, folder, judges or Judges(), start, teacher, seed, every, about or {}
    ).go(held_out, progress)


def processes() -> tuple[int, int]:
    """(processes on this machine, machines), as torchrun says; one and one without it."""
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return local, max(1, int(os.environ.get("WORLD_SIZE", "1")) // local)


class _Run:
    """One training: networks, optimisers, and the step that it has come to."""

    def __init__(
        self,
        pairs: Pairs,
        recipe: Recipe,
        steps: int,
        folder: Path | None,
        judges: Judges,
        start: Approximator | None,
        teacher: Approximator | None,
        seed: int,
        every: int,
        about: dict[str, Any],
    ) -> None:
        from lightning_fabric import Fabric
        from lightning_fabric.loggers import TensorBoardLogger

        if recipe.l1 == recipe.adversarial == recipe.matching == 0 and judges.perceptual is None:
            raise InputError(
                "every loss has weight zero or lacks its weights file: give --l1 or another a weight"
            )
        local, machines = processes()
        gpu = torch.cuda.is_available()
        logger = TensorBoardLogger(folder, name="", version="curves") if folder else None
        self.fabric = Fabric(
            accelerator="cuda" if gpu else "cpu",
            devices=local,
            num_nodes=machines,
            precision="bf16-mixed" if gpu else "32-true",
            loggers=logger,
        )
        if local * machines > 1:
            self.fabric.launch()
        self.pairs, self.recipe, self.steps = pairs, recipe, steps
        self.folder, self.every, self.seed, self.about = folder, every, seed, about
        self.judges = judges
        if judges.perceptual is not None:  # LPIPS stays where pictures are compared, on the CPU
            judges.perceptual.to(self.fabric.device)
        self.teacher = None if teacher is None else teacher.to(self.fabric.device)
        torch.manual_seed(seed)
        network = Approximator(Architecture(recipe.network, recipe.filters, pairs.shape, pairs.colours))
        if start is not None:
            network.load_state_dict(start.state_dict())
        self.network, self.network_steps = self._set_up(network)
        self.critic: Any = None
        if recipe.adversarial or recipe.matching:
            self.critic, self.critic_steps = self._set_up(
                Critic(recipe, recipe.filters, pairs.colours)  # as wide as the generator, as published
            )
        self.step = 0

    def _set_up(self, module: torch.nn.Module) -> tuple[Any, Any]:
        adam = torch.optim.Adam(module.parameters(), lr=self.recipe.rate, betas=self.recipe.betas)
        return self.fabric.setup(module, adam)

    def go(self, held_out: Pairs | None, progress: Progress | None) -> Approximator:
        self._resume()
        while self.step < self.steps:
            losses = self._step()
            self.step += 1
            if progress:
                progress(self.step, losses["content"])
            if self.folder and (self.step % self.every == 0 or self.step == self.steps):
                self._look(losses, held_out)
                self._save()
        network: Approximator = self._bare(self.network).cpu().eval()
        if self.folder and self.fabric.is_global_zero:
            write_approximator(self.folder / NETWORK, network, {**self.about, "steps": self.step})
        return network

    def _step(self) -> dict[str, float]:
        """One update of the critic, if there is one, and one of the network, on one picture a process."""
        torch.manual_seed(_draw(self.seed, 1, self.step))  # dropout
        given, target, weight = self._picture()
        self.network.train()
        white, recipe = self.pairs.white, self.recipe
        ours = where_seen(picture(self.network(given), white), target, weight)
        condition = picture(given, white)
        losses: dict[str, Tensor] = {}
        if self.critic is not None:
            self._bare(self.critic).requires_grad_(True)
            both = self.critic(torch.cat((target, ours.detach())), torch.cat((condition, condition)))
            real, fake = ([[f[half] for f in scale] for scale in both] for half in (slice(0, 1), slice(1, 2)))
            loss = (self._judge(real, True) + self._judge(fake, False)) / 2
            self.critic_steps.zero_grad()
            self.fabric.backward(loss)
            self.critic_steps.step()
            losses["critic"] = loss
        content = content_loss(recipe, ours, target, self.judges.perceptual)
        losses["content"], total = content, content
        if self.critic is not None:
            # The bare module: what distributes it would wait for gradients of its weights.
            critic = self._bare(self.critic).requires_grad_(False)
            with self.fabric.autocast():
                judged = critic(ours, condition)
                losses["adversarial"] = self._judge(judged, True)
                total = total + recipe.adversarial * losses["adversarial"]
                if recipe.matching:
                    losses["matching"] = matching_loss(judged, critic(target, condition))
                    total = total + recipe.matching * losses["matching"]
        self.network_steps.zero_grad()
        self.fabric.backward(total)
        self.network_steps.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _judge(self, judged: Any, real: bool) -> Tensor:
        return self._bare(self.critic).loss(judged, real)

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
        return given, picture(measured, self.pairs.white), weight

    def _look(self, losses: dict[str, float], held_out: Pairs | None) -> None:
        """Curves for TensorBoard."""
        if not self.fabric.is_global_zero:
            return
        values = {f"loss/{name}": value for name, value in losses.items()}
        if held_out is not None:
            network = self._bare(self.network).eval()
            found = evaluate(held_out, lambda x: network(x.to(self.fabric.device)), self.judges.lpips)
            values |= {
                f"heldout/{name}": value for name, value in found.as_json().items() if value is not None
            }
        self.fabric.log_dict(values, step=self.step)

    def _settings(self) -> dict[str, Any]:
        """What a run that is gone on with must have in common with this one."""
        return {
            "recipe": asdict(self.recipe),
            "seed": self.seed,
            "shape": list(self.pairs.shape),
            "perceptual": self.judges.perceptual is not None,
            "teacher": self.teacher is not None,
            **self.about,
        }

    def _save(self) -> None:
        if self.folder is None or not self.fabric.is_global_zero:
            return
        state = {"settings": self._settings(), "step": self.step}
        for name, module, adam in self._parts():
            state[name] = {"weights": self._bare(module).state_dict(), "adam": adam.state_dict()}
        with whole_file(self.folder / CHECKPOINT) as file:
            torch.save(state, file)

    def _resume(self) -> None:
        if self.folder is None or not (self.folder / CHECKPOINT).is_file():
            return
        path = self.folder / CHECKPOINT
        try:
            state = torch.load(path, map_location=self.fabric.device, weights_only=True)
            before = state["settings"]
        except Exception as error:
            reason = str(error).splitlines()[0][:80] if str(error) else type(error).__name__
            raise InputError(f"{path} cannot be read ({reason}): remove it or give another --out") from None
        ours = self._settings()
        if _plain(before) != _plain(ours):
            wrong = next(k for k in {**before, **ours} if _plain(before.get(k)) != _plain(ours.get(k)))
            raise InputError(
                f"{self.folder} holds a training with another {wrong}: give another --out, or remove the folder"
            )
        for name, module, adam in self._parts():
            self._bare(module).load_state_dict(state[name]["weights"])
            adam.load_state_dict(state[name]["adam"])
        self.step = int(state["step"])

    def _parts(self) -> list[tuple[str, Any, Any]]:
        parts = [("network", self.network, self.network_steps)]
        return parts if self.critic is None else [*parts, ("critic", self.critic, self.critic_steps)]

    @staticmethod
    def _bare(module: Any) -> Any:
        """The module without what distributes it."""
        return module.module if hasattr(module, "module") else module


def _draw(*entropy: int) -> int:
    return int(np.random.SeedSequence(entropy).generate_state(1)[0])


def _plain(value: Any) -> Any:
    """With tuples as lists, as they are read back."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value
