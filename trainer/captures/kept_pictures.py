"""Pictures that a worker has read and keeps, up to a number of bytes, for its next tasks on the same captures."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path

import numpy as np

KEPT_BYTES = 64 * 2**20  # the captures that fits and judgements of one set read, at 1080 x 1920

_pictures: OrderedDict[Hashable, np.ndarray] = OrderedDict()  # the one that was used last at the end
_lock = threading.Lock()  # a worker may have threads
_limit = 0


def keep_pictures(limit_bytes: int = KEPT_BYTES) -> None:
    """Keep what is read from now on in this process; those that were not used for longest go first.

    Parameters
    ----------
    limit_bytes : int
        0 keeps nothing.
    """
    global _limit
    with _lock:
        _limit = limit_bytes
        _drop()


def kept_bytes() -> int:
    """Bytes of the pictures that are kept."""
    with _lock:
        return sum(p.nbytes for p in _pictures.values())


def kept_or_read(path: Path, how: Hashable, read: Callable[[], np.ndarray]) -> np.ndarray:
    """A picture that is kept, or else read and kept; a file that has changed is read again.

    Parameters
    ----------
    path : Path
    how : hashable
        What else the result depends on.
    read : callable
        Reads it.

    Returns
    -------
    array
        Not writeable where it is kept.
    """
    if not _limit:
        return read()
    try:
        state = path.stat()
    except OSError:
        return read()  # which says what is wrong
    key = (path, how, state.st_mtime_ns, state.st_size)
    with _lock:
        if key in _pictures:
            _pictures.move_to_end(key)
            return _pictures[key]
    picture = read()
    picture.flags.writeable = False
    with _lock:
        _pictures[key] = picture
        _drop()
    return picture


def _drop() -> None:
    total = sum(p.nbytes for p in _pictures.values())
    while _pictures and total > _limit:
        _, oldest = _pictures.popitem(last=False)
        total -= oldest.nbytes
