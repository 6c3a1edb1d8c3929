"""The aberration approximator D: from irradiance that the optics predict to irradiance that a camera measures.

Chakravarthula et al. 2020, eq. 13. It comes in a bundle as two networks in ONNX: `approximator.onnx`, irradiance to
corrected, and `approximator_gradient.onnx`, irradiance and target to a loss and its gradient over irradiance, with
the weights that may be refined on the headset as further inputs (in the first file, inputs with a default). All are
[1, C, H, W], float32, irradiance with a mean of about 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT, Bundle
from runtime.networks.onnx_session import OnnxSession

CORRECTIONS = 2  # of a target that is pre-distorted
EPSILON = 1e-3  # added under the square roots of the loss that is in the gradient's network


class Approximator:
    """D for pictures of one size.

    Parameters
    ----------
    shape : (int, int, int)
        C, H, W.
    model : bytes
        The network in ONNX from irradiance to corrected.
    gradient : bytes or None
        The network in ONNX from irradiance and target to a loss and its gradient.
    adapters : mapping of str to array, or None
        Weights that the gradient's network takes, by the name of their input.

    Attributes
    ----------
    irradiance, target, corrected, slope : float32 array [C, H, W]
        Its inputs and outputs, which callers fill and read in place.

    Raises
    ------
    InputError
        For networks that do not fit.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        model: bytes,
        gradient: bytes | None = None,
        adapters: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.shape = shape
        whole = (1, *shape)
        self._irradiance, self._target, self._corrected, self._slope = (
            np.zeros(whole, np.float32) for _ in range(4)
        )
        self.irradiance, self.target, self.corrected, self.slope = (
            a[0] for a in (self._irradiance, self._target, self._corrected, self._slope)
        )
        self._loss = np.zeros((), np.float32)
        self._forward = OnnxSession(model, "approximator.onnx")
        _check(self._forward, {"irradiance"}, {"corrected"}, whole)
        given = {n: np.array(a, np.float32) for n, a in (adapters or {}).items()}
        self._forward.bind(
            irradiance=self._irradiance,
            corrected=self._corrected,
            **{n: a for n, a in given.items() if n in self._forward.defaults},
        )
        self._backward: OnnxSession | None = None
        if gradient is not None:
            self._backward = OnnxSession(gradient, "approximator_gradient.onnx")
            _check(self._backward, {"irradiance", "target", *given}, {"loss", "gradient"}, whole)
            room: dict[str, np.ndarray] = {
                name: np.zeros(given[name.removeprefix("gradient.")].shape, np.float32)
                for name in self._backward.outputs
                if name.startswith("gradient.")
            }
            self._adapter_gradients = {name.removeprefix("gradient."): a for name, a in room.items()}
            self._adapters = given
            if "corrected" in self._backward.outputs:  # with the adapters as they are now
                room["corrected"] = self._corrected
            self._backward.bind(
                irradiance=self._irradiance, target=self._target, loss=self._loss, gradient=self._slope,
                **self._adapters, **room,
            )  # fmt: skip

    @property
    def has_gradient(self) -> bool:
        """Whether `look` can be called."""
        return self._backward is not None

    @property
    def adapters(self) -> dict[str, np.ndarray]:
        """The weights that may be refined, by name, to be written in place; `look` takes them.

        `correct` does too, where `correct_follows`.
        """
        return self._adapters if self._backward is not None else {}

    @property
    def refinable(self) -> bool:
        """Whether `look` takes adapters, gives their gradients and fills `corrected` with what they make."""
        return bool(self.adapters) and "corrected" in getattr(self._backward, "outputs", ())

    @property
    def correct_follows(self) -> bool:
        """Whether `correct` takes the adapters, too; exports of versions before 0.2 have theirs built in."""
        return set(self.adapters) <= set(self._forward.defaults)

    def correct(self) -> None:
        """Fill `corrected` from `irradiance`."""
        self._forward.run()

    def look(self) -> float:
        """The loss of `irradiance` against `target`; fills `slope`, its gradient over irradiance.

        Raises
        ------
        InputError
            Where the bundle has no network for the gradient.
        """
        if self._backward is None:
            raise InputError(
                "the bundle has no approximator_gradient.onnx: export it, or pre-distort targets"
            )
        self._backward.run()
        return float(self._loss)

    def adapter_gradients(self) -> dict[str, np.ndarray]:
        """The loss's gradient over each adapter, of the last `look`; the arrays are written again by the next."""
        return self._adapter_gradients if self._backward is not None else {}


def approximator_of(bundle: Bundle, shape: tuple[int, int, int]) -> Approximator | None:
    """The approximator in a bundle.

    Parameters
    ----------
    bundle : Bundle
    shape : (int, int, int)
        Of irradiance: C, H, W.

    Returns
    -------
    Approximator or None
        None where the bundle has none: D is the identity.

    Raises
    ------
    InputError
        For adapters that cannot be read and networks that do not fit.
    """
    if APPROXIMATOR not in bundle.networks:
        return None
    adapters = {}
    if ADAPTERS in bundle.networks:
        try:
            adapters = safetensors.numpy.load(bundle.networks[ADAPTERS])
        except (SafetensorError, KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"{ADAPTERS} cannot be read as arrays: {error}; export the bundle again"
            ) from error
    return Approximator(shape, bundle.networks[APPROXIMATOR], bundle.networks.get(GRADIENT), adapters)


def predistorted(d: Approximator, targets: np.ndarray) -> np.ndarray:
    """Targets [C, 1, H, W] that D turns into the given ones, as nearly as two corrections allow, of the same scale.

    Where D is near the identity, t - D(J) is about what J lacks.
    """
    means = [float(np.mean(target, dtype=np.float64)) for target in targets]
    for c, (target,) in enumerate(targets):
        np.multiply(target, 1 / means[c], out=d.target[c])
    d.irradiance[...] = d.target
    for _ in range(CORRECTIONS):
        d.correct()
        for c in range(len(targets)):
            made, wanted = d.corrected[c], d.target[c]
            scale = float(np.vdot(made, wanted)) / max(float(np.vdot(made, made)), 1e-30)
            made *= -scale
            made += wanted
            d.irradiance[c] += made
            np.maximum(d.irradiance[c], 0, out=d.irradiance[c])
    for c, mean in enumerate(means):
        d.irradiance[c] *= mean
    return d.irradiance[:, None]


def _check(session: OnnxSession, inputs: set[str], outputs: set[str], shape: tuple[int, ...]) -> None:
    if missing := sorted(inputs - set(session.inputs)) + sorted(outputs - set(session.outputs)):
        raise InputError(f"{session.name} has no '{missing[0]}': export the bundle again")
    if extra := sorted(set(session.inputs) - inputs):
        raise InputError(
            f"{session.name} needs an input '{extra[0]}' that the bundle does not hold: export it again"
        )
    declared: Any = session.inputs["irradiance"]
    sizes = list(zip(declared, shape, strict=False))
    if len(declared) != 4 or any(isinstance(n, int) and n != wanted for n, wanted in sizes):
        raise InputError(
            f"{session.name} takes irradiance of {' x '.join(map(str, declared))} and the panel needs "
            f"{' x '.join(map(str, shape))}: export it for this panel"
        )
