"""Emulated hardware in a process of its own, and the way to it.

    python -m firmware_iface.virtual.served SOCKET [--bench SPEC] [--seed N]

Drivers reach it as `bus = "virtual:SOCKET"`: pyusb through `usb_backend`, smbus2 at the name that `i2c_bus`
gives, the camera through `RemoteCamera`. `Remote` itself is for tests, who break parts and look at the light. A
request and its answer are each a line of JSON and then bytes.
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.virtual.hardware import Hardware
from firmware_iface.virtual.i2c.server import BoardServer
from firmware_iface.virtual.usb.device import Gone, Nak, Stall
from firmware_iface.virtual.usb.pyusb_backend import VirtualUsb

PREFIX = "virtual:"
STARTS_WITHIN_S = 20.0
LASERS = ".i2c"  # the laser board's bus has a socket of its own beside SOCKET
SWITCH_S = 0.0002  # Python's 5 ms before a thread gives way are long on a bus
USB_FAILURES = {failure.__name__: failure for failure in (Gone, Nak, Stall)}


class Remote:
    """A connection to emulated hardware; for one thread at a time, others wait.

    Raises OSError where it is not there.
    """

    def __init__(self, path: str) -> None:
        self._connection = Client(path, "AF_UNIX")
        self._lock = threading.Lock()

    def ask(self, request: Any, data: bytes = b"") -> tuple[Any, bytes]:
        """One request; its answer. Raises what the hardware raised."""
        with self._lock:
            try:
                self._connection.send_bytes(json.dumps(request).encode() + b"\n" + data)
                answer, _, reply = self._connection.recv_bytes().partition(b"\n")
            except EOFError:
                raise OSError(errno.ENODEV, "the emulated hardware is gone") from None
        result = json.loads(answer)
        if "error" in result:
            _raise(result["error"], result["with"])
        return result["answer"], reply

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    # --- for tests

    def break_part(self, part: str, kind: str, count: int | None = 1, after: int = 0) -> float:
        """Arm a fault of "panel", "lasers" or "camera"; the time, monotonic s."""
        return self.ask({"do": "break", "part": part, "kind": kind, "count": count, "after": after})[0]

    def mend(self, part: str) -> float:
        """Clear the faults of a part; the time, monotonic s."""
        return self.ask({"do": "mend", "part": part})[0]

    def set_to(self, name: str, value: Any) -> float:
        """Set what `Hardware.set_to` knows; the time, monotonic s."""
        return self.ask({"do": "set", "name": name, "to": value})[0]

    def light(self, since_s: float = 0.0) -> list[tuple[float, float]]:
        """(time s, µW of all lasers): what it was at `since_s`, and each change after it."""
        return [(at, power) for at, power in self.ask({"do": "light", "since": since_s})[0]]

    def whole(self) -> set[int]:
        """CRC-32 of every pattern that the panel has displayed."""
        return set(self.ask({"do": "whole"})[0])


def _raise(kind: str, arguments: list[Any]) -> None:
    if kind in USB_FAILURES:
        raise USB_FAILURES[kind]
    known = {"DeviceError": DeviceError, "DeviceGoneError": DeviceGoneError, "OSError": OSError}
    raise known.get(kind, RuntimeError)(*arguments)


class _RemoteModel:
    """The panel board as `VirtualUsb` sees a UsbModel."""

    def __init__(self, remote: Remote) -> None:
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
        handle.model.timeout_ms = timeout_ms  # the far end gives up by itself
        return super()._call(handle, timeout_ms, act)


class RemoteCamera:
    """The camera of emulated hardware."""

    longest_exposure_ms = 10000.0

    def __init__(self, remote: Remote) -> None:
        self._remote = remote
        self.exposure_ms = 10.0
        (height, width, self.bit_depth), _ = remote.ask({"camera": "shape"})
        self.shape = (height, width)

    def capture(self) -> NDArray[np.uint16]:
        """One picture, uint16 counts [h, w]. Raises DeviceError."""
        _, counts = self._remote.ask({"camera": "capture", "exposure_ms": self.exposure_ms})
        return np.frombuffer(counts, np.uint16).reshape(self.shape)

    def status(self) -> dict[str, Any]:
        """What the camera says of itself."""
        return {"shape": list(self.shape), "bit_depth": self.bit_depth, "exposure_ms": self.exposure_ms}

    def close(self) -> None:
        """Let go of it."""
        self._remote.close()


def reach(bus: str) -> Remote:
    """Connect to the hardware of `virtual:SOCKET`. Raises DeviceGoneError where there is none."""
    try:
        return Remote(bus.removeprefix(PREFIX))
    except OSError as error:
        raise DeviceGoneError(
            f"there is no emulated hardware at {bus} ({error.strerror}); start "
            "python -m firmware_iface.virtual.served SOCKET"
        ) from None


@contextmanager
def running(path: Path, bench: str, seed: int = 0, oak: str | None = None) -> Iterator[Remote]:
    """Emulated hardware in a process of its own, listening at `path`, while the block lasts.

    oak : a loopback address to emulate an OAK camera at. Raises DeviceGoneError where it does not start.
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


_backends: dict[str, tuple[Remote, VirtualUsb]] = {}  # opening a panel again makes no second connection


def usb_backend(bus: str) -> VirtualUsb:
    """A pyusb backend with the panel board of `virtual:SOCKET` on it. Raises DeviceGoneError."""
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
    """The same for the lasers: what firmware_iface.lasers.open_lasers takes for `virtual:SOCKET`."""
    return bus + LASERS


# --- the hardware's process


def answer(hardware: Hardware, request: dict[str, Any], data: bytes) -> tuple[Any, bytes]:
    """Do one request; the answer, and bytes with it."""
    match request:
        case {"usb": method}:
            return _usb(hardware.board, method, request, data)
        case {"camera": "shape"}:
            return [*hardware.headset.camera.shape, hardware.headset.camera.bit_depth], b""
        case {"camera": "capture", "exposure_ms": exposure_ms}:
            return None, hardware.capture(exposure_ms).tobytes()
        case {"do": "break", "part": part, "kind": kind, "count": count, "after": after}:
            at = time.monotonic()
            hardware.faults[part].arm(kind, count, after)
            return at, b""
        case {"do": "mend", "part": part}:
            hardware.faults[part].clear()
            return time.monotonic(), b""
        case {"do": "set", "name": name, "to": value}:
            at = time.monotonic()
            hardware.set_to(name, value)
            return at, b""
        case {"do": "light", "since": since}:
            return hardware.light_since(since), b""
        case {"do": "whole"}:
            return list(hardware.whole), b""
    raise InputError(f"{request!r} is no request to emulated hardware.")


def _usb(board: Any, method: str, request: dict[str, Any], data: bytes) -> tuple[Any, bytes]:
    end = time.monotonic() + request.get("ms", 0) / 1000

    def give_up() -> bool:
        return time.monotonic() >= end

    match method:
        case "descriptors":
            return [board.descriptor.hex(), board.configuration.hex()], b""
        case "present" | "generation":
            return getattr(board, method), b""
        case "control":
            asked = request["asked"]
            return None, board.control(*request["setup"], data if asked is None else asked, give_up)
        case "write":
            return board.write(request["endpoint"], data, give_up), b""
        case "read":
            return None, board.read(request["endpoint"], request["length"], give_up)
        case "reset":
            board.reset()
            return None, b""
    raise InputError(f"'{method}' is no request to a USB device.")


def _serve(hardware: Hardware, connection: Connection) -> None:
    with suppress(EOFError, OSError):
        while True:
            head, _, data = connection.recv_bytes().partition(b"\n")
            reply = b""
            try:
                result, reply = answer(hardware, json.loads(head), data)
                outcome: dict[str, Any] = {"answer": result}
            except OSError as error:
                outcome = {"error": "OSError", "with": [error.errno, error.strerror]}
            except Exception as error:  # the other side is to see it, and this one to go on
                outcome = {"error": type(error).__name__, "with": [str(error)]}
            connection.send_bytes(json.dumps(outcome).encode() + b"\n" + reply)


def main() -> None:
    """Serve until the parent dies or the process is ended."""
    parser = argparse.ArgumentParser(prog="python -m firmware_iface.virtual.served", description=__doc__)
    parser.add_argument("socket", help="path of the Unix socket to listen at")
    parser.add_argument("--bench", default="virtual:demo", help="virtual:NAME or a TOML file")
    parser.add_argument("--oak", metavar="ADDRESS", help="a loopback address to emulate an OAK camera at")
    parser.add_argument("--seed", type=int, default=0, help="of noise and garbage")
    args = parser.parse_args()
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # emulated hardware is not to outlive its test
    sys.setswitchinterval(SWITCH_S)
    hardware = Hardware(args.bench, args.seed)
    for path in (args.socket, args.socket + LASERS):
        with suppress(FileNotFoundError):
            os.unlink(path)
    BoardServer(hardware.lasers, Path(args.socket + LASERS))
    listener = Listener(args.socket, "AF_UNIX", backlog=16)
    if args.oak:
        hardware.attach_oak(args.oak)
    threading.Thread(target=hardware.run, daemon=True).start()
    while True:
        connection = listener.accept()
        threading.Thread(target=_serve, args=(hardware, connection), daemon=True).start()


if __name__ == "__main__":
    main()
