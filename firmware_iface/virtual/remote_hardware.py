"""The way to emulated hardware that runs in another process (`python -m firmware_iface.virtual.served SOCKET`).

Drivers reach it as `bus = "virtual:SOCKET"`: pyusb through `usb_backend`, smbus2 at the name that `i2c_bus`
gives, the camera through `RemoteCamera`. `RemoteHardware` itself is for tests: they arm faults and read the light.
A request and its answer are each a line of JSON followed by bytes.
"""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Client
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError
from firmware_iface.virtual.usb.pyusb_backend import VirtualUsb
from firmware_iface.virtual.usb.usb_model import Nak, NoDevice, Stall

PREFIX = "virtual:"
STARTS_WITHIN_S = 20.0
LASERS = ".i2c"  # the laser board's bus has a socket of its own next to SOCKET
USB_FAILURES = {failure.__name__: failure for failure in (NoDevice, Nak, Stall)}


class RemoteHardware:
    """A connection to emulated hardware; for one thread at a time, others wait.

    Parameters
    ----------
    path : str
        Of its Unix socket.

    Raises
    ------
    OSError
        Where there is none.
    """

    def __init__(self, path: str) -> None:
        self._connection = Client(path, "AF_UNIX")
        self._lock = threading.Lock()

    def ask(self, request: Any, data: bytes = b"") -> tuple[Any, bytes]:
        """Send one request and return its answer; raises the exception that the hardware raised."""
        with self._lock:
            try:
                self._connection.send_bytes(json.dumps(request).encode() + b"\n" + data)
                answer, _, reply = self._connection.recv_bytes().partition(b"\n")
            except EOFError:
                raise OSError(errno.ENODEV, "the emulated hardware has ended") from None
        result = json.loads(answer)
        if "error" in result:
            _raise(result["error"], result["with"])
        return result["answer"], reply

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def built_in_lasers(self) -> list[dict[str, Any]]:
        """The laser of each output of the board, with the keys of `laser_board.Diode`."""
        return list(self.ask({"do": "lasers"})[0])

    # --- for tests

    def break_part(self, part: str, kind: str, count: int | None = 1, after: int = 0) -> float:
        """Arm a fault of "panel", "panel link", "lasers" or "camera"; the time, monotonic s."""
        return self.ask({"do": "break", "part": part, "kind": kind, "count": count, "after": after})[0]

    def repair(self, part: str) -> float:
        """Clear the faults of a part; the time, monotonic s."""
        return self.ask({"do": "repair", "part": part})[0]

    def set_to(self, name: str, value: Any) -> float:
        """Set what `EmulatedHardware.set_to` knows; the time, monotonic s."""
        return self.ask({"do": "set", "name": name, "to": value})[0]

    def light(self, since_s: float = 0.0) -> list[tuple[float, float]]:
        """(time s, µW of all lasers): the light at `since_s`, and each change after it."""
        return [(at, power) for at, power in self.ask({"do": "light", "since": since_s})[0]]

    def whole(self) -> set[int]:
        """CRC-32 of every pattern that the panel has displayed."""
        return set(self.ask({"do": "whole"})[0])

    def lit(self) -> set[tuple[int, int]]:
        """CRC-32 of what was truly on the panel, and the mask of the lasers that it let shine on it, of every field."""
        return {(crc, outputs) for crc, outputs in self.ask({"do": "lit"})[0]}


def _raise(kind: str, arguments: list[Any]) -> None:
    if kind in USB_FAILURES:
        raise USB_FAILURES[kind]
    known = {"DeviceError": DeviceError, "DeviceGoneError": DeviceGoneError, "OSError": OSError}
    raise known.get(kind, RuntimeError)(*arguments)


class _RemoteModel:
    """The panel board, with the interface of UsbModel."""

    def __init__(self, remote: RemoteHardware) -> None:
        self._remote = remote
        self.timeout_ms = 0
        (first, second), _ = remote.ask({"usb": "descriptors"})
        self.descriptor, self.configuration = bytes.fromhex(first), bytes.fromhex(second)

    @property
    def present(self) -> bool:
        return bool(self._remote.ask({"usb": "present"})[0])

    @property
    def generation(self) -> int:
        return int(self._remote.ask({"usb": "generation"})[0])

    def control(
        self, kind: int, request: int, value: int, index: int, data: bytes | int, give_up: object
    ) -> bytes:
        asked = data if isinstance(data, int) else None
        return self._remote.ask(
            {"usb": "control", "setup": [kind, request, value, index], "asked": asked, "ms": self.timeout_ms},
            b"" if isinstance(data, int) else data,
        )[1]

    def write(self, endpoint: int, data: bytes, give_up: object) -> int:
        return int(self._remote.ask({"usb": "write", "endpoint": endpoint, "ms": self.timeout_ms}, data)[0])

    def read(self, endpoint: int, length: int, give_up: object) -> bytes:
        request = {"usb": "read", "endpoint": endpoint, "length": length, "ms": self.timeout_ms}
        return self._remote.ask(request)[1]

    def reset(self) -> None:
        self._remote.ask({"usb": "reset"})


class _RemoteUsb(VirtualUsb):
    def _call(self, handle: Any, timeout_ms: int, act: Any) -> Any:
        handle.model.timeout_ms = timeout_ms  # the other process observes the time limit
        return super()._call(handle, timeout_ms, act)


class RemoteCamera:
    """The camera of emulated hardware."""

    longest_exposure_ms = 10000.0

    def __init__(self, remote: RemoteHardware) -> None:
        self._remote = remote
        self.exposure_ms = 10.0
        (height, width, self.bit_depth), _ = remote.ask({"camera": "shape"})
        self.shape = (height, width)

    def capture(self) -> NDArray[np.uint16]:
        """One picture.

        Returns
        -------
        uint16 array [h, w], counts

        Raises
        ------
        DeviceError
            Where a fault is armed.
        """
        _, counts = self._remote.ask({"camera": "capture", "exposure_ms": self.exposure_ms})
        return np.frombuffer(counts, np.uint16).reshape(self.shape)

    def status(self) -> dict[str, Any]:
        """Shape and settings, ready for JSON."""
        return {"shape": list(self.shape), "bit_depth": self.bit_depth, "exposure_ms": self.exposure_ms}

    def close(self) -> None:
        """End the connection."""
        self._remote.close()


def reach(bus: str) -> RemoteHardware:
    """Connect to the hardware of `virtual:SOCKET`.

    Raises
    ------
    DeviceGoneError
        Where there is none.
    """
    try:
        return RemoteHardware(bus.removeprefix(PREFIX))
    except OSError as error:
        raise DeviceGoneError(
            f"there is no emulated hardware at {bus} ({error.strerror}); start "
            "python -m firmware_iface.virtual.served SOCKET"
        ) from None


@contextmanager
def running(path: Path, bench: str, seed: int = 0, oak: str | None = None) -> Iterator[RemoteHardware]:
    """Emulated hardware in a process of its own, listening at `path`, while the block lasts.

    Parameters
    ----------
    path : Path
        Of the Unix socket.
    bench : str
        `virtual:NAME` or a TOML file.
    seed : int
        Of noise and garbage.
    oak : str or None
        A loopback address at which an OAK camera is emulated.

    Raises
    ------
    DeviceGoneError
        Where it does not start.
    """
    command = [
        sys.executable,
        "-m",
        "firmware_iface.virtual.served",
        str(path),
        "--bench",
        bench,
        "--seed",
        str(seed),
    ]
    process = subprocess.Popen([*command, "--oak", oak] if oak else command)
    try:
        until = time.monotonic() + STARTS_WITHIN_S
        while True:
            try:
                remote = reach(str(path))
                break
            except DeviceGoneError:
                if time.monotonic() > until or process.poll() is not None:
                    raise
                time.sleep(0.02)
        yield remote
        remote.close()
    finally:
        process.kill()
        process.wait()


_backends: dict[
    str, tuple[RemoteHardware, VirtualUsb]
] = {}  # opening a panel again makes no second connection


def usb_backend(bus: str) -> VirtualUsb:
    """A pyusb backend with the panel board of `virtual:SOCKET` on it.

    Raises
    ------
    DeviceGoneError
        Where there is none.
    """
    known = _backends.get(bus)
    if known is not None:
        try:
            known[0].ask({"usb": "present"})
            return known[1]
        except OSError:  # its process has ended; there may be another
            known[0].close()
    remote = reach(bus)
    model: Any = _RemoteModel(remote)
    _backends[bus] = remote, _RemoteUsb(model)
    return _backends[bus][1]


def i2c_bus(bus: str) -> str:
    """The name of the lasers' bus for `virtual:SOCKET`, as firmware_iface.lasers.open_lasers takes it."""
    return bus + LASERS
