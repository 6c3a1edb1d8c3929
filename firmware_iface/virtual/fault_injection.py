"""Faults injected into byte-level models: which, when, for how long. Every model asks one script before each transfer.

faults = Faults()
faults.arm("stall")                 # the next transfer
faults.arm("garbage", count=3)      # the next three
faults.arm("short_write", after=5)  # the sixth from now
faults.arm("hang", count=None)      # from now until clear("hang")
faults.arm("unplug")                # always until clear("unplug"), which plugs the device in again
"""

from __future__ import annotations

import random
import threading
from collections import Counter

from firmware_iface.errors import InputError, nearest

KINDS = {
    "timeout": "the transfer does nothing and is not answered",
    "stall": "the request is refused (USB: the endpoint halts)",
    "short_write": "only the first part of what is written arrives",
    "nack": "the address is not acknowledged (I2C)",
    "unplug": "the device is unplugged; clearing plugs it in again, with the state of a fresh start",
    "garbage": "the bytes of the transfer arrive as random ones",
    "hang": "nothing is answered or done until it is cleared",
    "late": "what is due comes late, by `late_s`",
    "torn_field": "a panel takes only a part of a field's pattern; the rest is that of the field before",
    "swapped_gate": "a field gets the light that belongs to another field of its frame",
    "missing_field": "a panel does not take a field and goes on showing the field before",
    "die": "the process that owns the device dies at once",
}


class Faults:
    """The faults of one model. Safe to arm from one thread while another drives the model.

    Parameters
    ----------
    seed : int
        Fixes the random bytes of "garbage".

    Attributes
    ----------
    late_s : float, s
        Delay of a late answer.
    struck : Counter
        How often each kind took effect.
    ended : Counter
        How often each kind ended, by count or by clearing, after it had been due.
    """

    def __init__(self, seed: int = 0) -> None:
        self.late_s = 0.25
        self.struck: Counter[str] = Counter()
        self.ended: Counter[str] = Counter()
        self._script: dict[
            str, tuple[int, int | None]
        ] = {}  # kind: (transfers that pass, transfers that are struck)
        self._random = random.Random(seed)
        self._lock = threading.Lock()

    def arm(self, kind: str, count: int | None = 1, after: int = 0) -> None:
        """Let a fault strike the next `count` transfers, or every one until cleared where count is None.

        "unplug" always lasts until it is cleared.

        Parameters
        ----------
        kind : str
            One of KINDS.
        count : int or None
            Transfers that are struck; None: until cleared.
        after : int
            Transfers that pass before.

        Raises
        ------
        InputError
            For an unknown kind or a number out of range.
        """
        if kind not in KINDS:
            raise InputError(f"there is no fault '{kind}'; {nearest(kind, KINDS)}")
        if after < 0 or (count is not None and count < 1):
            raise InputError(
                f"fault '{kind}' is armed with count {count} after {after}; give count 1 or more "
                "(or None) and after 0 or more."
            )
        with self._lock:
            self._script[kind] = (after, None if kind == "unplug" else count)

    def clear(self, kind: str | None = None) -> None:
        """Disarm one kind, or all."""
        with self._lock:
            for name in KINDS if kind is None else [kind]:
                if self._script.pop(name, (1, None))[0] == 0:
                    self.ended[name] += 1

    def standing(self, kind: str) -> bool:
        """Whether the next transfer would be struck; does not count as one."""
        with self._lock:
            return self._script.get(kind, (1, None))[0] == 0

    def take(self, *kinds: str) -> str | None:
        """Count one transfer that could suffer `kinds`; the first of them that strikes it, or None."""
        with self._lock:
            hit = None
            for kind in kinds:
                if kind not in self._script:
                    continue
                spare, left = self._script[kind]
                if spare:
                    self._script[kind] = (spare - 1, left)
                elif hit is None:
                    hit = kind
                    if left is not None:
                        if left == 1:
                            del self._script[kind]
                            self.ended[kind] += 1
                        else:
                            self._script[kind] = (0, left - 1)
            if hit:
                self.struck[hit] += 1
            return hit

    def garbled(self, data: bytes) -> bytes:
        """Random bytes of the same length that differ from `data` (empty stays empty)."""
        with self._lock:
            out = self._random.randbytes(len(data))
        return out if out != data or not data else bytes([out[0] ^ 0xFF]) + out[1:]
