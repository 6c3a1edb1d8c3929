"""The emulated camera's link, byte by byte over a socket pair: streams, credit, and hosts that send nonsense."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.virtual.oak.xlink import Link, LinkDown, discovery_answer

HEADER = struct.Struct("<ii52sIIIIII")
WRITE, READ_RELEASE, CREATE, PING, RESET = 0, 2, 3, 5, 6
ANSWER = 8


def packet(number: int, kind: int, name: bytes, stream: int, size: int, data: bytes = b"") -> bytes:
    return HEADER.pack(number, kind, name, 0, 0, 0, stream, size, 0) + data


class Host:
    """The other end, which writes down what the device sends: (kind, name, stream, size, data)."""

    def __init__(self) -> None:
        self.end, device = socket.socketpair()
        self.end.settimeout(5)
        self.opened: list[tuple[str, int]] = []
        without: Any = _NoOptions(device)
        self.link = Link(without, lambda link, name, stream: self.opened.append((name, stream)))
        self.thread = threading.Thread(target=self.link.run, daemon=True)
        self.thread.start()

    def exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.end.recv(size - len(data))
            assert part, "the device ended the link"
            data += part
        return data

    def next(self) -> tuple[int, str, int, int, bytes]:
        _, kind, name, _, _, _, stream, size, _ = HEADER.unpack(self.exactly(HEADER.size))
        data = self.exactly(size) if kind == WRITE else b""
        return kind, name.rstrip(b"\0").decode(), stream, size, data


@pytest.fixture
def host() -> Iterator[Host]:
    opened = Host()
    yield opened
    opened.link.drop()
    opened.end.close()


def test_a_stream_is_opened_in_both_directions_and_messages_are_answered_and_released(host: Host) -> None:
    host.end.sendall(packet(1, CREATE, b"__rpc_main", 7, 1000))
    assert host.next() == (CREATE + ANSWER, "__rpc_main", 7, 1000, b"")
    assert host.next() == (CREATE, "__rpc_main", 7, 5 * 1024 * 1024, b"")
    host.end.sendall(packet(2, WRITE, b"__rpc_main", 7, 5, b"hello"))
    assert host.next() == (WRITE + ANSWER, "__rpc_main", 7, 5, b"")
    assert host.next() == (READ_RELEASE, "__rpc_main", 7, 5, b"")
    assert host.link.receive(7) == b"hello" and host.opened == [("__rpc_main", 7)]
    host.link.send(7, b"answer")
    assert host.next() == (WRITE, "__rpc_main", 7, 6, b"answer")
    host.end.sendall(packet(3, PING, b"", 0, 0))
    assert host.next()[0] == PING + ANSWER


def test_the_device_sends_no_more_than_the_host_has_room_for(host: Host) -> None:
    host.end.sendall(packet(1, CREATE, b"frames", 1, 0))
    assert [host.next()[0] for _ in range(2)] == [CREATE + ANSWER, CREATE]
    big = bytes(3 * 1024 * 1024)
    sender = threading.Thread(target=lambda: [host.link.send(1, big) for _ in range(2)], daemon=True)
    sender.start()
    assert host.next()[3] == len(big)
    sender.join(0.1)
    assert sender.is_alive(), "the second message waits for credit"
    host.end.sendall(packet(2, READ_RELEASE, b"frames", 1, len(big)))
    kinds = sorted(host.next()[0] for _ in range(2))
    assert kinds == [WRITE, READ_RELEASE + ANSWER]
    sender.join(5)
    assert not sender.is_alive()


def test_a_dropped_link_wakes_everybody(host: Host) -> None:
    host.end.sendall(packet(1, CREATE, b"s", 1, 0))
    host.next(), host.next()
    raised = []

    def reader() -> None:
        with pytest.raises(LinkDown):
            host.link.receive(1)
        raised.append(True)

    thread = threading.Thread(target=reader, daemon=True)
    thread.start()
    host.end.close()
    thread.join(5)
    assert raised
    with pytest.raises(LinkDown):
        host.link.send(1, b"x")


@given(
    st.lists(st.tuples(st.integers(0, 30), st.integers(0, 3), st.integers(0, 200), st.binary(max_size=60)))
)
@settings(max_examples=40)
def test_a_host_that_sends_nonsense_ends_its_link_and_nothing_else(packets: list) -> None:
    host = Host()
    with suppress(OSError):  # it may end the link before all is sent
        for kind, stream, size, data in packets:
            host.end.sendall(packet(1, kind, b"s", stream, size, data))
    host.end.close()
    host.thread.join(5)
    assert not host.thread.is_alive() and not host.link.alive


class _NoOptions:
    """A socket pair's end, to which TCP's options mean nothing."""

    def __init__(self, inner: socket.socket) -> None:
        self._inner = inner

    def setsockopt(self, *arguments: object) -> None:
        pass

    def __getattr__(self, name: str) -> object:
        return getattr(self._inner, name)


def test_discovery_answers_one_question_only() -> None:
    assert discovery_answer(struct.pack("<I", 1), "SERIAL") == struct.pack("<I32sI", 1, b"SERIAL", 1)
    for other in (b"", b"\x01", struct.pack("<I", 2)):
        assert discovery_answer(other, "SERIAL") is None
