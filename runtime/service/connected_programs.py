"""The programs that are connected: who may connect, their requests and the answers."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from runtime.service import protocol
from runtime.service.camera_client import CameraClient
from runtime.service.event_loop import EventLoop
from runtime.service.frame_pipeline import FramePipeline
from runtime.service.laser_heartbeat import LaserHeartbeat
from runtime.service.message_format import ProtocolError
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, Done, Error
from runtime.service.socket_link import MessageLink

MOST_SESSIONS = 32


class ConnectedPrograms:
    """Sessions of programs.

    Parameters
    ----------
    users : frozenset of int
        Numbers of the users who may connect.
    state : callable
        Returns the state of the headset.

    Attributes
    ----------
    sessions : set of Session
    """

    def __init__(
        self,
        users: frozenset[int],
        loop: EventLoop,
        pipeline: FramePipeline,
        lasers: LaserHeartbeat,
        camera: CameraClient,
        state: Callable[[], protocol.State],
    ) -> None:
        self.sessions: set[Session] = set()
        self._users, self._loop, self._pipeline = users, loop, pipeline
        self._lasers, self._camera, self._state = lasers, camera, state

    def accept(self, listener: socket.socket) -> None:
        """Accept a program that connects, or refuse it."""
        with suppress(BlockingIOError, ConnectionError):
            connection, _ = listener.accept()
            connection.setblocking(False)
            session = Session(MessageLink(connection, protocol.PROTOCOL))
            uid = session.link.peer().uid
            if uid not in self._users:
                text = f"user {uid} may not use the headset: add it to users in [service]"
                session.send(Error(Code.REFUSED, 0, text))
                session.close()
            elif len(self.sessions) >= MOST_SESSIONS:
                session.send(Error(Code.BUSY, 0, f"{MOST_SESSIONS} programs are connected: close one"))
                session.close()
            else:
                self.sessions.add(session)
                self._loop.watch(session.link, partial(self._read, session))

    def give_frames(self, now_ns: int) -> bool:
        """Answer the programs that wait for a frame where it is time; returns whether any waited."""
        waited = [session for session in self.sessions if session.waiting is not None]
        for session in waited:
            self._pipeline.give_frame(session, now_ns)
        return bool(waited)

    def remove_closed(self) -> None:
        """Remove the sessions that have ended."""
        for session in [s for s in self.sessions if s.closed]:
            self._remove(session)

    def close(self) -> None:
        """End all sessions."""
        for session in list(self.sessions):
            self._remove(session)

    def _remove(self, session: Session) -> None:
        self.sessions.discard(session)
        self._loop.forget(session.link)
        self._pipeline.forget(session)
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
                self._pipeline.give_frame(session, time.monotonic_ns())
            case protocol.Begin(frame):
                session.begin(frame)
                session.send(Done(), serial)
            case protocol.End():
                self._pipeline.accept(session, message)
                session.send(Done(), serial)
            case protocol.Status():
                session.send(self._state(), serial)
            case protocol.Clear() | protocol.Arm() | protocol.Dark():
                self._lasers.ask(
                    type(message).__name__.lower(),
                    lambda problem: self._loop.later(partial(_answer, session, serial, problem)),
                )
            case protocol.Capture():
                self._camera.send_picture(session, serial)
            case protocol.Refine(captures):
                self._pipeline.refinement.begin(session, captures)
                session.send(Done(), serial)
            case _:
                raise RequestError(Code.MALFORMED, f"{type(message).__name__} is for programs to receive")

    def _take_ring(self, session: Session, serial: int, message: protocol.Ring, fd: int | None) -> None:
        assert self._pipeline.solver.shape is not None
        if self._pipeline.showing not in (None, session):
            if fd is not None:
                os.close(fd)
            raise RequestError(Code.BUSY, "another program has the display: close it first")
        session.take_ring(message, fd, self._pipeline.solver.shape)
        self._pipeline.take_ring(session)
        session.send(Done(), serial)

    def _welcome(self, session: Session) -> protocol.Welcome:
        assert self._pipeline.solver.shape is not None and session.version is not None
        return protocol.Welcome(
            session.version,
            *self._pipeline.solver.shape,
            self._pipeline.clock.period_ns // 1000,
            self._pipeline.stale_ns // 1000,
            protocol.MOST_SLOTS,
        )


def _answer(session: Session, serial: int, problem: str | None) -> None:
    session.send(Done() if problem is None else Error(Code.LASERS, 0, problem), serial)
