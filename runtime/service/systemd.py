"""Messages to systemd and the socket from it: sd_notify(3) and sd_listen_fds(3), with the standard library alone."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

from firmware_iface.errors import InputError

FIRST_FD = 3


class Notifier:
    """Reports the service's state to systemd; does nothing where systemd did not start the service.

    Attributes
    ----------
    watchdog_s : float or None, s
        Longest time between calls of `alive`, half of what the unit allows; None without a watchdog.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        given = os.environ if environment is None else environment
        self._socket: socket.socket | None = None
        address = given.get("NOTIFY_SOCKET", "")
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s: float | None = None
        if given.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid()):
            microseconds = given.get("WATCHDOG_USEC", "")
            if microseconds.isdigit() and int(microseconds) > 0:
                self.watchdog_s = int(microseconds) * 1e-6 / 2

    def ready(self, status: str) -> None:
        """The service has started."""
        self._send(f"READY=1\nSTATUS={status}")

    def alive(self) -> None:
        """The service's loops turn."""
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The service is stopping."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:  # the service also works without systemd
            self._socket.close()
            self._socket = None


def passed_socket(environment: Mapping[str, str] | None = None) -> socket.socket | None:
    """The listening socket that systemd passed, or None.

    Raises
    ------
    InputError
        For several sockets or a socket of another type.
    """
    given = os.environ if environment is None else environment
    if given.get("LISTEN_PID") != str(os.getpid()):
        return None
    count = given.get("LISTEN_FDS", "0")
    if count != "1":
        raise InputError(f"systemd passed {count} sockets; write one ListenSequentialPacket= in the unit")
    os.set_inheritable(FIRST_FD, False)
    listener = socket.socket(fileno=FIRST_FD)
    if (listener.family, listener.type) != (socket.AF_UNIX, socket.SOCK_SEQPACKET):
        listener.detach()
        raise InputError("the socket that systemd passed is of another type: use ListenSequentialPacket=")
    return listener
