"""One end of a SOCK_SEQPACKET connection on which the messages of one vocabulary pass."""

from __future__ import annotations

import array
import os
import socket
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from runtime.service.message_format import LARGEST, ProtocolError, Vocabulary

MOST_FDS = 4  # room for more than any message has, so that surplus descriptors are received and closed


class PeerCredentials(NamedTuple):
    """Process and user at the other end, as the kernel reports them."""

    pid: int
    uid: int
    gid: int


class MessageLink:
    """Sends and receives whole messages, each with at most one file descriptor.

    On a socket that does not block, sending never waits for the other side: a peer that lets its buffer fill
    up causes BlockingIOError, and the caller treats it as disconnected.
    """

    def __init__(self, connection: socket.socket, vocabulary: Vocabulary) -> None:
        self.connection, self.vocabulary = connection, vocabulary

    def fileno(self) -> int:
        """For selectors."""
        return self.connection.fileno()

    def send(self, message: NamedTuple, serial: int = 0, fds: Sequence[int] = ()) -> None:
        """Send one message.

        Raises
        ------
        OSError
            Where the other side has disconnected or does not read.
        """
        data = self.vocabulary.pack(message, serial)
        if fds:
            socket.send_fds(self.connection, [data], list(fds))
        else:
            self.connection.send(data)

    def receive(self) -> tuple[int, Any, int | None]:
        """Receive one message.

        Returns
        -------
        serial : int
        message : NamedTuple
        fd : int or None
            The descriptor that came with the message; the caller closes it.

        Raises
        ------
        ProtocolError
            For bytes that are not a message.
        ConnectionResetError
            At the end of the connection.
        BlockingIOError
            On a socket that does not block, where there is nothing yet.
        """
        try:
            data, control, flags, _ = self._next_packet()
        except ConnectionResetError:
            # The other side closed without reading all that it was sent. The kernel says so once, before it gives what
            # that side had sent, which may be why it ended.
            data, control, flags, _ = self._next_packet()
        fds = array.array("i")
        for level, kind, payload in control:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                fds.frombytes(payload[: len(payload) - len(payload) % fds.itemsize])
        try:
            if not data:
                raise ConnectionResetError("the other side closed the connection")
            if flags & (socket.MSG_TRUNC | socket.MSG_CTRUNC):
                raise ProtocolError(f"a message has more than {LARGEST} bytes or {MOST_FDS} descriptors")
            if len(fds) > 1:
                raise ProtocolError(f"{len(fds)} descriptors came with one message; one is the most")
            serial, message = self.vocabulary.unpack(data)
        except (ProtocolError, ConnectionResetError):
            for fd in fds:
                os.close(fd)
            raise
        return serial, message, fds[0] if fds else None

    def _next_packet(self) -> tuple[bytes, list[tuple[int, int, bytes]], int, object]:
        """What `recvmsg` returns, with room for any message and its descriptors."""
        room = socket.CMSG_SPACE(MOST_FDS * 4)
        return self.connection.recvmsg(LARGEST, room, socket.MSG_CMSG_CLOEXEC)

    def peer(self) -> PeerCredentials:
        """The credentials of the other side at the time it connected."""
        size = struct.calcsize("3i")
        return PeerCredentials(
            *struct.unpack("3i", self.connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))
        )

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()
