"""How many threads work, and how they wait: asleep, so that programs next to each other do not slow each other down."""

from __future__ import annotations

import os
from collections.abc import Mapping

# Read by the OpenMP libraries when torch or another library loads them; worker processes inherit these.
# GNU's spins for milliseconds at every barrier, which takes the cores from whoever would do the work.
WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}

# Of NumPy's and SciPy's products. Their threads wait for each other at every block, which on busy cores takes forty
# times as long, and all large work is done elsewhere.
IN_PRODUCTS = {"OPENBLAS_NUM_THREADS": "1"}


def wait_asleep() -> None:
    """Let idle threads of OpenMP sleep instead of spin; what the environment says already stands.

    References
    ----------
    OpenMP 5.2, section 21.7 (OMP_WAIT_POLICY); GCC's libgomp manual (GOMP_SPINCOUNT).
    """
    _say(WAITING)


def share_cores() -> None:
    """For whole programs, before NumPy is loaded: idle threads sleep, and NumPy's products take one thread.

    What the environment says already stands.
    """
    _say(WAITING | IN_PRODUCTS)


def _say(settings: Mapping[str, str]) -> None:
    """Put settings into the environment, those that it lacks."""
    for name, value in settings.items():
        os.environ.setdefault(name, value)


def cores() -> int:
    """Processors this process may use; OMP_NUM_THREADS lowers the number."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(here, int(limit)) if limit.isdigit() and int(limit) > 0 else here
