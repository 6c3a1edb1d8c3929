"""The service's own process: programs on one side, devices and child processes on the other.

Three threads: the loop with all sockets; the display with the panel; lighting with the lasers. None waits for
another. The solver and the camera, whose libraries may hang or crash, are processes of their own.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial
from typing import Any

from firmware_iface.configured_devices import laser_power, open_lasers
from firmware_iface.errors import InputError
from runtime.service import protocol
from runtime.service.camera_client import Eye
from runtime.service.configuration import Configuration
from runtime.service.event_loop import Loop
from runtime.service.faults import Faults
from runtime.service.lighting import Lighting
from runtime.service.link import Link
from runtime.service.messages import ProtocolError
from runtime.service.metrics import Metrics
from runtime.service.pipeline import Pipeline
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, Done, Error, Lasers, Part
from runtime.service.systemd import Notifier, passed_socket
from runtime.service.watching import Tell, Watching

MOST_SESSIONS = 32
TURN_S, TURN_WAITED_S = 0.010, 0.001  # of the loop; the shorter while a program waits for a frame
SWITCH_S = 0.0005  # Python's 5 ms before a thread gives way would make a frame late
LOOPS_NS = 1_000_000_000  # a thread that did not turn for so long stops the watchdog's feed


class Supervisor:
    """Everything that the service is, in one process."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self.notifier, self.metrics, self.loop = Notifier(), Metrics(), Loop()
        self.faults = Faults(self.metrics)
        self.eye = Eye(configuration, self.loop, self.faults, self.metrics)
        self.lighting = Lighting(
            partial(open_lasers, configuration.devices["lasers"]),
            laser_power(configuration.devices["lasers"]),
            self._fresh_until,
            lambda: self.pipeline.display.lit_until_ns,
            lambda kind, text: self.loop.later(partial(self.faults.note, kind, text)),
        )
        self.pipeline = Pipeline(
            configuration, self.loop, self.faults, self.metrics, self.lighting.expect, self._watching
        )
        self.sessions: set[Session] = set()
        self.turned_ns = time.monotonic_ns()
        self.fed_ns = 0
        self.told: Lasers | None = None
        self.stopping = False

    def run(self) -> None:
        """Serve until SIGTERM or SIGINT. Raises InputError where the configuration cannot be served."""
        listener = passed_socket() or _listening(self.configuration)
        if self.configuration.timing.metrics_port:
            self.metrics.serve(self.configuration.timing.metrics_port)
        sys.setswitchinterval(SWITCH_S)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self.loop.later(self._stop))
        self.lighting.start()
        try:
            while self.pipeline.shape is None and not self.stopping:
                self._turn()
            self.pipeline.display.start()
            listener.setblocking(False)
            self.loop.watch(listener, partial(self._accept, listener))
            self.notifier.ready("serving; the lasers are dark until a program clears and arms them")
            while not self.stopping:
                self._turn()
        finally:
            self._end(listener)

    @property
    def counts(self) -> dict[str, int]:
        """Frames shown, late and failed, and faults, since the start."""
        p = self.pipeline
        return {"shown": p.shown_frames, "late": p.late, "failed": p.failed, "faults": self.faults.count}

    def _turn(self) -> None:
        now = self.turned_ns = time.monotonic_ns()
        self.pipeline.turn(now)
        self.eye.turn(now * 1e-9)
        self.pipeline.watching.turn()
        waited = [session for session in self.sessions if session.waiting is not None]
        for session in waited:
            self.pipeline.give_frame(session, now)
        self._feed_watchdog(now)
        self._publish()
        self.loop.turn(TURN_WAITED_S if waited else TURN_S)
        for session in [s for s in self.sessions if s.closed]:
            self._leave(session)

    def _feed_watchdog(self, now: int) -> None:
        """Tell systemd that all threads turn. A device that is missing is no reason to start again."""
        every = self.notifier.watchdog_s
        loops = (self.lighting, self.pipeline.display)
        if every is None or now < self.fed_ns + every * 5e8 or not self.pipeline.display.is_alive():
            return
        self.fed_ns = now
        if all(now - loop.turned_ns < LOOPS_NS for loop in loops):
            self.notifier.alive()

    def _publish(self) -> None:
        """The lasers' state and power, for metrics."""
        if self.lighting.state != self.told:
            self.told = self.lighting.state
            self.metrics.lasers(self.told)
        for channel, power in self.lighting.level.items():
            self.metrics.laser_power.labels(channel).set(power)

    def _stop(self) -> None:
        self.stopping = True

    def _end(self, listener: socket.socket) -> None:
        """Dark first, then everything else."""
        self.lighting.stop()
        self.notifier.stopping()
        self.pipeline.close()
        for session in list(self.sessions):
            self._leave(session)
        self.eye.close()
        listener.close()
        self.loop.close()

    def _watching(self, tell: Tell) -> Watching:
        return Watching(self.eye, tell, lambda: self.lighting.state)

    def _fresh_until(self) -> dict[str, int]:
        """Until when each loop that light depends on counts as fresh; called in the lighting thread."""
        stale_ns = self.pipeline.stale_ns
        fresh = {
            "the service": self.turned_ns + stale_ns,
            "panel": self.pipeline.display.answered_ns + stale_ns,
            "solver": self.pipeline.fresh_until_ns,
        }
        if self.eye.there:
            fresh["camera"] = self.eye.fresh_until_ns
        return fresh

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
                self.loop.watch(session.link, partial(self._read, session))

    def _leave(self, session: Session) -> None:
        self.sessions.discard(session)
        self.loop.forget(session.link)
        self.pipeline.forget(session)
        session.close()

    def _read(self, session: Session) -> None:
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
                self._take_ring(session, serial, message, ring_fd)
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
                session.wait(serial)
                self.pipeline.give_frame(session, time.monotonic_ns())
            case protocol.Begin(frame):
                session.begin(frame)
                session.send(Done(), serial)
            case protocol.End():
                self.pipeline.accept(session, message)
                session.send(Done(), serial)
            case protocol.Status():
                session.send(self.state(), serial)
            case protocol.Clear() | protocol.Arm() | protocol.Dark():
                self.lighting.ask(
                    type(message).__name__.lower(),
                    lambda wrong: self.loop.later(partial(_answer, session, serial, wrong)),
                )
            case protocol.Capture():
                self.eye.capture(session, serial)
            case protocol.Refine(captures):
                self.pipeline.watching.begin(session, captures)
                session.send(Done(), serial)
            case _:
                raise RequestError(Code.MALFORMED, f"{type(message).__name__} is for programs to receive")

    def _take_ring(self, session: Session, serial: int, message: protocol.Ring, fd: int | None) -> None:
        assert self.pipeline.shape is not None
        if self.pipeline.showing not in (None, session):
            if fd is not None:
                os.close(fd)
            raise RequestError(Code.BUSY, "another program has the display: close it first")
        session.take_ring(message, fd, self.pipeline.shape)
        self.pipeline.take_ring(session)
        session.send(Done(), serial)

    def _welcome(self, session: Session) -> protocol.Welcome:
        assert self.pipeline.shape is not None and session.version is not None
        return protocol.Welcome(
            session.version,
            *self.pipeline.shape,
            self.pipeline.clock.period_ns // 1000,
            self.pipeline.stale_ns // 1000,
            protocol.MOST_SLOTS,
        )

    def state(self) -> protocol.State:
        """How the headset is."""
        now, fresh, counts = time.monotonic_ns(), self._fresh_until(), self.counts

        def part(name: str, there: bool) -> Part:
            if not there:
                return Part.LOST
            return Part.FRESH if fresh[name] >= now else Part.STALE

        return protocol.State(
            now,
            counts["shown"],
            counts["late"],
            counts["failed"],
            self.lighting.state,
            self.lighting.faults,
            part("panel", self.pipeline.display.open),
            part("solver", self.pipeline.fresh_until_ns > 0),
            part("camera", self.eye.fresh_until_ns > 0) if self.eye.there else Part.ABSENT,
            counts["faults"],
        )


def _answer(session: Session, serial: int, wrong: str | None) -> None:
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
