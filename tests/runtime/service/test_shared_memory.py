"""Shared memory: which memory is accepted, and that it can neither shrink nor change while it is read."""

from __future__ import annotations

import fcntl
import os
import tempfile

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.service.shared_memory import crc32, make_ring, open_ring, read_sealed, sealed_copy

SHAPE = (2, 3, 4)


def test_what_one_side_writes_the_other_reads() -> None:
    ours = make_ring(3, SHAPE, np.uint16)
    theirs = open_ring(os.dup(ours.fd), 3, SHAPE, np.uint16)
    ours.slots[1] = np.arange(24).reshape(SHAPE)
    np.testing.assert_array_equal(theirs.slots[1], np.arange(24).reshape(SHAPE))
    assert not theirs.slots[0].any()
    with pytest.raises(ValueError, match="read-only"):
        theirs.slots[0] = 1


def test_a_ring_cannot_shrink_under_its_reader() -> None:
    ring = make_ring(3, SHAPE, np.uint16)
    with pytest.raises(PermissionError):
        os.ftruncate(ring.fd, 10)


def unsealed() -> int:
    fd = os.memfd_create("test", os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, 4096)
    return fd


def half_sealed() -> int:
    fd = unsealed()
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
    return fd


def small() -> int:
    return os.dup(make_ring(2, SHAPE, np.uint16).fd)


def plain_file() -> int:
    with tempfile.TemporaryFile() as file:
        file.truncate(4096)
        return os.dup(file.fileno())


@pytest.mark.parametrize(
    ("make", "message"),
    [(unsealed, "seal it"), (half_sealed, "seal it"), (small, "larger"), (plain_file, "not a memfd")],
)
def test_what_could_fail_under_the_reader_is_refused(make, message: str) -> None:
    fd = make()
    with pytest.raises(InputError, match=message):
        open_ring(fd, 3, SHAPE, np.uint16)
    with pytest.raises(OSError):
        os.fstat(fd)  # it was closed


def test_a_sealed_copy_never_changes() -> None:
    counts = np.arange(24, dtype=np.uint16).reshape(SHAPE)
    fd = sealed_copy(counts)
    with pytest.raises(PermissionError):
        os.pwrite(fd, b"x", 0)
    np.testing.assert_array_equal(read_sealed(fd, SHAPE, np.uint16), counts)


def test_crc_sees_every_byte_and_no_layout() -> None:
    counts = np.arange(24, dtype=np.uint16).reshape(SHAPE)
    assert crc32(counts) == crc32(np.asfortranarray(counts))
    for place in np.ndindex(SHAPE):
        other = counts.copy()
        other[place] ^= 1
        assert crc32(other) != crc32(counts)
