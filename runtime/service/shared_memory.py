"""Arrays in memory that two processes share: a ring of equal slots in a sealed memfd.

A memfd that may shrink lets its owner kill the reader (SIGBUS on the missing page), so a memfd without the seals
is refused. Messages say which process may write which slot; the kernel does not enforce it.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import zlib

import numpy as np

from firmware_iface.errors import InputError

FIXED_SIZE = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
UNCHANGEABLE = FIXED_SIZE | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL


class Ring:
    """Slots of one shape and type.

    Attributes
    ----------
    fd : int
        Descriptor of the memfd; -1 after `close`.
    slots : array [n, *shape]
        Read-only where the ring came from another process.
    """

    def __init__(self, fd: int, slots: np.ndarray) -> None:
        self.fd, self.slots = fd, slots

    def close(self) -> None:
        """Close the descriptor; the memory is freed with the last array on it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def make_ring(count: int, shape: tuple[int, ...], dtype: type[np.generic]) -> Ring:
    """A new ring of `count` zeroed slots, writable here, of a size that no process can change."""
    slot_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
    fd = os.memfd_create("hololoop-ring", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(fd, count * slot_bytes)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, FIXED_SIZE | fcntl.F_SEAL_SEAL)
        memory = mmap.mmap(fd, count * slot_bytes)
    except BaseException:
        os.close(fd)
        raise
    return Ring(fd, np.frombuffer(memory, dtype).reshape(count, *shape))


def open_ring(fd: int, count: int, shape: tuple[int, ...], dtype: type[np.generic]) -> Ring:
    """Another process's ring, read-only. The ring owns `fd` from now on.

    Raises
    ------
    InputError
        Where `fd` is not a sealed memfd of at least that size; `fd` is then closed.
    """
    try:
        size = count * int(np.prod(shape)) * np.dtype(dtype).itemsize
        try:
            seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
        except OSError:
            raise InputError("the ring is not a memfd: make it with memfd_create and seal it") from None
        if seals & FIXED_SIZE != FIXED_SIZE:
            raise InputError("the ring can still shrink or grow: seal it with F_SEAL_SHRINK and F_SEAL_GROW")
        if (found := os.fstat(fd).st_size) < size:
            raise InputError(f"the ring has {found} bytes and {count} slots need {size}: make it larger")
        memory = mmap.mmap(fd, size, prot=mmap.PROT_READ)
        return Ring(fd, np.frombuffer(memory, dtype).reshape(count, *shape))
    except BaseException:
        os.close(fd)
        raise


def sealed_copy(array: np.ndarray) -> int:
    """A memfd that holds an array's bytes and that no process can change; the caller closes it."""
    fd = os.memfd_create("hololoop-picture", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        with os.fdopen(os.dup(fd), "wb") as file:
            file.write(np.ascontiguousarray(array).data)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, UNCHANGEABLE)
    except BaseException:
        os.close(fd)
        raise
    return fd


def read_sealed(fd: int, shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
    """The array in another process's memfd, read-only; closes `fd`.

    Raises
    ------
    InputError
        As `open_ring`.
    """
    ring = open_ring(fd, 1, shape, dtype)
    ring.close()
    return ring.slots[0]


def crc32(array: np.ndarray) -> int:
    """CRC-32 (zlib's) of an array's bytes in C order."""
    return zlib.crc32(np.ascontiguousarray(array).data)
