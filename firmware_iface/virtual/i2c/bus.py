"""An emulated I2C bus: addresses, bytes, acknowledgements, faults."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from firmware_iface.virtual.fault_injection import Faults

GENERAL_CALL = 0x00


class NackError(Exception):
    """A part does not acknowledge a byte; the adapter reports EREMOTEIO."""


class Message(NamedTuple):
    """One message of a transfer: bytes to write, or (data None) how many to read."""

    address: int
    data: bytes | None
    length: int = 0


class Part(Protocol):
    """A model on the bus."""

    def write(self, data: bytes) -> None:
        """Take the bytes of one write message.

        Raises
        ------
        NackError
            Where a byte is not acknowledged.
        """

    def read(self, length: int) -> bytes:
        """The bytes of one read message.

        Raises
        ------
        NackError
            Where the address is not acknowledged.
        """

    def stop(self) -> None:
        """The transfer is over (STOP on the wires)."""


class MessageBus(Protocol):
    """A carrier of transfers: this bus, or the connection to one in another process."""

    def transfer(self, messages: Sequence[Message]) -> list[bytes]:
        """Carry messages between one START and one STOP.

        Parameters
        ----------
        messages : sequence of Message

        Returns
        -------
        list of bytes
            One for each read message.

        Raises
        ------
        OSError
            As from an adapter.
        """


def failure(number: int) -> OSError:
    """The kernel's OSError for an error number."""
    return OSError(number, os.strerror(number))


class I2cBus:
    """Parts at their addresses, with faults and a transcript.

    Parameters
    ----------
    settle : callable
        Called before and after every transfer, so that the rest of the board follows the bus.
    faults : Faults or None
        Script that every transfer asks; a fault hits the whole transfer.

    Attributes
    ----------
    parts : dict of int to Part
        By address.
    transcript : list of str
        Every byte on the wires while `record` is set.
    record : bool
    sleep : callable
        For delays, s.
    """

    ADAPTER_TIMEOUT_S = 0.02

    def __init__(self, settle: Callable[[], None] = lambda: None, faults: Faults | None = None) -> None:
        self.parts: dict[int, Part] = {}
        self.faults = faults or Faults()
        self.record = False
        self.transcript: list[str] = []
        self.sleep: Callable[[float], None] = time.sleep
        self._settle = settle
        self.lock = threading.RLock()  # also for changes to the parts from outside the bus

    def transfer(self, messages: Sequence[Message]) -> list[bytes]:
        """Carry messages between one START and one STOP.

        Parameters
        ----------
        messages : sequence of Message

        Returns
        -------
        list of bytes
            One for each read message.

        Raises
        ------
        OSError
            As from an adapter.
        """
        self._settle()
        kinds = ("unplug", "nack", "timeout", "stall", "hang", "late", "short_write", "garbage", "die")
        fault = self.faults.take(*kinds)
        if fault == "die":
            os._exit(9)
        if fault == "hang":
            while self.faults.standing("hang"):
                self.sleep(0.005)
            fault = "timeout"
        if fault == "late":
            self.sleep(self.faults.late_s)
        if fault in ("timeout", "stall"):
            self.sleep(self.ADAPTER_TIMEOUT_S)
            raise failure(errno.ETIMEDOUT if fault == "timeout" else errno.EAGAIN)
        if fault in ("unplug", "nack"):
            raise failure(errno.ENXIO)
        with self.lock:
            return self._carry(messages, fault)

    def _carry(self, messages: Sequence[Message], fault: str | None) -> list[bytes]:
        self._settle()
        touched: list[Part] = []
        replies = []
        try:
            for message in messages:
                for part in self._answering(message):
                    touched.append(part)
                    if message.data is None:
                        reply = part.read(message.length)
                        replies.append(self.faults.garbled(reply) if fault == "garbage" else reply)
                    else:
                        part.write(self._as_it_arrives(message.data, fault))
                self._note(message, replies)
        except NackError:
            raise failure(errno.EREMOTEIO) from None
        finally:
            for part in touched:
                part.stop()
            self._settle()
        if fault == "short_write" and any(m.data for m in messages):
            raise failure(errno.EREMOTEIO)
        return replies

    def _as_it_arrives(self, data: bytes, fault: str | None) -> bytes:
        if fault == "garbage":
            return self.faults.garbled(data)
        return data[: len(data) // 2] if fault == "short_write" else data

    def _answering(self, message: Message) -> list[Part]:
        if message.address == GENERAL_CALL and message.data is not None:
            called = [p for p in self.parts.values() if hasattr(p, "general_call")]
            for part in called:
                part.general_call(message.data)
            if called:
                return []
        if message.address not in self.parts:
            raise failure(errno.ENXIO)
        return [self.parts[message.address]]

    def _note(self, message: Message, replies: list[bytes]) -> None:
        if not self.record:
            return
        read = message.data is None
        data = replies[-1] if read else message.data
        self.transcript.append(
            f"{message.address:02x} {'R' if read else 'W'} {(data or b'').hex(' ')}".strip()
        )
