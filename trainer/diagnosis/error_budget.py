"""Where the error of a prediction goes: named physics, what was learned, the camera's noise, and what is left.

All are shares of the measured signal's variance on held-out captures, and add up to the ideal model's mean squared
error: what the named effects remove from it, what was learned at stages and the network remove after them
(all of it is counted as `network`), the camera's noise, and the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.excess import PredictionErrors, joined
from runtime.program.progress import Progress
from trainer.captures.batches import Batch, load_batch
from trainer.captures.capture_set import CaptureSet
from trainer.captures.held_out import split
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.networks.approximator import Approximator
from trainer.training.camera_to_panel import onto_camera
from trainer.training.training_pairs import display_irradiance, expected_counts, stacked


@dataclass(frozen=True)
class ErrorBudget:
    """Shares of the signal's variance.

    Attributes
    ----------
    named_physics, network : float
        What effects, and what is learned without a name, remove; negative where they make it worse.
    noise : float
        The camera's noise.
    unexplained : float
        What is left.
    """

    named_physics: float
    network: float
    noise: float
    unexplained: float

    @property
    def ideal(self) -> float:
        """The ideal model's mean squared error, of which the others are divided."""
        return self.named_physics + self.network + self.noise + self.unexplained


def error_budget(
    captures: CaptureSet, model: Model, network: Approximator | None = None, progress: Progress | None = None
) -> ErrorBudget:
    """The budget on the held-out captures of a set.

    Parameters
    ----------
    network : Approximator, optional
        Trained on what the model leaves.

    Raises
    ------
    InputError
        Where the network is of another panel or other colours, and where the captures have no contrast.
    """
    divided = split(captures)
    if network is not None:
        _check(network, captures)
    ideal = with_gains(captures, Model(captures.bench, method=model.method), divided.fitted)
    model = with_gains(captures, replace(model, gain={}), divided.fitted)
    named = model
    if model.panel_field is not None or model.learned:
        named = with_gains(captures, replace(model, gain={}, panel_field=None, learned={}), divided.fitted)
    stacks = stacked(captures, divided.held_out)
    rows: list[tuple[PredictionErrors, PredictionErrors, PredictionErrors]] = []
    with torch.no_grad():
        for k, stack in enumerate(stacks):
            batches = [None if c is None else load_batch(captures, [c]) for c in stack]
            changes = network_changes(model, network, batches)
            for batch, change in zip(batches, changes, strict=True):
                if batch is None or not bool(batch.mask.any()):
                    continue
                expected, with_network = with_change(model, batch, change)
                physical = expected if named is model else Predictor(named, batch).predict(named)
                bare = Predictor(ideal, batch).predict(ideal)
                rows.append((batch.errors(bare), batch.errors(physical), batch.errors(with_network)))
            if progress:
                progress((k + 1) / len(stacks))
    if not rows or not float(sum(row[0].variance.sum() for row in rows)) > 0:
        raise InputError(f"the held-out captures of {captures.folder} have no contrast to compare with")
    without, known, learned = (joined([row[k] for row in rows]) for k in range(3))
    return ErrorBudget(
        without.excess - known.excess,
        known.excess - learned.excess,
        learned.noise_nrmse**2,
        learned.excess,
    )


def with_change(model: Model, batch: Batch, change: Tensor | None) -> tuple[Tensor, Tensor]:
    """Counts that a model expects of a capture (a batch of one), without and with a change of irradiance [H, W]."""
    scene, stages, expected, sensitivity = expected_counts(model, batch)
    if change is None:
        return expected, expected
    return expected, expected + sensitivity * onto_camera(scene, stages, change)


def network_changes(
    model: Model, network: Approximator | None, batches: list[Batch | None]
) -> list[Tensor | None]:
    """What the network adds to the irradiance of each colour of a picture, [H, W]; None without a network."""
    if network is None:
        return [None] * len(batches)
    shape = model.bench.panel.shape
    planes = [torch.zeros(shape) if b is None else display_irradiance(model, b) for b in batches]
    shown = torch.stack(planes)
    return list((network(shown[None]) - shown)[0])


def _check(network: Approximator, captures: CaptureSet) -> None:
    one, bench = network.architecture, captures.bench
    if one.shape != bench.panel.shape or one.planes != len(bench.channels):
        raise InputError(
            f"the network was trained for {one.planes} colours of {one.shape[0]} x {one.shape[1]} pixels and "
            f"{captures.folder} has {len(bench.channels)} of {bench.panel.height} x {bench.panel.width}: train one "
            "for it"
        )
