"""Child processes of the supervisor: started with one end of a link, started again when they die."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress

from runtime.service.link import Link
from runtime.service.messages import Vocabulary

PAUSE_S = 0.05  # before a child is started again, doubled with each death soon after its start
LONGEST_PAUSE_S = 5.0
SETTLED_S = 5.0  # alive so long, it counts as well started
PR_SET_PDEATHSIG = 1


class Child:
    """A Python module that runs as a process of its own: `python -m MODULE FD ARGUMENT`.

    link : to it, non-blocking; None while it is not running
    """

    def __init__(self, name: str, module: str, argument: str, vocabulary: Vocabulary) -> None:
        self.name, self.module, self.argument, self.vocabulary = name, module, argument, vocabulary
        self.link: Link | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._pause_s = PAUSE_S
        self._started = 0.0
        self._start_at = 0.0

    def due(self, now_s: float) -> bool:
        """Whether it is not running and it is time to start it."""
        return self.link is None and now_s >= self._start_at

    def start(self) -> Link:
        """Start the process; returns the link to it."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", self.module, str(theirs.fileno()), self.argument],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the supervisor, which darkens the lasers first
            )
        self._started = time.monotonic()
        self.link = Link(ours, self.vocabulary)
        return self.link

    def stop(self) -> None:
        """End the process at once and plan its next start."""
        if self.link is not None:
            self.link.close()
            self.link = None
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.kill()
            self._process.wait()
            self._process = None
        now = time.monotonic()
        if now - self._started > SETTLED_S:
            self._pause_s = PAUSE_S
        self._start_at = now + self._pause_s
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)


def child_link(fd: str, vocabulary: Vocabulary) -> Link:
    """The child's end, from its first argument; the process dies with its supervisor."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = socket.socket(fileno=int(fd))
    os.set_inheritable(connection.fileno(), False)
    return Link(connection, vocabulary)
