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
from collections.abc import Callable
from contextlib import suppress

from runtime.service.message_format import Vocabulary
from runtime.service.socket_link import MessageLink

PAUSE_S = 0.05  # before a child is started again; doubled with each death soon after its start
LONGEST_PAUSE_S = 5.0
SETTLED_S = 5.0  # a child that lived so long was started well
PR_SET_PDEATHSIG = 1
NICER = 5  # than other programs: a third of their share of that core, where they want it, too


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
    schedule : callable or None
        Called with the number of each process that was just started: `below` or `in_background`; None: it has this
        process's own priority.

    Attributes
    ----------
    link : MessageLink or None
        The supervisor's end, non-blocking; None while the process is not running.
    """

    def __init__(
        self,
        module: str,
        argument: str,
        vocabulary: Vocabulary,
        schedule: Callable[[int], None] | None = None,
    ) -> None:
        self.module, self.argument, self.vocabulary = module, argument, vocabulary
        self._schedule = schedule
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
        if self._schedule is not None:
            with suppress(OSError):  # it has ended already
                self._schedule(self._process.pid)
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


def below(pid: int) -> None:
    """Give a process that computes for long, on all cores, the next lower real-time priority than this one's.

    This process's heartbeat would wait for it otherwise. Where this one has no such priority, nothing changes.
    """
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    if policy in (os.SCHED_RR, os.SCHED_FIFO) and priority > 1:
        os.sched_setscheduler(pid, policy, os.sched_param(priority - 1))


def in_background(pid: int) -> None:
    """Leave a process one core, the last of this process's, below all that has real-time priority."""
    os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))
    os.setpriority(os.PRIO_PROCESS, pid, NICER)
    os.sched_setaffinity(pid, {max(os.sched_getaffinity(0))})


def child_link(fd: str, vocabulary: Vocabulary) -> MessageLink:
    """The child's end of the link, from its first argument. The process then dies with its supervisor."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = socket.socket(fileno=int(fd))
    os.set_inheritable(connection.fileno(), False)
    return MessageLink(connection, vocabulary)
