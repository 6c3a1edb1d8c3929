"""An emulated bus for other processes, over a Unix socket: each transfer is one packet there and one back."""

from __future__ import annotations

import errno
import json
import socket
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from firmware_iface.virtual.i2c.bus import Message, failure
from firmware_iface.virtual.i2c.laser_board import LaserBoard
from firmware_iface.virtual.i2c.smbus2_ioctls import attach

TICK_S = 0.002
PACKET = 65536


class BoardServer:
    """Serves a board's bus and lets the board's time run; `close` ends both.

    Parameters
    ----------
    board : LaserBoard
    path : Path
        Of the socket, which is created.
    """

    def __init__(self, board: LaserBoard, path: Path) -> None:
        self.board, self.path = board, path
        self._ended = threading.Event()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(8)
        for run in (self._accept, self._tick):
            threading.Thread(target=run, daemon=True).start()

    def close(self) -> None:
        """Stop serving; transfers that come later fail as on a board without power."""
        self._ended.set()
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            self.board.settle()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, suppress(ConnectionError):  # the process at the other end may be killed
            while packet := connection.recv(PACKET):
                try:
                    if self._ended.is_set():
                        raise failure(errno.ENXIO)
                    messages = [
                        Message(a, None if data is None else bytes.fromhex(data), n)
                        for a, data, n in json.loads(packet)
                    ]
                    answer: object = [reply.hex() for reply in self.board.bus.transfer(messages)]
                except OSError as error:
                    answer = error.errno
                try:
                    connection.send(json.dumps(answer).encode())
                except OSError:  # the process that asked has died meanwhile
                    return


class RemoteBus:
    """The bus of a board that another process serves; connected again at the next transfer where that was lost."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None

    def transfer(self, messages: Sequence[Message]) -> list[bytes]:
        """Carry messages, as `I2cBus.transfer`.

        Raises
        ------
        OSError
            As from an adapter.
        """
        asked = [(m.address, None if m.data is None else m.data.hex(), m.length) for m in messages]
        with self._lock:
            answer = self._ask(json.dumps(asked).encode())
        if isinstance(answer, int):
            raise failure(answer)
        return [bytes.fromhex(reply) for reply in answer]

    def reach(self) -> None:
        """Connect, unless it is connected.

        Raises
        ------
        OSError
            Where nobody serves the bus.
        """
        if self._socket is None:
            opened = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                opened.connect(self._path)
            except OSError:
                opened.close()
                raise
            self._socket = opened

    def _ask(self, packet: bytes) -> Any:
        try:
            self.reach()
            assert self._socket is not None
            self._socket.send(packet)
            reply = self._socket.recv(PACKET)
        except OSError:
            reply = b""
        if not reply:
            if self._socket is not None:
                self._socket.close()
                self._socket = None
            return errno.ENODEV
        return json.loads(reply)


_nodes: dict[str, tuple[RemoteBus, str]] = {}  # by socket: opening a bus again makes no second connection


def connect(path: str) -> str:
    """A node for smbus2.SMBus, with the bus that is served at `path` behind it.

    Raises
    ------
    OSError
        Where nobody serves the bus.
    """
    if path not in _nodes:
        bus = RemoteBus(path)
        bus.reach()
        _nodes[path] = bus, attach(bus)
    bus, node = _nodes[path]
    bus.reach()
    return node
