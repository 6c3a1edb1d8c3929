"""What a link gives when its other side has closed the connection."""

from __future__ import annotations

import socket

import pytest

from runtime.service import process_messages
from runtime.service.process_messages import SOLVER, FailedJob, Ping
from runtime.service.socket_link import MessageLink


@pytest.mark.parametrize("unread", [0, 1, 3])
def test_the_last_words_of_a_side_that_closed_arrive(unread: int) -> None:
    """Also where it left messages unread: the kernel then reports a reset connection first."""
    ours, theirs = (
        MessageLink(end, SOLVER) for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    )
    ours.connection.setblocking(False)
    for _ in range(unread):
        ours.send(Ping())
    theirs.send(process_messages.Pong())
    theirs.send(FailedJob(0, 4, "the bundle is broken"))
    theirs.close()
    assert ours.receive()[1] == process_messages.Pong()
    assert ours.receive()[1] == FailedJob(0, 4, "the bundle is broken")
    for _ in range(2):
        with pytest.raises(ConnectionResetError):
            ours.receive()
    ours.close()
