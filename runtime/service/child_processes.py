"""Child processes of the supervisor: started with one end of a link, and started again when they die."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress

from runtime.service.message_format import Vocabulary
from runtime.service.socket_link import MessageLink

PAUSE_S = 0.05  # before a child is started again; doubled with each death soon after its start
LONGEST_PAUSE_S = 5.0
SETTLED_S = 5.0  # a child that lived so long was started well
PR_SET_PDEATHSIG = 1


class ChildProcess:
    """A Python module that runs as a process of its own: `python -m MODULE FD ARGUMENT`.

    Parameters
    ----------
    module : str
        Module to run, with its packages.
    argument : str
        What the module gets after the descriptor of its end of the link.
    vocabulary : Vocabulary
        Messages that may pass over the link.
    yields : bool
        Whether it computes for long, on all cores: it is then scheduled below this process, whose heartbeat would wait
        for it otherwise.

    Attributes
    ----------
    link : MessageLink or None
        The supervisor's end, non-blocking; None while the process is not running.
    """

    def __init__(self, module: str, argument: str, vocabulary: Vocabulary, yields: bool = False) -> None:
        self.module, self.argument, self.vocabulary = module, argument, vocabulary
        self._yields = yields
        self.link: MessageLink | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._end: threading.Thread | None = None  # of the process before
        self._pause_s = PAUSE_S
        self._started_s = 0.0
        self._next_start_s = 0.0

    def due(self, now_s: float) -> bool:
        """Whether it is not running, the one before has ended, and it is time to start it."""
        ended = self._end is None or not self._end.is_alive()
        return self.link is None and ended and now_s >= self._next_start_s

    def start(self) -> MessageLink:
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
        if self._yields:
            _schedule_below(self._process.pid)
        self._started_s = time.monotonic()
        self.link = MessageLink(ours, self.vocabulary)
        return self.link

    def stop(self) -> None:
        """Kill the process and plan its next start. This does not wait until it has ended: a driver may hold it."""
        if self.link is not None:
            self.link.close()
            self.link = None
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.kill()
            self._end = threading.Thread(target=_wait_for, args=(self._process,), daemon=True)
            self._end.start()
            self._process = None
        now = time.monotonic()
        if now - self._started_s > SETTLED_S:
            self._pause_s = PAUSE_S
        self._next_start_s = now + self._pause_s
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)


def _wait_for(process: subprocess.Popen[bytes]) -> None:
    """Wait until a process has ended, in a thread without real-time priority.

    The kernel takes an ended process apart in the thread that waits for it, and spins there while another program looks
    at the process in /proc. With real-time priority it can keep that program from the core, and so spin for minutes.
    """
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    process.wait()


def _schedule_below(pid: int) -> None:
    """Give a process that was just started the next lower real-time priority, where this one has one."""
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    if policy in (os.SCHED_RR, os.SCHED_FIFO) and priority > 1:
        with suppress(OSError):  # it has ended already
            os.sched_setscheduler(pid, policy, os.sched_param(priority - 1))


def child_link(fd: str, vocabulary: Vocabulary) -> MessageLink:
    """The child's end of the link, from its first argument. The process then dies with its supervisor."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = socket.socket(fileno=int(fd))
    os.set_inheritable(connection.fileno(), False)
    return MessageLink(connection, vocabulary)
