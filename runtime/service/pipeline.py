"""From an accepted frame to light: the solver's process, the patterns that it makes, the display.

Every frame that is accepted here ends in one Shown or one Error to its program.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from firmware_iface.configured_devices import open_panel
from firmware_iface.errors import InputError
from runtime.service import inside, protocol
from runtime.service.children import Child
from runtime.service.configuration import Configuration
from runtime.service.display import WAKE_NS, Clock, Display, Ready
from runtime.service.event_loop import Loop
from runtime.service.faults import Faults
from runtime.service.messages import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.program_session import FrameJob, RequestError, Session
from runtime.service.protocol import Code
from runtime.service.ring import Ring, crc32, open_ring
from runtime.service.watching import Tell, Watching

PING_NS = 30_000_000
HAND_OVER_NS = 1_000_000  # from the solver's deadline to the display's having its pattern
HUNG_NS = 1_000_000_000  # silent so long after it counts as stale, and so dark, the solver is ended

Expect = Callable[[bytes, Callable[[], None]], None]


class Pipeline:
    """Frames on their way.

    expect : told what light a pattern is predicted to make, and what to do when the lasers are ready for it
    watching : makes what follows refinements, from a way to tell the solver something

    Attributes: shape ((C, H, W), or None until the solver is ready), showing (the session that has the display),
    display, clock, shown, late and failed (numbers of frames), fresh_until_ns (of the solver)
    """

    def __init__(
        self,
        configuration: Configuration,
        loop: Loop,
        faults: Faults,
        metrics: Metrics,
        expect: Expect,
        watching: Callable[[Tell], Watching],
    ) -> None:
        timing = configuration.timing
        self._configuration, self._loop, self._expect = configuration, loop, expect
        self._faults, self._metrics = faults, metrics
        self.stale_ns = int(timing.stale_limit_ms * 1e6)
        self._solve_ns = int(timing.solve_ms * 1e6)
        self.clock = Clock(int(1e9 / timing.refresh_hz))
        self.display = Display(self._open_panel, self.clock, self.stale_ns, self)
        self.solver = Child(
            "solver", "runtime.service.solver_process", str(configuration.file), inside.SOLVER
        )
        self.watching = watching(self._tell_solver)
        self.shape: tuple[int, int, int] | None = None
        self.showing: Session | None = None
        self.shown_frames = self.late = self.failed = 0
        self.fresh_until_ns = 0
        self._patterns: Ring | None = None
        self._jobs: dict[int, FrameJob] = {}  # accepted and without an outcome
        self._running: FrameJob | None = None  # with the solver
        self._waiting: deque[FrameJob] = deque()  # for it
        self._numbers = count(1)
        self._pinged_ns = 0

    def turn(self, now_ns: int) -> None:
        """Start the solver when it is time, ask it for signs of life, end it where it hangs."""
        if self.solver.due(now_ns * 1e-9):
            self._loop.watch(self.solver.start(), self._read)
        if now_ns - self._pinged_ns >= PING_NS and self.solver.link is not None:
            self._pinged_ns = now_ns
            with suppress(OSError):
                self.solver.link.send(inside.Ping())
            if self._patterns is not None and now_ns > self.fresh_until_ns + HUNG_NS:
                self._solver_gone("it hangs")

    def close(self) -> None:
        """End everything; accepted frames are told of it."""
        for job in list(self._jobs.values()):
            self._fail(job, Code.STOPPING, "the service stops")
        if self.display.is_alive():
            self.display.stop()
        self.solver.stop()

    # -- programs --------------------------------------------------------------------------------------------

    def take_ring(self, session: Session) -> None:
        """A program that has a ring has the display."""
        self.showing = session
        self._send_targets()

    def forget(self, session: Session) -> None:
        """A program has gone: what it wanted is not shown."""
        self.watching.forget(session)
        if self.showing is session:
            self.showing = None
            self.display.forget()
            self._waiting.clear()
            self._jobs.clear()

    def give_frame(self, session: Session, now_ns: int) -> None:
        """Answer a Wait when it is time: one period before the picture has to be there.

        Frames on their way are shown one a display time, so what is late catches up: the next gets a time
        after all of them.
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
        """Take a frame. Raises RequestError where it cannot be."""
        if self._patterns is None:
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

    def _read(self) -> None:
        assert self.solver.link is not None
        try:
            _, message, fd = self.solver.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self._solver_gone(f"its process died ({error})")
            return
        match message:
            case inside.Patterns(slots, channels, height, width) if fd is not None:
                self._patterns = open_ring(fd, slots, (channels, height, width), np.uint8)
                self.shape = self.shape or (channels, height, width)
                self._send_targets()
            case inside.Unsolved(0, _, text):  # it cannot work at all
                if self.shape is None:
                    raise InputError(text)
                self._faults.note("solver", text)
            case inside.Unsolved(number, code, text):
                if (job := self._jobs.get(number)) is not None:
                    self._fail(job, Code(code), text)
                self._next_job()
            case inside.Solved():
                self._solved(message)
            case inside.Refined():
                self.watching.ended(message)
        self._expect_life()

    def _expect_life(self) -> None:
        """It may be silent while it solves, until that frame is to be seen."""
        busy_until = self._running.display_ns if self._running else 0
        self.fresh_until_ns = max(time.monotonic_ns(), busy_until) + self.stale_ns

    def _solver_gone(self, why: str) -> None:
        self.fresh_until_ns = 0
        if self.solver.link is not None:
            self._loop.forget(self.solver.link)
        self.solver.stop()
        self._metrics.restarts.labels("solver").inc()
        self._faults.note("solver", f"{why} and is started again")
        if self._patterns is not None:
            self._patterns.close()
            self._patterns = None
        for job in (self._running, *self._waiting):
            if job is not None and job.job in self._jobs:
                self._fail(job, Code.SOLVER, f"the solver had this frame: {why}")
        self._running = None
        self._waiting.clear()
        self.watching.lost(f"the solver had it: {why}")

    def _tell_solver(self, message: NamedTuple, fd: int | None) -> bool:
        if self.solver.link is None or self._patterns is None:
            return False
        try:
            self.solver.link.send(message, fds=[] if fd is None else [fd])
        except OSError:  # which reading from it will find
            return False
        return True

    def _send_targets(self) -> None:
        session = self.showing
        if session is None or session.ring is None or self.solver.link is None or self._patterns is None:
            return
        with suppress(OSError):
            self.solver.link.send(inside.Targets(session.slots), fds=[session.ring.fd])

    def _next_job(self) -> None:
        self._running = None
        if not self._waiting or self.solver.link is None:
            return
        job = self._running = self._waiting.popleft()
        self._metrics.stage_seconds.labels("queue").observe((time.monotonic_ns() - job.accepted_ns) * 1e-9)
        deadline = job.display_ns - self.display.transfer_ns - WAKE_NS - HAND_OVER_NS
        try:
            self.solver.link.send(inside.Job(max(deadline, 0), job.job, job.slot, job.crc))
        except OSError as error:
            self._solver_gone(f"it does not read ({error})")
        else:
            self._expect_life()

    def _solved(self, message: inside.Solved) -> None:
        assert self._patterns is not None and self.solver.link is not None
        gray = self._patterns.slots[message.slot % len(self._patterns.slots)].copy()
        with suppress(OSError):
            self.solver.link.send(inside.Free(message.slot))
        job = self._jobs.get(message.job)
        if job is not None and crc32(gray) != message.crc:
            self._faults.note("solver", "a pattern is not the one that it made: its CRC-32 differs")
            self._fail(job, Code.TORN, "the solver's pattern was damaged on its way")
        elif job is not None:
            pattern = Ready(
                job.job,
                job.display_ns,
                gray,
                message.crc,
                message.psnr_db,
                bool(message.flags & inside.FINAL),
                bool(message.flags & inside.DARK),
                bool(message.flags & inside.REFINED),
            )
            self._expect(message.shares, partial(self.display.put, pattern))
        if message.flags & inside.FINAL:
            self._metrics.stage_seconds.labels("solve").observe(message.solve_us * 1e-6)
            self._next_job()

    # -- the display; the first three are called in its thread -----------------------------------------------

    def shown(self, pattern: Ready, at_ns: int, transfer_s: float) -> None:
        """The display has shown a pattern."""
        self._loop.later(partial(self._shown, pattern, at_ns, transfer_s))

    def dropped(self, pattern: Ready, reason: str) -> None:
        """The display will not show a pattern."""
        self._loop.later(partial(self._dropped, pattern, reason))

    def panel_fault(self, error: Exception) -> None:
        """The panel did not do something."""
        self._loop.later(partial(self._faults.note, "panel", str(error)))

    def _open_panel(self) -> Any:
        panel = open_panel(self._configuration.devices["panel"])
        if self.shape is not None and tuple(panel.shape) != self.shape[1:]:
            panel.close()
            raise InputError(
                f"the panel is {panel.shape} and the bundle is for {self.shape[1:]}: attach the panel that it "
                "was calibrated for, or export its own bundle"
            )
        return panel

    def _shown(self, pattern: Ready, at_ns: int, transfer_s: float) -> None:
        self._metrics.stage_seconds.labels("transfer").observe(transfer_s)
        self.watching.displayed(pattern)
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

    def _dropped(self, pattern: Ready, reason: str) -> None:
        job = self._jobs.get(pattern.job)
        if job is not None:
            self._fail(job, Code.PANEL, reason)
