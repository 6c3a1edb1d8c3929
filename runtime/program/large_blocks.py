"""Keeps large blocks of memory in the process, where the C library would give them back and ask again.

By default glibc returns large temporaries to the system at once. The next one of the same size is then faulted in page
by page, which can cost as much time as the arithmetic on it.
"""

from __future__ import annotations

import ctypes
import sys

# From glibc's malloc.h: mallopt's numbers, and the values that it takes as C ints.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3
SETTINGS = {TRIM_THRESHOLD: 2**31 - 1, TOP_PAD: 256 * 2**20, MMAP_THRESHOLD: 2**30}


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
    if not sys.platform.startswith("linux"):
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):  # musl has a mallopt that does nothing
        return False
    return all(library.mallopt(number, value) == 1 for number, value in SETTINGS.items())
