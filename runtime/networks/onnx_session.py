"""ONNX Runtime as the frame loop needs it: the fastest provider available, and no threads that spin.

A session whose threads spin while they wait steals the cores from the transforms around it, which then take
half as long again. Arrays are bound once, so a call allocates nothing.
"""

from __future__ import annotations

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.fft import THREADS

PROVIDERS = (
    "TensorrtExecutionProvider",
    "CUDAExecutionProvider",
    "OpenVINOExecutionProvider",
    "CPUExecutionProvider",
)


class OnnxSession:
    """A network in ONNX whose inputs and outputs are in fixed arrays.

    Parameters
    ----------
    model : bytes
    name : str
        Of its file, for messages.
    threads : int

    Attributes
    ----------
    inputs : dict of str to list
        Shapes by name.
    defaults : dict of str to list
        Shapes by name of inputs that have a value where none is given.
    outputs : list of str
    provider : str
        The one that ONNX Runtime chose.

    Raises
    ------
    InputError
        For a model that cannot be loaded.
    """

    def __init__(self, model: bytes, name: str, threads: int = THREADS) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        available = onnxruntime.get_available_providers()
        providers = [p for p in PROVIDERS if p in available]
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=providers)
        except Exception as error:  # the library's own exceptions share no base class
            raise InputError(
                f"{name} cannot be loaded ({_first_line(error)}): export the bundle again"
            ) from None
        self.name = name
        self.inputs = {i.name: i.shape for i in self._session.get_inputs()}
        self.defaults = {i.name: i.shape for i in self._session.get_overridable_initializers()}
        self.outputs = [o.name for o in self._session.get_outputs()]
        self.provider: str = self._session.get_providers()[0]
        self._binding = self._session.io_binding()
        self._kept: dict[str, np.ndarray] = {}  # the binding holds no reference of its own

    def bind(self, **arrays: np.ndarray) -> None:
        """Set once where inputs are read and outputs written: contiguous float32 arrays."""
        for name, array in arrays.items():
            given = name in self.inputs or name in self.defaults
            to = self._binding.bind_input if given else self._binding.bind_output
            to(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
            self._kept[name] = array

    def run(self) -> None:
        """Fill the outputs from the inputs.

        Raises
        ------
        InputError
            Where the network does not take their sizes.
        """
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as error:
            raise InputError(
                f"{self.name} cannot be run ({_first_line(error)}): export the bundle again"
            ) from None


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
