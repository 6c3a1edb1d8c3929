"""Learning of an approximator's adapters from captures, by Adam in NumPy, judged on held-out captures.

When the adapters predict the latest held-out captures worse than before, they go back to the values that predicted
best.

References
----------
Kingma and Ba 2015.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from runtime.networks.onnx_approximator import Approximator

KEPT = 3  # latest held-out captures that count: the pattern changes, and older captures no longer describe it
LEARNING = 4  # steps of the adapters for each capture
# Of Adam; with short memories, since the captures to learn from change.
RATE, FORGET, FORGET_SQUARES = 1e-3, 0.8, 0.95
PATIENCE = 2  # held-out captures in succession that the adapters may predict worse than the best adapters do
RISE = 1e-3  # relative; a smaller rise of the error does not count

Weights = Mapping[str, np.ndarray]


class AdapterLearning:
    """The state of the adapters while they learn.

    In all methods, `simulated` is the irradiance [C, H, W] of the model without D, and `captured` is a picture of the
    same pattern, scaled to D of `simulated`.

    Parameters
    ----------
    approximator : Approximator
        The network D with adapters; its adapters are changed in place.

    Attributes
    ----------
    heldout_error : float
        Error of D on the latest held-out captures; infinite before the first.
    """

    def __init__(self, approximator: Approximator) -> None:
        self._approximator = approximator
        self._exported = _copied(approximator.adapters)
        self._held: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=KEPT)
        self.reset()

    def reset(self) -> None:
        """Go back to the exported adapters, as without any capture."""
        self._put(self._exported)
        self._best = _copied(self._exported)
        self._adam = _Adam(self._exported)
        self._held.clear()
        self.heldout_error = math.inf
        self._rises = 0

    def evaluate(self, simulated: np.ndarray, target: np.ndarray) -> float:
        """Run D and its gradients; returns the sum of squared differences of amplitude to a target."""
        self._approximator.irradiance[...] = simulated
        self._approximator.target[...] = target
        return self._approximator.look()

    def error(self, simulated: np.ndarray, captured: np.ndarray) -> float:
        """Mean squared difference of amplitude between D of a simulated picture and the captured one."""
        return self.evaluate(simulated, captured) / captured.size

    def learn(self, simulated: np.ndarray, captured: np.ndarray) -> None:
        """Change the adapters so that D of the simulated picture is more like the captured one."""
        for _ in range(LEARNING):
            self.evaluate(simulated, captured)
            self._adam.step(self._approximator.adapters, self._approximator.adapter_gradients())

    def judge(self, simulated: np.ndarray, captured: np.ndarray) -> bool:
        """Add a held-out capture and judge the adapters; returns whether the error has risen too often.

        Keeps the best adapters, and goes back to them where the error has risen too often.
        """
        self._held.append((simulated, captured))
        now = self._held_error()
        current = _copied(self._approximator.adapters)
        self._put(self._best)
        best = self._held_error()
        if now <= best:
            self._best = current
        self._rises = self._rises + 1 if now > best * (1 + RISE) else 0
        if self._rises >= PATIENCE:
            self.heldout_error = best
            return True
        self._put(current)
        self.heldout_error = now
        return False

    @property
    def drift(self) -> float:
        """Change of the adapters since the export, over their size."""
        adapters = self._approximator.adapters
        moved = sum(float(((adapters[n] - w) ** 2).sum()) for n, w in self._exported.items())
        size = sum(float((w**2).sum()) for w in self._exported.values())
        return math.sqrt(moved / size) if size > 0 else math.sqrt(moved)

    def _held_error(self) -> float:
        return float(np.mean([self.error(simulated, captured) for simulated, captured in self._held]))

    def _put(self, weights: Weights) -> None:
        for name, weight in weights.items():
            self._approximator.adapters[name][...] = weight


class _Adam:
    """Adam's moments of the gradients, and its steps (Kingma and Ba 2015)."""

    def __init__(self, weights: Weights) -> None:
        self.mean = {n: np.zeros_like(w) for n, w in weights.items()}
        self.square = {n: np.zeros_like(w) for n, w in weights.items()}
        self.count = 0

    def step(self, weights: Weights, gradients: Weights) -> None:
        """Change weights in place."""
        self.count += 1
        for name, weight in weights.items():
            gradient = gradients[name]
            self.mean[name] += (1 - FORGET) * (gradient - self.mean[name])
            self.square[name] += (1 - FORGET_SQUARES) * (gradient**2 - self.square[name])
            mean = self.mean[name] / (1 - FORGET**self.count)
            square = self.square[name] / (1 - FORGET_SQUARES**self.count)
            weight -= RATE * mean / (np.sqrt(square) + 1e-12)


def _copied(weights: Weights) -> dict[str, np.ndarray]:
    return {name: weight.copy() for name, weight in weights.items()}
