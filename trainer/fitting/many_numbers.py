"""Derivatives of predictions with respect to effects of many numbers, such as one number a column of the panel.

A table of derivatives has a row a number, and each row costs one prediction: too much for hundreds of numbers. What a
fit needs of the table costs as much for a thousand numbers as for one: its product with a direction is one secant,
and its transpose's product with a residual is one backward pass through the light path. Conjugate gradients find the
Gauss-Newton step from these products alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trainer.device import array_of
from trainer.effects.definition import STAGES
from trainer.fitting.jacobian import STEP, unweighted, weighted
from trainer.fitting.predictor import Predictor
from trainer.model.model import EffectInstance, Model
from trainer.prediction.camera_light import counts, light_on_camera, motion_on_camera
from trainer.prediction.predict import Trace, trace

MANY = 100  # numbers of an effect from which on it is fitted without a table of its derivatives
PASSES = 10  # most products with the table and its transpose, for one step
CLOSE = 0.1  # share of the gradient that a step may leave
SIGNS = 3  # random directions from which the errors of the numbers are estimated

Vector = NDArray[np.float64]


def has_many(present: EffectInstance) -> bool:
    """Whether an effect has so many numbers that a table of its derivatives costs too much."""
    fitted = [present.values[p.name].size for p in present.effect.parameters if not p.per_pixel]
    return sum(fitted) > MANY


class ManySlopes:
    """The derivatives of the weighted predictions with respect to the numbers of some effects, as two products.

    Numbers are counted in units of their parameter's scale, effect after effect, in the order of their parameters.

    Parameters
    ----------
    model : Model
        With the effects, and with gains.
    names : sequence of str
        The effects.
    predictors, points : sequences
        One a batch, and the batch's light under `model`.
    others : list of Tensor [n, pixels]
        A batch's weighted derivatives with respect to everything else that is fitted. Products leave out what these
        could explain as well.
    """

    def __init__(
        self,
        model: Model,
        names: Sequence[str],
        predictors: Sequence[Predictor],
        points: Sequence[Trace],
        others: list[Tensor],
    ) -> None:
        self.model, self.names = model, tuple(names)
        self.predictors, self.points, self.others = predictors, points, others
        self.first = min((model.instance(n).effect.stage for n in names), key=STAGES.index)
        self._parts = [
            (n, p.name, model.instance(n).values[p.name].shape, p.scale)
            for n in names
            for p in model.instance(n).effect.parameters
        ]
        self.scales: Vector = np.concatenate([np.full(int(np.prod(s)), c) for _, _, s, c in self._parts])
        normal = torch.stack([(o @ o.T).double() for o in others]).sum(0)
        self._normal = normal + 1e-9 * torch.diag(torch.diagonal(normal)) + 1e-30 * torch.eye(len(normal))
        with torch.no_grad():
            self._base = [q.counts(model, q.light(model, t)) for q, t in zip(predictors, points, strict=True)]

    def moved(self, change: Vector, held: bool = True) -> Model:
        """The model with its numbers changed, in units of their scales; `held` within their physical range."""
        model, values = self.model, self._by_parameter(change * self.scales)
        for name in self.names:
            present = model.instance(name)
            new = {}
            for p in present.effect.parameters:
                number = present.values[p.name] + values[name, p.name]
                new[p.name] = np.clip(number, p.low, p.high) if held else number
            model = model.having(replace(present, values=new, errors=None))
        return model

    def along(self, direction: Vector) -> list[Tensor]:
        """Change of the weighted predictions [pixels] of each batch in a direction, without the others' part."""
        return self.alone(self.along_with_others(direction))

    def along_with_others(self, direction: Vector) -> list[Tensor]:
        """Change of the weighted predictions [pixels] of each batch in a direction."""
        size = float(np.abs(direction).max())
        if size == 0:
            return [torch.zeros_like(o[0]) for o in self.others]
        step = STEP / size
        there = self.moved(step * direction, held=False)
        rows = []
        with torch.no_grad():
            for q, point, base in zip(self.predictors, self.points, self._base, strict=True):
                rows.append(weighted(q.batch, (q.predict_nearby(there, self.first, point) - base) / step))
        return rows

    def across(self, rows: Sequence[Tensor]) -> Vector:
        """The transpose's product with one row [pixels] a batch."""
        total = np.zeros(self.scales.size)
        for q, point, row in zip(self.predictors, self.points, self.alone(rows), strict=True):
            weights = unweighted(q.batch, row)
            for k in range(weights.shape[0]):
                total += self._backward(q, point, weights, k)
        return total * self.scales

    def alone(self, rows: Sequence[Tensor]) -> list[Tensor]:
        """Rows [pixels] without what the other derivatives explain of them."""
        along = self.explained(rows)
        return [r - along.to(r.dtype) @ o for r, o in zip(rows, self.others, strict=True)]

    def explained(self, rows: Sequence[Tensor]) -> Tensor:
        """Least-squares coefficients [n] of the other derivatives, for rows [pixels]."""
        right = [(o @ r).double() for o, r in zip(self.others, rows, strict=True)]
        return torch.linalg.solve(self._normal, torch.stack(right).sum(0))

    def step(self, residuals: Sequence[Tensor]) -> Vector:
        """Change of the numbers, in units of their scales, that leaves least of the residuals.

        References
        ----------
        Hestenes and Stiefel 1952, on the normal equations.
        """
        residue = self.across(residuals)
        found = np.zeros_like(residue)
        direction, size = residue.copy(), float(residue @ residue)
        least = CLOSE**2 * size
        for _ in range(PASSES):
            if size <= least or size == 0:
                break
            there = self.along(direction)
            curvature = sum(float((t.double() ** 2).sum()) for t in there)
            if curvature <= 0:
                break
            length = size / curvature
            found += length * direction
            residue -= length * self.across(there)
            before, size = size, float(residue @ residue)
            direction = residue + size / before * direction
        return found

    def errors(self, residuals: Sequence[Tensor]) -> Vector:
        """Standard errors of the numbers, in their units, from the residuals' mean square.

        The correlations between the numbers are neglected, and their curvatures estimated from random directions.
        """
        draw = np.random.default_rng(0)
        curvature = np.zeros(self.scales.size)
        for _ in range(SIGNS):
            signs = draw.choice([-1.0, 1.0], self.scales.size)
            curvature += signs * self.across(self.along(signs)) / SIGNS
        pixels = sum(
            float((weighted(q.batch, torch.ones_like(q.batch.mask)) > 0).sum()) for q in self.predictors
        )
        square = sum(float((r.double() ** 2).sum()) for r in residuals) / max(pixels, 1.0)
        positive = np.maximum(curvature, 1e-3 * max(float(curvature.mean()), 1e-300))
        return self.scales * np.sqrt(square / positive)

    def _backward(self, q: Predictor, point: Trace, weights: Tensor, k: int) -> Vector:
        """Derivative of a weighted sum of capture k's counts with respect to the numbers, in their units."""
        tensors: dict[str, dict[str, Tensor]] = {}
        for name, parameter, _, _ in self._parts:
            value = torch.as_tensor(
                self.model.instance(name).values[parameter], dtype=q.scene.dtype
            ).requires_grad_()
            tensors.setdefault(name, {})[parameter] = value
        batch, before = q.batch, point.of(k)
        with torch.enable_grad():
            stages = q.stages(self.model, k, tensors)
            earlier = q.earlier(stages, k)
            image = trace(q.scene, stages, batch.gray[k : k + 1], self.first, before, earlier).image
            gain = q.gain(self.model)[k : k + 1]
            measured = (batch.signal[k : k + 1], batch.mask[k : k + 1])
            motion = motion_on_camera(q.scene, stages, image, measured)
            light = light_on_camera(q.scene, stages, image, motion)
            total = (weights[k : k + 1] * counts(q.scene, stages, light, gain, measured)).sum()
            leaves = [tensors[name][parameter] for name, parameter, _, _ in self._parts]
            slopes = torch.autograd.grad(total, leaves, allow_unused=True)
        return np.concatenate(
            [
                np.zeros(leaf.numel()) if slope is None else array_of(slope.double()).reshape(-1)
                for slope, leaf in zip(slopes, leaves, strict=True)
            ]
        )

    def _by_parameter(self, numbers: Vector) -> dict[tuple[str, str], NDArray[np.float64]]:
        found, begin = {}, 0
        for name, parameter, shape, _ in self._parts:
            count = int(np.prod(shape))
            found[name, parameter] = numbers[begin : begin + count].reshape(shape)
            begin += count
        return found
