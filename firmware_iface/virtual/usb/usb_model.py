"""A USB device at the level of its bytes: descriptors, setup packets, endpoints, and faults on any of them.

A front end (`pyusb_backend`, or a host controller) calls `control`, `write` and `read`; a
model fills in `on_control`, `on_write` and `on_read` and may raise Stall or Nak there.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from firmware_iface.virtual.fault_injection import Faults

GET_STATUS, CLEAR_FEATURE, SET_FEATURE, GET_DESCRIPTOR = 0, 1, 3, 6
GET_CONFIGURATION, SET_CONFIGURATION, GET_INTERFACE, SET_INTERFACE = 8, 9, 10, 11
BULK, INTERRUPT = 2, 3

T = TypeVar("T")
GiveUp = Callable[[], bool]


class Stall(Exception):
    """The device refuses the transfer."""


class Nak(Exception):
    """The device has no data or no room yet; raised to the front end after its time limit."""


class NoDevice(Exception):
    """The device is unplugged."""


def device_descriptor(vendor: int, product: int, release: int = 0x0100) -> bytes:
    """18 bytes; strings 1, 2, 3 are maker, product and serial number."""
    return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, 64, vendor, product, release, 1, 2, 3, 1)


def configuration_descriptor(*parts: bytes) -> bytes:
    """The one configuration, bus powered, with one interface made of `parts`."""
    body = b"".join(parts)
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 1, 1, 0, 0x80, 250) + body


def interface_descriptor(endpoints: int, device_class: int, subclass: int = 0, protocol: int = 0) -> bytes:
    """Interface 0 without alternates."""
    return struct.pack("<9B", 9, 4, 0, 0, endpoints, device_class, subclass, protocol, 0)


def endpoint_descriptor(address: int, kind: int, packet: int, interval: int = 0) -> bytes:
    """An endpoint of `kind` BULK or INTERRUPT with packets of up to `packet` bytes."""
    return struct.pack("<BBBBHB", 7, 5, address, kind, packet, interval)


class UsbModel:
    """Behaviour that every modelled USB device has; thread safe.

    Parameters
    ----------
    descriptor, configuration : bytes
        Raw descriptors.
    strings : tuple of str
        By index from 1.
    faults : Faults or None
        The script that each transfer asks: unplug, hang, timeout, late, stall, garbage, short_write.

    Attributes
    ----------
    generation : int
        How often it was plugged in; handles of earlier generations are invalid.
    configured : int
        The configuration in force; 0: none.
    """

    def __init__(
        self, descriptor: bytes, configuration: bytes, strings: tuple[str, ...], faults: Faults | None = None
    ) -> None:
        self.descriptor, self.configuration = descriptor, configuration
        self.faults = faults or Faults()
        self.generation = self.faults.ended["unplug"]
        self.configured = 0
        self.halted: set[int] = set()
        self._strings = strings
        self._lock = threading.RLock()

    @property
    def present(self) -> bool:
        """Whether it is plugged in. A device that was unplugged meanwhile has lost its state."""
        with self._lock:
            if self.generation != self.faults.ended["unplug"]:
                self.generation = self.faults.ended["unplug"]
                self.reset()
            return not self.faults.standing("unplug")

    def reset(self) -> None:
        """A USB reset, or a fresh start after power came back."""
        with self._lock:
            self.configured = 0
            self.halted.clear()
            self.on_reset()

    # what a front end calls

    def control(
        self, kind: int, request: int, value: int, index: int, data: bytes | int, give_up: GiveUp
    ) -> bytes:
        """One control transfer: `data` is what is sent, or how many bytes are asked for. Returns the reply."""
        fault = self._struck(give_up, "stall", "garbage")
        if fault == "stall":
            raise Stall
        if fault == "garbage" and isinstance(data, bytes):
            data = self.faults.garbled(data)
        with self._lock:
            standard = kind & 0x60 == 0
            answer = self._standard if standard else self.on_control
            reply = answer(kind, request, value, index, data)
        if isinstance(data, int):
            reply = reply[:data]
        return self.faults.garbled(reply) if fault == "garbage" and not standard else reply

    def write(self, endpoint: int, data: bytes, give_up: GiveUp) -> int:
        """One OUT transfer; returns how many bytes were taken."""
        fault = self._struck(give_up, "stall", "garbage", "short_write")
        if fault == "short_write":
            data = data[: len(data) // 2]
        elif fault == "garbage":
            data = self.faults.garbled(data)
        self._wait(endpoint, fault, give_up, lambda: self.on_write(endpoint, data))
        return len(data)

    def read(self, endpoint: int, length: int, give_up: GiveUp) -> bytes:
        """One IN transfer of up to `length` bytes."""
        fault = self._struck(give_up, "stall", "garbage")
        reply = self._wait(endpoint, fault, give_up, lambda: self.on_read(endpoint, length))[:length]
        return self.faults.garbled(reply) if fault == "garbage" else reply

    # what a model fills in

    def on_reset(self) -> None:
        """Forget everything but the settings in flash."""

    def on_control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        """A class or vendor request; may raise Stall."""
        raise Stall

    def on_write(self, endpoint: int, data: bytes) -> None:
        """Bytes of one OUT transfer; may raise Stall, or Nak for "try again"."""
        raise Stall

    def on_read(self, endpoint: int, length: int) -> bytes:
        """Bytes for one IN transfer; may raise Stall, or Nak for "nothing yet"."""
        raise Stall

    def _struck(self, give_up: GiveUp, *kinds: str) -> str | None:
        fault = self.faults.take("unplug", "hang", "timeout", "late", *kinds)
        if fault == "unplug":
            raise NoDevice
        if fault in ("hang", "timeout"):
            while not give_up():
                if not self.present:
                    raise NoDevice
                time.sleep(0.001)
            raise Nak
        if fault == "late":
            end = time.monotonic() + self.faults.late_s
            while time.monotonic() < end:
                if give_up():
                    raise Nak
                time.sleep(0.001)
        return fault

    def _wait(self, endpoint: int, fault: str | None, give_up: GiveUp, act: Callable[[], T]) -> T:
        """Repeat `act` while it says Nak; an endpoint that stalled refuses until its halt is cleared."""
        while True:
            with self._lock:
                if not self.present:
                    raise NoDevice
                if fault == "stall":
                    self.halted.add(endpoint)
                if endpoint in self.halted or not self.configured:
                    raise Stall
                try:
                    return act()
                except Stall:
                    self.halted.add(endpoint)
                    raise
                except Nak:
                    if give_up():
                        raise
            time.sleep(0.0005)

    def _standard(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        if request == GET_DESCRIPTOR and kind == 0x80:
            return self._described(value >> 8, value & 0xFF)
        if request == SET_CONFIGURATION and value in (0, 1):
            self.configured = value
            self.halted.clear()
            return b""
        if request == GET_CONFIGURATION:
            return bytes([self.configured])
        if request == GET_STATUS:
            return struct.pack("<H", kind & 0x1F == 2 and index in self.halted)
        if request == CLEAR_FEATURE:
            self.halted.discard(index)
            return b""
        if request == SET_FEATURE and kind & 0x1F == 2:
            self.halted.add(index)
            return b""
        if request in (GET_INTERFACE, SET_INTERFACE):
            return bytes(1)
        raise Stall

    def _described(self, kind: int, index: int) -> bytes:
        if kind == 1:
            return self.descriptor
        if kind == 2 and index == 0:
            return self.configuration
        if kind == 3 and index == 0:
            return struct.pack("<BBH", 4, 3, 0x0409)
        if kind == 3 and index <= len(self._strings):
            text = self._strings[index - 1].encode("utf-16-le")
            return bytes([2 + len(text), 3]) + text
        raise Stall
