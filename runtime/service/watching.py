"""The supervisor's side of a refinement: whose it is, and pictures of what is displayed and lit for the solver."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np

from runtime.service import inside, protocol
from runtime.service.camera_client import Eye
from runtime.service.display import Ready
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, Lasers
from runtime.service.ring import read_sealed

DARK = (Lasers.OFF, Lasers.ARMED, Lasers.FAULT)  # surely without light; ARMED emits nothing yet
Tell = Callable[[NamedTuple, int | None], bool]


class Watching:
    """tell : sends the solver a message with a descriptor, and says whether it could. lasers : how they are now."""

    def __init__(self, eye: Eye, tell: Tell, lasers: Callable[[], Lasers]) -> None:
        self._eye, self._tell, self._lasers = eye, tell, lasers
        self._black: float | None = None  # counts without light, from a picture before there was any
        self._session: Session | None = None  # whose refinement goes on
        self._number = 0  # of it: the end of an earlier one may come late
        self._displayed = 0  # CRC-32 of the pattern that was put on the panel last
        self._looking = False

    def begin(self, session: Session, captures: int) -> None:
        """Refine for a program that has the display, or end it with 0 captures. Raises RequestError."""
        if session.ring is None:
            raise RequestError(Code.ORDER, "send Ring before Refine: what is displayed is refined")
        if captures and not self._eye.there:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if captures and self._session is not None:
            raise RequestError(Code.BUSY, "a refinement goes on: wait for Refined, or ask for 0 captures")
        if captures and self._black is None:
            text = "the camera has not seen darkness yet: ask for Dark, then arm and ask again"
            raise RequestError(Code.CAMERA, text)
        number = self._number + bool(captures)
        if not self._tell(inside.Refine(number, captures, self._black or 0.0), None):
            raise RequestError(Code.SOLVER, "the solver is being started again: ask again")
        if captures:
            self._session, self._number = session, number

    def turn(self) -> None:
        """Have one picture taken in the dark."""
        if self._black is None and self._eye.fresh_until_ns and not self._looking and self._lasers() in DARK:
            with suppress(RequestError):
                self._eye.look(self._darkness)
                self._looking = True

    def displayed(self, pattern: Ready) -> None:
        """A pattern is on the panel. The second time in turn a picture that begins now sees it alone."""
        again, self._displayed = pattern.crc == self._displayed, pattern.crc
        if pattern.refined and again and self._session is not None and not self._looking and self._lit:
            with suppress(RequestError):  # no camera now: the next time
                self._eye.look(partial(self._seen, pattern.crc))
                self._looking = True

    def ended(self, message: inside.Refined) -> None:
        """A refinement has ended."""
        if message.number == self._number and self._session is not None:
            self._session.send(protocol.Refined(*message[1:]))
            self._session = None

    def lost(self, why: str) -> None:
        """The solver has gone, and what it refined with it."""
        self.ended(inside.Refined(self._number, 0, 0.0, 0.0, why))

    def forget(self, session: Session) -> None:
        """A program has gone."""
        if self._session is session:
            self._session = None
            self._tell(inside.Refine(self._number, 0, 0.0), None)

    @property
    def _lit(self) -> bool:
        return self._lasers() == Lasers.EMITTING

    def _darkness(self, seen: inside.Seen | None, fd: int | None, why: str) -> None:
        self._looking = False
        if seen is not None and fd is not None and self._lasers() in DARK:
            counts = read_sealed(os.dup(fd), (seen.height, seen.width), np.uint16)
            self._black = float(counts.mean())

    def _seen(self, crc: int, seen: inside.Seen | None, fd: int | None, why: str) -> None:
        self._looking = False
        if seen is not None and fd is not None and crc == self._displayed and self._lit:
            self._tell(inside.Look(crc, seen.height, seen.width), fd)
