"""The device's end of an XLink over TCP: named streams in both directions with credit for what may be sent.

Layout as the depthai 3.12 library speaks it; it belongs to that version, not to a published standard.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Queue

DISCOVERY_PORT, LINK_PORT = 11491, 11490
BOOTED = 1

_HEADER = struct.Struct("<ii52sIIIIII")  # id, type, stream name, time (3 words), stream id, size, flags
WRITE, READ_RELEASE, CREATE, CLOSE, PING, RESET, READ_RELEASE_PART = 0, 2, 3, 4, 5, 6, 24
_ANSWER = 8  # a request's type and this is its answer's
_ACKNOWLEDGED = 1
_WINDOW = 5 * 1024 * 1024  # bytes that may be under way to the host on one stream
_LONGEST = 64 * 1024 * 1024


class LinkDown(ConnectionError):
    """The host has ended the link, or it was dropped."""


class Link:
    """One host's connection.

    Parameters
    ----------
    connection : socket.socket
        The accepted socket.
    on_stream : callable
        Called with (this link, name, stream id) for each stream that the host opens.
    """

    def __init__(self, connection: socket.socket, on_stream: Callable[[Link, str, int], None]) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.alive = True
        self._socket = connection
        self._on_stream = on_stream
        self._names: dict[int, bytes] = {}
        self._received: dict[int, Queue[bytes | None]] = {}
        self._credit: dict[int, int] = {}
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._last_id = 0

    def run(self) -> None:
        """Serve the host until it ends the link."""
        with suppress(OSError):
            while self._serve_one():
                pass
        self.drop()

    def drop(self) -> None:
        """Cut the link."""
        with self._changed:
            self.alive = False
            self._changed.notify_all()
        for received in list(self._received.values()):
            received.put(None)
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def receive(self, stream: int) -> bytes:
        """The next message of a stream; raises LinkDown."""
        data = self._received[stream].get()
        if data is None:
            raise LinkDown
        return data

    def send(self, stream: int, data: bytes) -> None:
        """Send one message, waiting for credit; raises LinkDown."""
        with self._changed:
            self._changed.wait_for(lambda: not self.alive or self._credit[stream] >= len(data))
            if not self.alive:
                raise LinkDown
            self._credit[stream] -= len(data)
        self._request(WRITE, self._names[stream], stream, len(data), data)

    def _serve_one(self) -> bool:
        number, kind, name, _, _, _, stream, size, _ = _HEADER.unpack(self._exactly(_HEADER.size))
        name = name.split(b"\0")[0]
        if kind == WRITE:
            if size > _LONGEST or stream not in self._received:
                return False
            data = self._exactly(size)
            self._answer(number, kind, name, stream, size)
            self._request(READ_RELEASE, name, stream, size)  # taken at once, so the host may send more
            self._received[stream].put(data)
        elif kind == CREATE:
            self._names[stream], self._received[stream] = name, Queue()
            self._credit[stream] = _WINDOW
            self._answer(number, kind, name, stream, size)
            self._request(CREATE, name, stream, _WINDOW, flags=_ACKNOWLEDGED)  # our direction of it
            self._on_stream(self, name.decode(errors="replace"), stream)
        elif kind in (READ_RELEASE, READ_RELEASE_PART):
            with self._changed:
                self._credit[stream] = self._credit.get(stream, 0) + size
                self._changed.notify_all()
            answer = kind + (_ANSWER if kind == READ_RELEASE else 2)
            self._packet(number, answer, name, stream, size, _ACKNOWLEDGED)
        elif kind in (PING, CLOSE, RESET):
            self._answer(number, kind, name, stream, 0)
            return kind != RESET
        return True

    def _answer(self, number: int, kind: int, name: bytes, stream: int, size: int) -> None:
        self._packet(number, kind + _ANSWER, name, stream, size, _ACKNOWLEDGED)

    def _request(
        self, kind: int, name: bytes, stream: int, size: int, data: bytes = b"", flags: int = 0
    ) -> None:
        with self._changed:
            self._last_id += 1
            number = self._last_id
        self._packet(number, kind, name, stream, size, flags, data)

    def _packet(
        self, number: int, kind: int, name: bytes, stream: int, size: int, flags: int, data: bytes = b""
    ) -> None:
        second, nanosecond = divmod(time.monotonic_ns(), 10**9)
        words = nanosecond, second & 0xFFFFFFFF, second >> 32
        with self._sending:
            self._socket.sendall(_HEADER.pack(number, kind, name, *words, stream, size, flags) + data)

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            part = self._socket.recv(size - len(data))
            if not part:
                raise LinkDown
            data += part
        return bytes(data)


def listen(address: str) -> tuple[socket.socket, socket.socket]:
    """Sockets for discovery (UDP) and links (TCP), on this loopback address alone."""
    discovery = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    links = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    for opened, port in ((discovery, DISCOVERY_PORT), (links, LINK_PORT)):
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((address, port))
    links.listen(4)
    return discovery, links


def discovery_answer(question: bytes, serial: str) -> bytes | None:
    """The answer of a booted device to a discovery datagram; None where the question is none."""
    if len(question) < 4 or question[:4] != struct.pack("<I", 1):
        return None
    return struct.pack("<I32sI", 1, serial.encode(), BOOTED)
