"""The supervisor's side of the solver's process: its signs of life, its ring of patterns, and messages to it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Protocol

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath.overdrive import TABLES
from runtime.service import process_messages
from runtime.service.child_processes import ChildProcess, below
from runtime.service.configuration import Configuration
from runtime.service.event_loop import EventLoop
from runtime.service.fault_log import FaultLog
from runtime.service.message_format import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.shared_memory import Ring, open_ring, read_sealed

PING_NS = 30_000_000
HUNG_NS = 1_000_000_000  # a solver that is silent so long after it counts as stale, and so dark, is ended

SolverSend = Callable[[NamedTuple, int | None], bool]  # SolverClient.send


class SolverEvents(Protocol):
    """Calls that the solver's client makes."""

    def solver_ready(self) -> None:
        """The solver can take jobs."""

    def solver_lost(self, why: str) -> None:
        """The solver's process was ended, and with it the jobs that it had."""

    def pattern_solved(self, message: process_messages.SolvedPattern, gray: np.ndarray) -> None:
        """There is a pattern, gray levels uint8 [C N, H, W], for a job."""

    def job_failed(self, job: int, code: int, text: str) -> None:
        """There is no pattern for a job."""

    def refinement_ended(self, message: process_messages.RefinementEnd) -> None:
        """A refinement has ended."""


class SolverClient:
    """The solver's process.

    Parameters
    ----------
    stale_ns : int, ns
        How long the solver may be silent.
    events : SolverEvents
        What is called when the solver has sent something or was lost.

    Attributes
    ----------
    process : ChildProcess
        The process itself.
    shape : tuple of int or None
        (C, H, W) of a picture; None until the solver was ready for the first time.
    colours : tuple of str
        Names of its colours. They stay: the lasers are budgeted for them.
    overdrive : uint8 array [C, 3, 256, 256] or None
        `overdrive_tables` of each colour, where the bundle says that the panel is slow.
    fresh_until_ns : int, ns
        Until when the solver counts as fresh (CLOCK_MONOTONIC); 0: it was lost.
    busy_until_ns : int, ns
        Display time of the frame that is being solved: the solver may be silent until then. 0: it is idle.
    """

    def __init__(
        self,
        configuration: Configuration,
        loop: EventLoop,
        faults: FaultLog,
        metrics: Metrics,
        stale_ns: int,
        events: SolverEvents,
    ) -> None:
        self.process = ChildProcess(
            "runtime.service.solver_process", str(configuration.file), process_messages.SOLVER, below
        )
        self.shape: tuple[int, int, int] | None = None
        self.colours: tuple[str, ...] = ()
        self.overdrive: np.ndarray | None = None
        self.fresh_until_ns = self.busy_until_ns = 0
        self._loop, self._faults, self._metrics = loop, faults, metrics
        self._stale_ns, self._events = stale_ns, events
        self._patterns: Ring | None = None
        self._pinged_ns = 0
        self._out = False  # it has not been ready since it was lost

    @property
    def ready(self) -> bool:
        """Whether it can take jobs."""
        return self._patterns is not None

    def turn(self, now_ns: int) -> None:
        """Start the process when it is time, ask it for signs of life, end it where it hangs."""
        if self.process.due(now_ns * 1e-9):
            self._loop.watch(self.process.start(), self._read)
        if now_ns - self._pinged_ns >= PING_NS and self.process.link is not None:
            self._pinged_ns = now_ns
            with suppress(OSError):
                self.process.link.send(process_messages.Ping())
            if self.ready and now_ns > self.fresh_until_ns + HUNG_NS:
                self._lost("it hangs")

    def send(self, message: NamedTuple, fd: int | None = None) -> bool:
        """Send the solver a message, with a descriptor or none; returns whether that was possible."""
        if self.process.link is None or not self.ready:
            return False
        try:
            self.process.link.send(message, fds=[] if fd is None else [fd])
        except OSError:  # the next read finds the reason
            return False
        return True

    def solve(self, job: process_messages.SolveJob) -> None:
        """Give the running solver a job; set `busy_until_ns` before."""
        assert self.process.link is not None
        try:
            self.process.link.send(job)
        except OSError as error:
            self._lost(f"it does not read ({error})")
        else:
            self._expect_life()

    def close(self) -> None:
        """End the process."""
        self.process.stop()

    def _read(self) -> None:
        assert self.process.link is not None
        try:
            _, message, fd = self.process.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self._lost(f"its process died ({error})")
            return
        match message:
            case process_messages.OverdriveTables(channels) if fd is not None:
                self.overdrive = read_sealed(fd, (channels, *TABLES), np.uint8)
            case process_messages.PatternRing(slots, fields, channels, height, width, colours) if (
                fd is not None
            ):
                names = tuple(colours.split(","))
                if self.colours and names != self.colours:
                    os.close(fd)
                    self._lost(
                        f"its bundle has other colours now ({colours}; start the service again for them)"
                    )
                    return
                self._patterns = open_ring(fd, slots, (fields, height, width), np.uint8)
                self.shape = self.shape or (channels, height, width)
                self.colours = names
                self._out = False
                self._events.solver_ready()
            case process_messages.FailedJob(0, _, text):
                if self.shape is None:
                    raise InputError(text)
                self._fault(text)
            case process_messages.FailedJob(job, code, text):
                self._events.job_failed(job, code, text)
            case process_messages.SolvedPattern():
                assert self._patterns is not None
                gray = self._patterns.slots[message.slot % len(self._patterns.slots)].copy()
                with suppress(OSError):
                    self.process.link.send(process_messages.FreeSlot(message.slot))
                self._events.pattern_solved(message, gray)
            case process_messages.RefinementEnd():
                self._events.refinement_ended(message)
        self._expect_life()

    def _expect_life(self) -> None:
        """It may be silent while it solves, until that frame is to be displayed."""
        self.fresh_until_ns = max(time.monotonic_ns(), self.busy_until_ns) + self._stale_ns

    def _fault(self, text: str) -> None:
        """Note that the solver is out; the same outage is counted once."""
        self._faults.note("solver", text, ongoing=self._out)
        self._out = True

    def _lost(self, why: str) -> None:
        self.fresh_until_ns = 0
        if self.process.link is not None:
            self._loop.forget(self.process.link)
        self.process.stop()
        self._metrics.restarts.labels("solver").inc()
        self._fault(f"{why} and is started again")
        self.overdrive = None
        if self._patterns is not None:
            self._patterns.close()
            self._patterns = None
        self._events.solver_lost(why)
