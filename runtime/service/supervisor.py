"""The service's own process: programs on one side, devices and child processes on the other.

Three threads: this module's loop with all sockets; the display with the panel; lighting with the lasers.
None waits for another. The solver and the camera, whose libraries may hang or crash, are processes of their own.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from firmware_iface.assembled import laser_power, open_lasers, open_panel
from firmware_iface.errors import InputError
from runtime.service import inside, protocol
from runtime.service.children import Child
from runtime.service.configuration import Configuration
from runtime.service.display import WAKE_NS, Clock, Display, Ready
from runtime.service.lighting import Lighting
from runtime.service.link import Link
from runtime.service.messages import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.protocol import Code, Done, Error, Part
from runtime.service.ring import Ring, crc32, open_ring
from runtime.service.sessions import FrameJob, RequestError, Session
from runtime.service.systemd import Notifier, passed_socket

PING_NS = 30_000_000
HAND_OVER_NS = 1_000_000  # from the solver's deadline to the display's having its pattern
HUNG_NS = 1_000_000_000  # silent so long after it counts as stale, and so dark, the solver is ended
LOOPS_NS = 1_000_000_000  # a thread that did not turn for so long stops the watchdog's feed
MOST_SESSIONS = 32
REPEAT_S = 10.0  # the same fault is written again no sooner


class Supervisor:
    """Everything that the service is, in one process."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration, timing = configuration, configuration.timing
        self.notifier, self.metrics = Notifier(), Metrics()
        self.stale_ns = int(timing.stale_limit_ms * 1e6)
        self.solve_ns = int(timing.solve_ms * 1e6)
        self.selector = selectors.DefaultSelector()
        self.sessions: set[Session] = set()
        self.showing: Session | None = None
        self.jobs: dict[int, FrameJob] = {}  # accepted and without an outcome
        self.running: FrameJob | None = None  # with the solver
        self.waiting: deque[FrameJob] = deque()  # for it
        self.captures: dict[int, tuple[Session, int]] = {}
        self.counter = 0
        self.patterns: Ring | None = None
        self.shape: tuple[int, int, int] | None = None
        self.counts = dict.fromkeys(("shown", "late", "failed", "faults"), 0)
        self.solver_fresh_ns = self.camera_fresh_ns = 0
        self.camera_trouble = ""
        self.turned_ns = self.pinged_ns = time.monotonic_ns()
        self.alive_at = 0.0
        self.said: dict[str, tuple[str, float]] = {}
        self.stopping = False
        self.woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.events: deque[Callable[[], None]] = deque()  # from the other threads
        name = str(configuration.file)
        self.solver = Child("solver", "runtime.service.solver_process", name, inside.SOLVER)
        self.camera = Child("camera", "runtime.service.camera_process", name, inside.CAMERA)
        self.has_camera = "camera" in configuration.devices
        self.clock = Clock(int(1e9 / timing.refresh_hz))
        self.display = Display(self._open_panel, self.clock, self.stale_ns, self)
        self.lighting = Lighting(
            partial(open_lasers, configuration.devices["lasers"]),
            laser_power(configuration.devices["lasers"]),
            self._fresh_until,
            lambda: self.display.lit_until_ns,
            lambda kind, text: self.later(partial(self.fault, kind, text)),
        )

    # -- running ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until SIGTERM or SIGINT. Raises InputError where the configuration cannot be served."""
        listener = passed_socket() or _listening(self.configuration)
        if self.configuration.timing.metrics_port:
            self.metrics.serve(self.configuration.timing.metrics_port)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self.later(self._stop))
        self.selector.register(self.woken, selectors.EVENT_READ, self._wake)
        self.lighting.start()
        try:
            self._start(self.solver, self._from_solver)
            if self.has_camera:
                self._start(self.camera, self._from_camera)
            while self.shape is None and not self.stopping:
                self._turn()
            self.display.start()
            listener.setblocking(False)
            self.selector.register(listener, selectors.EVENT_READ, partial(self._accept, listener))
            self.notifier.ready("serving; lasers dark until cleared and armed")
            while not self.stopping:
                self._turn()
        finally:
            self._end(listener)

    def later(self, do: Callable[[], None]) -> None:
        """Have something done by the loop; from any thread and from signal handlers."""
        self.events.append(do)
        with suppress(BlockingIOError):
            os.eventfd_write(self.woken, 1)

    def _turn(self) -> None:
        now = self.turned_ns = time.monotonic_ns()
        for child, read in ((self.solver, self._from_solver), (self.camera, self._from_camera)):
            if child.link is None and child.start_at and now * 1e-9 >= child.start_at:
                self._start(child, read)
        if now - self.pinged_ns >= PING_NS:
            self.pinged_ns = now
            if self.solver.link is not None:
                with suppress(OSError):
                    self.solver.link.send(inside.Ping())
            self._check_solver(now)
            self.metrics.lasers(self.lighting.state)
        for session in [s for s in self.sessions if s.waiting is not None]:
            self._give_frame(session, now)
        if (
            self.notifier.watchdog_s is not None
            and now * 1e-9 >= self.alive_at + self.notifier.watchdog_s / 2
        ):
            loops = (self.lighting, self.display)
            if self.display.is_alive() and all(now - loop.turned_ns < LOOPS_NS for loop in loops):
                self.notifier.alive()
            self.alive_at = now * 1e-9
        for key, _ in self.selector.select(0.001 if self._has_waits() else 0.01):
            key.data()
        for session in [s for s in self.sessions if s.closed]:
            self._leave(session)

    def _has_waits(self) -> bool:
        return any(s.waiting is not None for s in self.sessions)

    def _wake(self) -> None:
        os.eventfd_read(self.woken)
        while self.events:
            self.events.popleft()()

    def _stop(self) -> None:
        self.stopping = True

    def _end(self, listener: socket.socket) -> None:
        """Dark first, then everything else."""
        self.lighting.stop()
        self.notifier.stopping()
        for job in list(self.jobs.values()):
            self._fail(job, Code.STOPPING, "the service stops")
        for session in list(self.sessions):
            self._leave(session)
        if self.display.is_alive():
            self.display.stop()
        for child in (self.solver, self.camera):
            child.stop()
        listener.close()
        self.selector.close()

    def fault(self, kind: str, text: str) -> None:
        """Count a fault, and write it unless it was just written."""
        self.counts["faults"] += 1
        self.metrics.faults.labels(kind).inc()
        before, at = self.said.get(kind, ("", 0.0))
        now = time.monotonic()
        if text != before or now - at > REPEAT_S:
            self.said[kind] = (text, now)
            print(f"{kind}: {text}", file=sys.stderr, flush=True)

    def _fresh_until(self) -> dict[str, int]:
        """Until when each loop counts as fresh; called by the lighting thread."""
        fresh = {
            "the service": self.turned_ns + self.stale_ns,
            "panel": self.display.answered_ns + self.stale_ns,
            "solver": self.solver_fresh_ns,
        }
        if self.has_camera:
            fresh["camera"] = self.camera_fresh_ns
        return fresh

    # -- panel -----------------------------------------------------------------------------------------------

    def _open_panel(self) -> Any:
        panel = open_panel(self.configuration.devices["panel"])
        if self.shape is not None and tuple(panel.shape) != self.shape[1:]:
            panel.close()
            raise InputError(f"the panel is {panel.shape} and the bundle's light path {self.shape[1:]}")
        return panel

    def shown(self, pattern: Ready, at_ns: int, transfer_s: float) -> None:
        """The display has shown a pattern."""
        self.later(partial(self._shown, pattern, at_ns, transfer_s))

    def dropped(self, pattern: Ready, reason: str) -> None:
        """The display will not show a pattern."""
        self.later(partial(self._dropped, pattern, reason))

    def panel_fault(self, error: Exception) -> None:
        """The panel did not do something."""
        self.later(partial(self.fault, "panel", str(error)))

    def _shown(self, pattern: Ready, at_ns: int, transfer_s: float) -> None:
        self.metrics.stage_seconds.labels("transfer").observe(transfer_s)
        job = self.jobs.pop(pattern.job, None)
        if job is None:
            return
        late = at_ns > job.display_ns + self.clock.period_ns // 2
        self.counts["shown"] += 1
        self.counts["late"] += late
        self.metrics.shown.inc()
        self.metrics.late.inc(late)
        self.metrics.stage_seconds.labels("total").observe((at_ns - job.accepted_ns) * 1e-9)
        flags = protocol.Flags.LATE * late | protocol.Flags.UNFINISHED * (not pattern.final)
        job.session.calls.settle(job.frame)
        job.session.send(protocol.Shown(at_ns, job.frame, job.slot, pattern.psnr_db, int(flags), pattern.crc))

    def _dropped(self, pattern: Ready, reason: str) -> None:
        job = self.jobs.get(pattern.job)
        if job is not None:
            self._fail(job, Code.PANEL, reason)

    def _fail(self, job: FrameJob, code: Code, text: str) -> None:
        self.jobs.pop(job.job, None)
        self.counts["failed"] += 1
        self.metrics.failed.labels(code.name.lower()).inc()
        if not job.session.closed:
            job.session.fail(job.frame, code, text)

    # -- child processes -------------------------------------------------------------------------------------

    def _start(self, child: Child, read: Callable[[], None]) -> None:
        link = child.start()
        self.selector.register(link, selectors.EVENT_READ, read)

    def _gone(self, child: Child, why: str) -> None:
        if child.link is not None:
            self.selector.unregister(child.link)
        child.stop()
        self.metrics.restarts.labels(child.name).inc()
        self.fault(child.name, f"{why}; it is started again")

    def _check_solver(self, now: int) -> None:
        """A job long past its deadline, or no sign of life, is a hung solver: end it."""
        if (
            self.solver.link is not None
            and self.patterns is not None
            and now > self.solver_fresh_ns + HUNG_NS
        ):
            self._solver_gone("the solver hangs")

    def _solver_gone(self, why: str) -> None:
        self.solver_fresh_ns = 0
        self._gone(self.solver, why)
        if self.patterns is not None:
            self.patterns.close()
            self.patterns = None
        for job in (self.running, *self.waiting):
            if job is not None and job.job in self.jobs:
                self._fail(job, Code.SOLVER, why)
        self.running = None
        self.waiting.clear()

    def _from_solver(self) -> None:
        assert self.solver.link is not None
        try:
            _, message, fd = self.solver.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self._solver_gone(f"the solver died ({error})")
            return
        match message:
            case inside.Patterns(slots, channels, height, width) if fd is not None:
                self._solver_ready(slots, (channels, height, width), fd)
            case inside.Unsolved(0, _, text):  # it cannot work at all
                if self.shape is None:
                    raise InputError(text)
                self.fault("solver", text)
            case inside.Unsolved(number, code, text):
                if (job := self.jobs.get(number)) is not None:
                    self._fail(job, Code(code), text)
                self._next_job()
            case inside.Solved():
                self._solved(message)
        running = self.running.display_ns if self.running else 0
        self.solver_fresh_ns = max(time.monotonic_ns(), running) + self.stale_ns

    def _solver_ready(self, slots: int, shape: tuple[int, int, int], fd: int) -> None:
        self.patterns = open_ring(fd, slots, shape, np.uint8)
        if self.shape is None:
            self.shape = shape
        if self.showing is not None and self.showing.ring is not None:
            self._send_targets(self.showing)

    def _send_targets(self, session: Session) -> None:
        if self.solver.link is not None and self.patterns is not None and session.ring is not None:
            with suppress(OSError):
                self.solver.link.send(inside.Targets(session.slots), fds=[session.ring.fd])

    def _solved(self, message: inside.Solved) -> None:
        assert self.patterns is not None and self.solver.link is not None
        gray = self.patterns.slots[message.slot % len(self.patterns.slots)].copy()
        with suppress(OSError):
            self.solver.link.send(inside.Free(message.slot))
        job = self.jobs.get(message.job)
        if job is not None:
            if crc32(gray) != message.crc:
                self.fault("solver", "a pattern is not the one that the solver made: its CRC-32 differs")
                self._fail(job, Code.TORN, "the solver's pattern was damaged on its way")
            else:
                self.display.put(
                    Ready(job.job, job.display_ns, gray, message.crc, message.psnr_db, bool(message.final))
                )
        if message.final:
            self.metrics.stage_seconds.labels("solve").observe(message.solve_us * 1e-6)
            self._next_job()

    def _next_job(self) -> None:
        self.running = None
        if self.waiting:
            self._solve(self.waiting.popleft())

    def _solve(self, job: FrameJob) -> None:
        assert self.solver.link is not None
        self.running = job
        job.solving_ns = now = time.monotonic_ns()
        self.metrics.stage_seconds.labels("queue").observe((now - job.accepted_ns) * 1e-9)
        deadline = job.display_ns - self.display.transfer_ns - WAKE_NS - HAND_OVER_NS
        self.solver_fresh_ns = max(now, job.display_ns) + self.stale_ns
        try:
            self.solver.link.send(inside.Job(max(deadline, 0), job.job, job.slot, job.crc))
        except OSError as error:
            self._solver_gone(f"the solver does not read ({error})")

    def _from_camera(self) -> None:
        assert self.camera.link is not None
        try:
            serial, message, fd = self.camera.link.receive()
        except BlockingIOError:
            return
        except (OSError, ProtocolError) as error:
            self.camera_fresh_ns = 0
            self._gone(self.camera, f"the camera's process died ({error})")
            self._fail_captures("the camera's process died: ask again")
            return
        if isinstance(message, inside.Missing):
            self.camera_fresh_ns = 0
            self.fault("camera", message.text)
            self._fail_captures(message.text)
        elif isinstance(message, inside.Seen):
            self.camera_fresh_ns = time.monotonic_ns() + self.stale_ns + message.exposure_us * 1000
            session, asked = self.captures.pop(serial, (None, 0))
            if session is not None and fd is not None:
                session.send(protocol.Picture(*message), asked, fd)
        if fd is not None:
            os.close(fd)

    def _fail_captures(self, why: str) -> None:
        for session, asked in self.captures.values():
            session.send(Error(Code.CAMERA, 0, why), asked)
        self.captures.clear()

    # -- programs --------------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        with suppress(BlockingIOError, ConnectionError):
            connection, _ = listener.accept()
            connection.setblocking(False)
            session = Session(Link(connection, protocol.PROTOCOL))
            uid = session.link.peer().uid
            if uid not in self.configuration.users:
                text = f"user {uid} may not use the headset: add it to users in [service]"
                session.send(Error(Code.REFUSED, 0, text))
                session.close()
            elif len(self.sessions) >= MOST_SESSIONS:
                session.send(Error(Code.BUSY, 0, f"{MOST_SESSIONS} programs are connected: close one"))
                session.close()
            else:
                self.sessions.add(session)
                self.selector.register(
                    session.link, selectors.EVENT_READ, partial(self._from_program, session)
                )

    def _leave(self, session: Session) -> None:
        self.sessions.discard(session)
        with suppress(KeyError, ValueError):
            self.selector.unregister(session.link)
        if self.showing is session:
            self.showing = None
            self.display.forget()
            self.waiting.clear()
        self.jobs = {number: job for number, job in self.jobs.items() if job.session is not session}
        self.captures = {n: asked for n, asked in self.captures.items() if asked[0] is not session}
        session.close()

    def _from_program(self, session: Session) -> None:
        if session.closed:
            return
        try:
            serial, message, fd = session.link.receive()
        except BlockingIOError:
            return
        except ProtocolError as error:
            session.send(Error(Code.MALFORMED, 0, str(error)))
            session.closed = True
            return
        except OSError:
            session.closed = True
            return
        try:
            if serial == 0 or (session.version is None and not isinstance(message, protocol.Hello)):
                raise RequestError(Code.MALFORMED, "a request has a serial above 0, and the first is Hello")
            if isinstance(message, protocol.Ring):
                fd, ring_fd = None, fd
                self._take_ring(session, message, ring_fd)
                session.send(Done(), serial)
            else:
                self._request(session, serial, message)
        except RequestError as error:
            session.send(Error(error.code, 0, error.text), serial)
            session.closed = session.closed or session.version is None
        finally:
            if fd is not None:
                os.close(fd)

    def _request(self, session: Session, serial: int, message: Any) -> None:
        match message:
            case protocol.Hello():
                session.hello(message)
                session.send(self._welcome(session), serial)
            case protocol.Wait():
                with session.in_order():
                    if session.waiting is not None:
                        raise RequestError(Code.ORDER, "a Wait is not answered yet")
                    session.calls.check_wait()
                session.waiting = serial
                self._give_frame(session, time.monotonic_ns())
            case protocol.Begin(frame):
                with session.in_order():
                    session.calls.begin(frame)
                session.send(Done(), serial)
            case protocol.End():
                self._accept_frame(session, serial, message)
            case protocol.Status():
                session.send(self.state(), serial)
            case protocol.Clear() | protocol.Arm() | protocol.Dark():
                self.lighting.ask(
                    type(message).__name__.lower(),
                    lambda wrong: self.later(partial(_answer, session, serial, wrong)),
                )
            case protocol.Capture():
                self._ask_camera(session, serial)
            case _:
                raise RequestError(Code.MALFORMED, f"{type(message).__name__} is for programs to receive")

    def _take_ring(self, session: Session, message: protocol.Ring, fd: int | None) -> None:
        assert self.shape is not None
        if self.showing is not None and self.showing is not session:
            if fd is not None:
                os.close(fd)
            raise RequestError(Code.BUSY, "another program has the display: close it first")
        session.take_ring(message, fd, self.shape)
        self.showing = session
        self._send_targets(session)

    def _welcome(self, session: Session) -> protocol.Welcome:
        assert self.shape is not None and session.version is not None
        return protocol.Welcome(
            session.version,
            *self.shape,
            self.clock.period_ns // 1000,
            self.stale_ns // 1000,
            protocol.MOST_SLOTS,
        )

    def _give_frame(self, session: Session, now: int) -> None:
        """Answer a Wait when it is time: one period before the picture has to be there.

        Frames on their way are shown one a display time, so what is late catches up: the next gets a time
        after all of them.
        """
        period = self.clock.period_ns
        lead = self.solve_ns + self.display.transfer_ns + WAKE_NS + HAND_OVER_NS
        after_others = self.clock.after(now - min(HAND_OVER_NS, period // 4)) + len(self.jobs) * period
        busy_until = self.running.display_ns if self.running else 0
        display = self.clock.after(max(now + lead, after_others, busy_until + 1, session.display_ns + 1))
        if self.waiting or now < display - lead - period:
            return
        serial, session.waiting = session.waiting, None
        assert serial is not None
        session.display_ns = display
        frame = session.calls.wait()
        session.displays = {f: at for f, at in session.displays.items() if f >= frame - 1} | {frame: display}
        session.send(protocol.Timing(display, display - lead, frame, period // 1000), serial)

    def _accept_frame(self, session: Session, serial: int, message: protocol.End) -> None:
        with session.in_order():
            session.check_slot(message.slot)
            if self.patterns is None:
                raise RequestError(Code.SOLVER, "the solver is being started again: try the next frame")
            session.calls.end(message.frame, message.slot)
        session.send(Done(), serial)
        self.counter = self.counter % (2**32 - 1) + 1
        job = FrameJob(
            self.counter,
            session,
            message.frame,
            message.slot,
            message.crc,
            session.displays[message.frame],
            time.monotonic_ns(),
        )
        self.jobs[job.job] = job
        self.waiting.append(job)
        if self.running is None:
            self._next_job()

    def _ask_camera(self, session: Session, serial: int) -> None:
        if not self.has_camera:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if self.camera.link is None:
            raise RequestError(Code.CAMERA, "the camera's process is being started again: ask again")
        self.counter = self.counter % (2**32 - 1) + 1
        try:
            self.camera.link.send(inside.Take(), self.counter)
        except OSError as error:
            raise RequestError(Code.CAMERA, f"the camera's process does not read ({error})") from None
        self.captures[self.counter] = (session, serial)

    def state(self) -> protocol.State:
        """How the headset is."""
        now, fresh = time.monotonic_ns(), self._fresh_until()

        def part(name: str, there: bool) -> Part:
            if not there:
                return Part.LOST
            return Part.FRESH if fresh[name] >= now else Part.STALE

        return protocol.State(
            now,
            self.counts["shown"],
            self.counts["late"],
            self.counts["failed"],
            self.lighting.state,
            self.lighting.faults,
            part("panel", self.display.open),
            part("solver", self.solver.link is not None),
            part("camera", self.camera_fresh_ns > 0) if self.has_camera else Part.ABSENT,
            self.counts["faults"],
        )


def _answer(session: Session, serial: int, wrong: str | None) -> None:
    if not session.closed:
        session.send(Done() if wrong is None else Error(Code.LASERS, 0, wrong), serial)


def _listening(configuration: Configuration) -> socket.socket:
    """A listening socket at the configured path. Raises InputError where another service has it."""
    path = str(configuration.socket)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            try:
                probe.connect(path)
                raise InputError(f"another service listens at {path}: stop it, or give another socket")
            except ConnectionRefusedError:  # one that was killed left it
                os.unlink(path)
            except FileNotFoundError:
                pass
        listener.bind(path)
        os.chmod(path, 0o660)
        listener.listen(MOST_SESSIONS)
    except OSError as error:
        listener.close()
        raise InputError(
            f"{path} cannot be listened at ({error.strerror or error}): check its folder"
        ) from None
    except InputError:
        listener.close()
        raise
    return listener
