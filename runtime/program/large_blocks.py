"""Keeps large blocks of memory in the process, where the C library would give them back and ask again.

By default glibc returns large temporaries to the system at once. The next one of the same size is then faulted in page
by page, which can cost as much time as the arithmetic on it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

# From glibc's malloc.h: mallopt's numbers, and the values that it takes as C ints.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3
SETTINGS = {TRIM_THRESHOLD: 2**31 - 1, TOP_PAD: 256 * 2**20, MMAP_THRESHOLD: 2**30}

MOST_IDLE = 2 * 2**30  # bytes that a process may hold while it waits


def keep_large_blocks() -> bool:
    """Keep freed blocks of up to a gigabyte for later ones.

    Returns
    -------
    bool
        False where the C library is not glibc, and nothing was changed.

    References
    ----------
    mallopt(3): M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD.
    """
    library = _glibc()
    return library is not None and all(library.mallopt(n, value) == 1 for n, value in SETTINGS.items())


def give_back_blocks() -> None:
    """Give free memory back to the system, where this process holds much of it: before it waits for others.

    References
    ----------
    malloc_trim(3).
    """
    library = _glibc()
    if library is None:
        return
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    if pages * os.sysconf("SC_PAGE_SIZE") > MOST_IDLE:
        library.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    """The C library, if it is glibc."""
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)  # musl has a mallopt that does nothing
    return library if hasattr(library, "gnu_get_libc_version") else None
