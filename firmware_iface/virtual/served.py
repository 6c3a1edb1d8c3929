"""Emulated hardware in a process of its own.

    python -m firmware_iface.virtual.served SOCKET [--bench SPEC] [--seed N]

`remote_hardware` is the way to it from other processes.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from firmware_iface.virtual.emulated_hardware import EmulatedHardware
from firmware_iface.virtual.i2c.bus_server import BoardServer
from firmware_iface.virtual.remote_hardware import LASERS

BAD_INPUT = 2  # exit code
SWITCH_S = 0.0002  # Python's 5 ms until another thread runs are long on a bus


def answer(hardware: EmulatedHardware, request: dict[str, Any], data: bytes) -> tuple[Any, bytes]:
    """Carry out one request; its answer, and bytes that follow it."""
    match request:
        case {"usb": method}:
            return _usb(hardware.board, method, request, data)
        case {"camera": "shape"}:
            camera = hardware.bench.camera
            return [camera.height, camera.width, camera.bit_depth], b""
        case {"camera": "capture", "exposure_ms": exposure_ms}:
            return None, hardware.capture(exposure_ms).tobytes()
        case {"do": "break", "part": part, "kind": kind, "count": count, "after": after}:
            at = time.monotonic()
            hardware.faults[part].arm(kind, count, after)
            return at, b""
        case {"do": "repair", "part": part}:
            hardware.faults[part].clear()
            return time.monotonic(), b""
        case {"do": "set", "name": name, "to": value}:
            at = time.monotonic()
            hardware.set_to(name, value)
            return at, b""
        case {"do": "light", "since": since}:
            return hardware.light_since(since), b""
        case {"do": "lasers"}:
            return [vars(diode) for diode in hardware.lasers.diodes], b""
        case {"do": "whole"}:
            return list(hardware.whole), b""
        case {"do": "lit"}:
            return [[*pair] for pair in list(hardware.lit)], b""
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


def _serve(hardware: EmulatedHardware, connection: Connection) -> None:
    with suppress(EOFError, OSError):
        while True:
            head, _, data = connection.recv_bytes().partition(b"\n")
            reply = b""
            try:
                result, reply = answer(hardware, json.loads(head), data)
                outcome: dict[str, Any] = {"answer": result}
            except OSError as error:
                outcome = {"error": "OSError", "with": [error.errno, error.strerror]}
            except Exception as error:  # reported to the other side; this process continues
                outcome = {"error": type(error).__name__, "with": [str(error)]}
            connection.send_bytes(json.dumps(outcome).encode() + b"\n" + reply)


def _listen(hardware: EmulatedHardware, socket: str, oak: str | None) -> Listener:
    """The socket for the panel, and next to it the one of the laser board; an OAK camera where one is wanted."""
    for path in (socket, socket + LASERS):
        with suppress(FileNotFoundError):
            os.unlink(path)
    BoardServer(hardware.lasers, Path(socket + LASERS))
    listener = Listener(socket, "AF_UNIX", backlog=16)
    if oak:
        hardware.attach_oak(oak)
    return listener


def main() -> None:
    """Serve until the parent dies or the process is ended."""
    parser = argparse.ArgumentParser(prog="python -m firmware_iface.virtual.served", description=__doc__)
    parser.add_argument("socket", help="path of the Unix socket to listen at")
    parser.add_argument("--bench", default="virtual:demo", help="virtual:NAME or a TOML file")
    parser.add_argument("--oak", metavar="ADDRESS", help="a loopback address to emulate an OAK camera at")
    parser.add_argument("--seed", type=int, default=0, help="of noise and garbage")
    args = parser.parse_args()
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # emulated hardware ends with its test
    sys.setswitchinterval(SWITCH_S)
    try:
        hardware = EmulatedHardware(args.bench, args.seed)
        listener = _listen(hardware, args.socket, args.oak)
    except InputError as error:
        parser.exit(BAD_INPUT, f"{parser.prog}: {error}\n")
    except OSError as error:
        why = error.strerror or error
        parser.exit(
            BAD_INPUT, f"{parser.prog}: {args.socket} cannot be listened at ({why}): check its folder\n"
        )
    threading.Thread(target=hardware.run, daemon=True).start()
    while True:
        connection = listener.accept()
        threading.Thread(target=_serve, args=(hardware, connection), daemon=True).start()


if __name__ == "__main__":
    main()
