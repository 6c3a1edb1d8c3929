"""The supervisor's side of a refinement: its program, and captures of the displayed and lit picture for the solver."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np

from runtime.service import process_messages, protocol
from runtime.service.camera_client import CameraClient
from runtime.service.display_thread import DisplayPattern
from runtime.service.process_messages import CameraPicture
from runtime.service.program_session import RequestError, Session
from runtime.service.protocol import Code, LaserState
from runtime.service.shared_memory import read_sealed
from runtime.service.solver_client import SolverSend

DARK = (
    LaserState.OFF,
    LaserState.ARMED,
    LaserState.FAULT,
)  # certainly without light: ARMED does not emit yet


class RefinementCaptures:
    """Takes the captures of a refinement and sends them to the solver.

    Parameters
    ----------
    camera : CameraClient
    send : SolverSend
        Sends the solver a message with a descriptor, and returns whether that was possible.
    laser_state : callable
        Returns the present state of the lasers.
    """

    def __init__(self, camera: CameraClient, send: SolverSend, laser_state: Callable[[], LaserState]) -> None:
        self._camera, self._send, self._laser_state = camera, send, laser_state
        self._black: float | None = None  # counts without light, from a picture before there was any light
        self._session: Session | None = None  # of the refinement that is going on
        self._number = 0  # of the refinement: the end of an earlier one may come late
        self._displayed = 0  # CRC-32 of the latest pattern on the panel
        self._capturing = False

    def begin(self, session: Session, captures: int) -> None:
        """Refine for a program that has the display, or end that with 0 captures.

        Raises
        ------
        RequestError
            Where that is not possible now.
        """
        if session.ring is None:
            raise RequestError(Code.ORDER, "send Ring before Refine: what is displayed is refined")
        if captures and not self._camera.configured:
            raise RequestError(Code.CAMERA, "the headset has no camera: add [camera] to its configuration")
        if captures and self._session is not None:
            raise RequestError(Code.BUSY, "a refinement is running: wait for Refined, or ask for 0 captures")
        if captures and self._black is None:
            text = "the camera has taken no picture in darkness yet: ask for Dark, then arm and ask again"
            raise RequestError(Code.CAMERA, text)
        number = self._number + bool(captures)
        if not self._send(process_messages.RefinePicture(number, captures, self._black or 0.0), None):
            raise RequestError(Code.SOLVER, "the solver is being started again: ask again")
        if captures:
            self._session, self._number = session, number

    def turn(self) -> None:
        """Take one picture in the dark."""
        if self._black is None and self._camera.fresh_until_ns and not self._capturing and self._dark:
            with suppress(RequestError):
                self._camera.take_picture(self._dark_picture)
                self._capturing = True

    def displayed(self, pattern: DisplayPattern) -> None:
        """A pattern is on the panel. The second time in succession, a capture that begins now has it alone."""
        again, self._displayed = pattern.crc == self._displayed, pattern.crc
        if pattern.refined and again and self._session is not None and not self._capturing and self._lit:
            with suppress(RequestError):  # there is no camera now: try at the next display time
                self._camera.take_picture(partial(self._captured, pattern.crc))
                self._capturing = True

    def ended(self, message: process_messages.RefinementEnd) -> None:
        """A refinement has ended."""
        if message.number == self._number and self._session is not None:
            self._session.send(protocol.Refined(*message[1:]))
            self._session = None

    def lost(self, why: str) -> None:
        """The solver was lost, and the refinement with it."""
        self.ended(process_messages.RefinementEnd(self._number, 0, 0.0, 0.0, why))

    def forget(self, session: Session) -> None:
        """A program has disconnected."""
        if self._session is session:
            self._session = None
            self._send(process_messages.RefinePicture(self._number, 0, 0.0), None)

    @property
    def _lit(self) -> bool:
        return self._laser_state() == LaserState.EMITTING

    @property
    def _dark(self) -> bool:
        return self._laser_state() in DARK

    def _dark_picture(self, picture: CameraPicture | None, fd: int | None, why: str) -> None:
        self._capturing = False
        if picture is not None and fd is not None and self._dark:
            counts = read_sealed(os.dup(fd), (picture.height, picture.width), np.uint16)
            self._black = float(counts.mean())

    def _captured(self, crc: int, picture: CameraPicture | None, fd: int | None, why: str) -> None:
        self._capturing = False
        if picture is not None and fd is not None and crc == self._displayed and self._lit:
            self._send(process_messages.RefinementCapture(crc, picture.height, picture.width), fd)
