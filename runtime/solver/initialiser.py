"""A first phase from a small network, so that two or three iterations are enough.

`initialiser.onnx` in a bundle: `target` [1, 1, H, W], amplitude with a mean square of 1, to `phase`
[1, 2, H, W], cosine and sine (of any common length) at the panel.
"""

from __future__ import annotations

import numpy as np

from firmware_iface.errors import InputError
from runtime.networks.onnx_session import OnnxSession


class Initialiser:
    """The network for a panel of one shape.

    Parameters
    ----------
    model : bytes
        ONNX.
    shape : (int, int), pixels

    Raises
    ------
    InputError
        Where the network does not fit.
    """

    def __init__(self, model: bytes, shape: tuple[int, int]) -> None:
        self._target = np.zeros((1, 1, *shape), np.float32)
        self._phase = np.zeros((1, 2, *shape), np.float32)
        self._session = OnnxSession(model, "initialiser.onnx")
        if set(self._session.inputs) != {"target"} or self._session.outputs != ["phase"]:
            raise InputError(
                "initialiser.onnx is not a network from target to phase: export the bundle again"
            )
        self._session.bind(target=self._target, phase=self._phase)

    def phase(self, amplitude: np.ndarray) -> np.ndarray:
        """The network's phase (rad) [H, W] for an amplitude [H, W]; written again by the next call."""
        self._target[0, 0] = amplitude
        self._session.run()
        cosine, sine = self._phase[0]
        np.arctan2(sine, cosine, out=cosine)
        return cosine
