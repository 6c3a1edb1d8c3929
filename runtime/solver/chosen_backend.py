"""What the solver computes on: the CPU's cores or a GPU, chosen once."""

from __future__ import annotations

import os
from functools import cache

from firmware_iface.errors import InputError, nearest
from runtime.solver.array_backend import Backend
from runtime.solver.gpu_backend import CupyBackend

BACKENDS = ("numpy", "cupy")


@cache
def backend(name: str | None = None) -> Backend:
    """The machine's backend: CuPy where it is installed and has a GPU, else NumPy; or the one that is named.

    Parameters
    ----------
    name : str or None
        One of BACKENDS; None: the value of HOLOLOOP_BACKEND in the environment, if it is set.

    Returns
    -------
    Backend

    Raises
    ------
    InputError
        For one that does not exist or cannot start.
    """
    name = name or os.environ.get("HOLOLOOP_BACKEND") or None
    if name not in (None, *BACKENDS):
        raise InputError(f"there is no backend '{name}': {nearest(name, BACKENDS)}")
    if name == "numpy":
        return Backend()
    try:
        found = CupyBackend()
        if found.xp.cuda.runtime.getDeviceCount() > 0:
            return found
    except Exception as error:  # not installed, no driver, no device: library versions raise different errors
        if name == "cupy":
            raise InputError(f"the CuPy backend cannot start ({error}): use numpy") from error
    if name == "cupy":
        raise InputError("the CuPy backend finds no GPU: use numpy")
    return Backend()
