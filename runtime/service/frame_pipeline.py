"""Accepted frames on their way to the panel: through the solver to the display.

Every frame that is accepted here ends in one Shown or one Error to its program.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import numpy as np

from firmware_iface.configured_devices import frame_s, gated_light, laser_numbers, open_panel, panel_fields
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import GatedLight
from runtime.service import process_messages, protocol
from runtime.service.configuration import Configuration
from runtime.service.display_thread import WAKE_NS, DisplayClock, DisplayPattern, DisplayThread
from runtime.service.event_loop import EventLoop
from runtime.service.fault_log import FaultLog
from runtime.service.metrics import Metrics
from runtime.service.program_session import FrameJob, RequestError, Session
from runtime.service.protocol import Code
from runtime.service.refinement_captures import RefinementCaptures
from runtime.service.shared_memory import crc32
from runtime.service.slow_panel import slow_panel
from runtime.service.solver_client import SolverClient, SolverSend

HAND_OVER_NS = 1_000_000  # from the solver's deadline until the display has its pattern

ExpectLight = Callable[[bytes, Callable[[], None]], None]  # LaserHeartbeat.expect


class FramePipeline:
    """The frames between the programs and the panel.

    Parameters
    ----------
    expect_light : callable
        Takes the light that a pattern is predicted to make, and what to call when the lasers are ready for it.
    captures : callable
        Makes the RefinementCaptures from the function that sends a message to the solver.

    Attributes
    ----------
    solver : SolverClient
    refinement : RefinementCaptures
    display : DisplayThread
    clock : DisplayClock
    stale_ns : int, ns
        How long after its display time a pattern may be lit.
    showing : Session or None
        The session that has the display.
    shown_frames, late, failed : int
        Numbers of frames since the start.
    """

    def __init__(
        self,
        configuration: Configuration,
        loop: EventLoop,
        faults: FaultLog,
        metrics: Metrics,
        expect_light: ExpectLight,
        captures: Callable[[SolverSend], RefinementCaptures],
    ) -> None:
        timing = configuration.timing
        self._configuration, self._loop, self._expect_light = configuration, loop, expect_light
        self._faults, self._metrics = faults, metrics
        self.stale_ns = int(timing.stale_limit_ms * 1e6)
        self._solve_ns = int(timing.solve_ms * 1e6)
        self.clock = DisplayClock(int(1e9 / timing.refresh_hz))
        self.display = DisplayThread(self._open_panel, self.clock, self.stale_ns, self)
        self.solver = SolverClient(configuration, loop, faults, metrics, self.stale_ns, self)
        self.refinement = captures(self.solver.send)
        self.showing: Session | None = None
        self.shown_frames = self.late = self.failed = 0
        self._jobs: dict[int, FrameJob] = {}  # accepted and without an outcome
        self._running: FrameJob | None = None  # with the solver
        self._waiting: deque[FrameJob] = deque()  # for the solver
        self._numbers = count(1)

    def close(self) -> None:
        """End everything; programs get an Error for their accepted frames."""
        for job in list(self._jobs.values()):
            self._fail(job, Code.STOPPING, "the service stops")
        if self.display.is_alive():
            self.display.stop()
        self.solver.close()

    # -- programs --------------------------------------------------------------------------------------------

    def take_ring(self, session: Session) -> None:
        """A program that has a ring has the display."""
        self.showing = session
        self._send_targets()

    def forget(self, session: Session) -> None:
        """A program has disconnected: its frames are not shown."""
        self.refinement.forget(session)
        if self.showing is session:
            self.showing = None
            self.display.forget()
            self._waiting.clear()
            self._jobs.clear()

    def give_frame(self, session: Session, now_ns: int) -> None:
        """Answer a Wait when it is time: one period before the picture has to be submitted.

        Frames on their way are shown one at each display time. So the service catches up with late frames: the next
        frame gets a display time after all of them.
        """
        period = self.clock.period_ns
        lead = self._solve_ns + self.display.transfer_ns + WAKE_NS + HAND_OVER_NS
        free = max(self.clock.after(now_ns), self.display.taken_ns + period)  # display time
        after_others = free + len(self._jobs) * period
        busy_until = self._running.display_ns if self._running else 0
        display = self.clock.after(max(now_ns + lead, after_others, busy_until + 1, session.display_ns + 1))
        if self._waiting or now_ns < display - lead - period:
            return
        serial, session.waiting = session.waiting, None
        assert serial is not None
        frame = session.next_frame(display)
        session.send(protocol.Timing(display, display - lead, frame, period // 1000), serial)

    def accept(self, session: Session, message: protocol.End) -> None:
        """Accept a frame.

        Raises
        ------
        RequestError
            Where it cannot be accepted.
        """
        if not self.solver.ready:
            raise RequestError(Code.SOLVER, "the solver is being started again: try the next frame")
        display_ns = session.end(message)
        job = FrameJob(
            next(self._numbers) % 2**32,
            session,
            message.frame,
            message.slot,
            message.crc,
            display_ns,
            time.monotonic_ns(),
        )
        self._jobs[job.job] = job
        self._waiting.append(job)
        if self._running is None:
            self._next_job()

    def _fail(self, job: FrameJob, code: Code, text: str) -> None:
        self._jobs.pop(job.job, None)
        self.failed += 1
        self._metrics.failed.labels(code.name.lower()).inc()
        job.session.fail(job.frame, code, text)

    # -- the solver ------------------------------------------------------------------------------------------

    def solver_ready(self) -> None:
        """The solver can take jobs."""
        table = self._configuration.devices["panel"]
        passes = max(1, round(self.clock.period_ns * 1e-9 / frame_s(table)))
        self.display.slow = slow_panel(self.solver.overdrive, panel_fields(table), passes)
        self._send_targets()

    def solver_lost(self, why: str) -> None:
        """The solver was lost; its frames are lost with it."""
        for job in (self._running, *self._waiting):
            if job is not None and job.job in self._jobs:
                self._fail(job, Code.SOLVER, f"the solver had this frame: {why}")
        self._run(None)
        self._waiting.clear()
        self.refinement.lost(f"the solver had it: {why}")

    def pattern_solved(self, message: process_messages.SolvedPattern, gray: np.ndarray) -> None:
        """The solver has a pattern for a frame."""
        job = self._jobs.get(message.job)
        if job is not None and crc32(gray) != message.crc:
            self._faults.note("solver", "a pattern is not the one that it made: its CRC-32 differs")
            self._fail(job, Code.TORN, "the solver's pattern was damaged on its way")
        elif job is not None:
            pattern = DisplayPattern(
                job.job,
                job.display_ns,
                gray,
                message.crc,
                message.psnr_db,
                bool(message.flags & process_messages.FINAL),
                bool(message.flags & process_messages.DARK),
                bool(message.flags & process_messages.REFINED),
                struct.unpack_from(f"<{len(self.solver.colours)}f", message.brightness)
                if len(gray) > 1
                else (),
            )
            self._expect_light(message.shares, partial(self.display.put, pattern))
        if message.flags & process_messages.FINAL:
            self._metrics.stage_seconds.labels("solve").observe(message.solve_us * 1e-6)
            self._next_job()

    def job_failed(self, job: int, code: int, text: str) -> None:
        """The solver has no pattern for a frame."""
        if (frame_job := self._jobs.get(job)) is not None:
            self._fail(frame_job, Code(code), text)
        self._next_job()

    def refinement_ended(self, message: process_messages.RefinementEnd) -> None:
        """The solver has ended a refinement."""
        self.refinement.ended(message)

    def _send_targets(self) -> None:
        if self.showing is not None and self.showing.ring is not None:
            self.solver.send(process_messages.TargetRing(self.showing.slots), self.showing.ring.fd)

    def _run(self, job: FrameJob | None) -> None:
        """Note the job that the solver has, or None."""
        self._running = job
        self.solver.busy_until_ns = job.display_ns if job else 0

    def _next_job(self) -> None:
        self._run(None)
        if not self._waiting or self.solver.process.link is None:
            return
        job = self._waiting.popleft()
        self._run(job)
        self._metrics.stage_seconds.labels("queue").observe((time.monotonic_ns() - job.accepted_ns) * 1e-9)
        deadline = job.display_ns - self.display.transfer_ns - WAKE_NS - HAND_OVER_NS
        self.solver.solve(process_messages.SolveJob(max(deadline, 0), job.job, job.slot, job.crc))

    # -- the display; the first three are called in its thread -----------------------------------------------

    def shown(self, pattern: DisplayPattern, at_ns: int, transfer_s: float) -> None:
        """The display has shown a pattern."""
        self._loop.later(partial(self._shown, pattern, at_ns, transfer_s))

    def dropped(self, pattern: DisplayPattern, reason: str) -> None:
        """The display will not show a pattern."""
        self._loop.later(partial(self._dropped, pattern, reason))

    def panel_fault(self, error: Exception, ongoing: bool) -> None:
        """The panel failed to do something."""
        self._loop.later(partial(self._faults.note, "panel", str(error), ongoing))

    @property
    def lit_colours(self) -> frozenset[str] | None:
        """Colours that have light in the frame on the panel; None: it has one field, which is not gated."""
        lit = self.display.lit_colours
        return None if lit is None else frozenset(self.solver.colours[k] for k in lit)

    @property
    def gated(self) -> GatedLight | None:
        """The light that the panel gives each laser at most, and that the lasers are budgeted for.

        As long as the solver has not said which colours it shows, each laser counts as lit in every field.
        """
        table = self._configuration.devices["panel"]
        return gated_light(table, panel_fields(table) // max(1, len(self.solver.colours)))

    def _open_panel(self) -> Any:
        table = self._configuration.devices["panel"]
        panel = open_panel(table, self.gated)
        shape = self.solver.shape
        if shape is not None and tuple(panel.shape) != shape[1:]:
            panel.close()
            raise InputError(
                f"the panel is {panel.shape} and the bundle is for {shape[1:]}: attach the panel that it "
                "was calibrated for, or export its own bundle"
            )
        if panel_fields(table) > 1:
            self.display.lasers = laser_numbers(self._configuration.devices["lasers"], self.solver.colours)
        return panel

    def _shown(self, pattern: DisplayPattern, at_ns: int, transfer_s: float) -> None:
        self._metrics.stage_seconds.labels("transfer").observe(transfer_s)
        self.refinement.displayed(pattern)
        job = self._jobs.pop(pattern.job, None)
        if job is None:
            return
        late = at_ns > job.display_ns + self.clock.period_ns // 2
        self.shown_frames += 1
        self.late += late
        self._metrics.shown.inc()
        self._metrics.late.inc(late)
        self._metrics.stage_seconds.labels("total").observe((at_ns - job.accepted_ns) * 1e-9)
        flags = protocol.Flags.LATE * late | protocol.Flags.UNFINISHED * (not pattern.final)
        job.session.calls.settle(job.frame)
        job.session.send(protocol.Shown(at_ns, job.frame, job.slot, pattern.psnr_db, int(flags), pattern.crc))

    def _dropped(self, pattern: DisplayPattern, reason: str) -> None:
        job = self._jobs.get(pattern.job)
        if job is not None:
            self._fail(job, Code.PANEL, reason)
