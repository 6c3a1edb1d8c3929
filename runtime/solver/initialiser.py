"""A first phase from a small network, so that two or three iterations are enough.

`initialiser.onnx` in a bundle: `target` [1, 1, H, W], amplitude with a mean square of 1, to `phase`
[1, 2, H, W], cosine and sine (of any common length) at the panel. It may take `start` [1, 1, H, W], too, rad: the phase
that the solver would begin with, which it then corrects.
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

    Attributes
    ----------
    corrects : bool
        Whether it takes a start.
    """

    def __init__(self, model: bytes, shape: tuple[int, int]) -> None:
        self._target = np.zeros((1, 1, *shape), np.float32)
        self._phase = np.zeros((1, 2, *shape), np.float32)
        self._session = OnnxSession(model, "initialiser.onnx")
        self.corrects = "start" in self._session.inputs
        if set(self._session.inputs) - {"start"} != {"target"} or self._session.outputs != ["phase"]:
            raise InputError(
                "initialiser.onnx is not a network from target to phase: export the bundle again"
            )
        self._session.bind(target=self._target, phase=self._phase)
        if self.corrects:
            self._start = np.zeros((1, 1, *shape), np.float32)
            self._session.bind(start=self._start)

    def phase(self, amplitude: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
        """The network's phase (rad) [H, W] for an amplitude [H, W], and a start where it `corrects` one.

        It is written again by the next call.
        """
        self._target[0, 0] = amplitude
        if self.corrects and start is not None:
            self._start[0, 0] = start
        self._session.run()
        cosine, sine = self._phase[0]
        np.arctan2(sine, cosine, out=cosine)
        return cosine
