"""Results that are kept for later, within a bound on memory; each for the device that it was made on."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

F = TypeVar("F", bound=Callable[..., Any])

MOST_BYTES = 2**30  # of the results that are kept of one function: some scenes of 1080 x 1920


def kept_by_device(most: int) -> Callable[[F], F]:
    """Keep the last results of a function that makes tensors from arguments that can be compared.

    At most so many are kept, of together no more than `MOST_BYTES`, each for its device.
    """

    def kept(function: F) -> F:
        known = _Known(most)

        @wraps(function)
        def here(*args: Hashable) -> Any:
            key = (torch.get_default_device(), *args)
            found = known.get(key)
            return found[0] if found else known.keep(key, function(*args))

        return cast(F, here)

    return kept


def kept_for_same(most: int) -> Callable[[F], F]:
    """Keep the last results of a function that makes tensors from objects that never change.

    The arguments are compared by identity, as objects that hold arrays have no quick equality, but numbers by value.
    The result is kept for its device, within `MOST_BYTES`; with derivatives nothing is kept, as that would keep what
    the backward pass needs.
    """

    def kept(function: F) -> F:
        known = _Known(most)

        @wraps(function)
        def here(*args: Any) -> Any:
            if torch.is_grad_enabled():
                return function(*args)
            key = (torch.get_default_device(), *(arg if isinstance(arg, int) else id(arg) for arg in args))
            found = known.get(key)
            # The arguments live on with the result, so that no other object gets their ids.
            return found[0] if found else known.keep(key, function(*args), args)

        return cast(F, here)

    return kept


@contextmanager
def forgotten_afterwards() -> Iterator[None]:
    """What this thread makes in the block is kept to its end only: for scenes that nobody asks for again.

    Kept among temporaries of ever other sizes, large results would also leave the memory in pieces that fit none.
    """
    before = getattr(_block, "made", None)
    made = _block.made = []
    try:
        yield
    finally:
        _block.made = before
        for known, key in made:
            known.forget(key)


_block = threading.local()  # of each thread: where it notes what it has made in its block, if it is in one


class _Known:
    """The last results of one function, the latest always among them, for any thread."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._results: OrderedDict[Hashable, tuple[Any, ...]] = OrderedDict()
        self._bytes: dict[Hashable, int] = {}

    def get(self, key: Hashable) -> tuple[Any, ...] | None:
        """A result, first in a tuple; None where it is not known."""
        with self._lock:
            if key not in self._results:
                return None
            self._results.move_to_end(key)
            return self._results[key]

    def keep(self, key: Hashable, result: Any, *beside: Any) -> Any:
        """Keep a result, and what has to live as long; returns the result that is kept for the key."""
        with self._lock:
            if key in self._results:  # another thread has made it, too: all use the same one
                return self._results[key][0]
            self._results[key] = result, *beside
            self._bytes[key] = sum(_storages(result).values())
            made: list[tuple[_Known, Hashable]] | None = getattr(_block, "made", None)
            if made is not None:
                made.append((self, key))
            while len(self._results) > 1 and (
                len(self._results) > self._most or sum(self._bytes.values()) > MOST_BYTES
            ):
                self._drop(next(iter(self._results)))
            return result

    def forget(self, key: Hashable) -> None:
        """Let go of a result, if it is still here."""
        with self._lock:
            self._drop(key)

    def _drop(self, key: Hashable) -> None:
        self._results.pop(key, None)
        self._bytes.pop(key, None)


def _storages(result: Any) -> dict[int, int]:
    """Sizes in bytes of the memory blocks behind all tensors of a result, by their address."""
    if isinstance(result, Tensor):
        storage = result.untyped_storage()
        return {storage.data_ptr(): storage.nbytes()}
    parts: Any = ()
    if is_dataclass(result):
        parts = (getattr(result, field.name) for field in fields(result))
    elif isinstance(result, tuple):
        parts = result
    return {address: size for part in parts for address, size in _storages(part).items()}
