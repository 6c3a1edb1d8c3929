"""The panel board of PROTOCOL.md: control over requests, frames over the bulk endpoint."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel.fields import Field, FieldPanel
from firmware_iface.panel.panel import Gray, Panel
from firmware_iface.panel.panel_board_messages import (
    FIELDS_BYTES,
    IDENTITY_BYTES,
    MODES,
    STATUS_BYTES,
    TIMING_BYTES,
    VERSIONS_BYTES,
    FieldsShown,
    Identity,
    Status,
    Timing,
    Versions,
    fields_bytes,
    frame_bytes,
    parse_fields,
    parse_identity,
    parse_status,
    parse_timing,
    parse_versions,
    timing_bytes,
    with_crc,
)
from firmware_iface.usb_link import UsbLink

VENDOR, PRODUCT = 0x1209, 0x0001
IDENTITY, MODE, TIMING, STATUS, COMMIT, CLEAR, VERSION, FIELDS = range(1, 9)
FRAMES_OUT = 0x01


class BoardControl:
    """Identity, mode, timing and status of a board.

    Parameters
    ----------
    link : UsbLink
    timing : Timing or None
        Set each time the board was found, and checked by reading it back.
    fields : int
        Fields that a frame may need; more than 1 needs version 2 of the protocol.

    Attributes
    ----------
    identity : Identity or None
        Of the board that is attached.
    versions : Versions or None
        What it can do, where version 2 is spoken; None in version 1.
    """

    def __init__(self, link: UsbLink, timing: Timing | None = None, fields: int = 1) -> None:
        self._link = link
        self._timing = timing or Timing()
        self._fields = fields
        self.versions: Versions | None = None
        self.identity: Identity | None = None
        link.opened.append(self._set_up)
        link.open()

    @property
    def timing(self) -> Timing:
        """The timing in force; assign to change it.

        Raises
        ------
        InputError
            Where the board cannot do it.
        """
        return self._timing

    @timing.setter
    def timing(self, timing: Timing) -> None:
        self._link.open()
        self._set_timing(timing)
        self._timing = timing

    def set_mode(self, mode: str) -> None:
        """Go into one of MODES."""
        if mode not in MODES:
            raise InputError(f"a panel board has no mode '{mode}'; use one of {', '.join(MODES)}.")
        self._link.control_out(MODE, value=MODES.index(mode))

    def read_status(self) -> Status:
        """The board's status.

        Raises
        ------
        DeviceError
            Where it does not answer as it should.
        """
        version = 1 if self.versions is None else 2
        return self._ask(STATUS, STATUS_BYTES, partial(parse_status, version=version))

    def read_fields(self) -> FieldsShown:
        """The fields on display; version 2 only.

        Raises
        ------
        DeviceError
            Where it does not answer as it should.
        """
        return self._ask(FIELDS, FIELDS_BYTES, parse_fields)

    def status(self) -> dict[str, Any]:
        status, identity = self.read_status(), self.identity
        shown = {} if self.versions is None else vars(self.read_fields())
        return vars(status) | {"faults": list(status.faults)} | (vars(identity) if identity else {}) | shown

    def commit(self, sequence: int, crc: int) -> None:
        """Let the frame in the back buffer be displayed from the next period on."""
        self._link.control_out(COMMIT, with_crc(struct.pack("<II", sequence, crc)))

    def recover(self) -> str:
        """After a failed transfer: make the board ready for a frame; returns what it had refused."""
        refusal = self.read_status().refusal
        self._link.clear_halt(FRAMES_OUT)
        self._link.control_out(CLEAR)
        return refusal

    def close(self) -> None:
        if self._link.is_open:
            with suppress(DeviceError):  # an unplugged board is dark already
                self.set_mode("dark")
        self._link.close()

    def _set_up(self) -> None:
        found = self._ask(IDENTITY, IDENTITY_BYTES, parse_identity)
        if self.identity is not None and (found.height, found.width) != self._shape():
            raise DeviceError(
                f"{self._link.name} came back as another board, {found.width} x {found.height} pixels; "
                "attach the one that was there, or start again with this one."
            )
        self.identity = found
        if self._fields > 1:
            self._choose_version()
        self._set_timing(self._timing)
        self.set_mode("show")

    def _choose_version(self) -> None:
        try:
            found = self._ask(VERSION, VERSIONS_BYTES, parse_versions)
        except DeviceGoneError:
            raise
        except DeviceError as error:
            raise DeviceError(
                f"{self._link.name} does not say that it shows several fields ({error}) A board of protocol "
                "version 1 shows one colour: update its firmware, or show one colour."
            ) from error
        if found.highest < 2 or self._fields > found.most_fields:
            most = found.most_fields if found.highest >= 2 else 1
            raise InputError(
                f"{self._link.name} shows {most} fields at most, not {self._fields}; ask for less (fields in [panel]): "
                "fewer patterns of each colour."
            )
        self._link.control_out(VERSION, value=2)
        self.versions = found

    def _shape(self) -> tuple[int, int]:
        assert self.identity is not None
        return self.identity.height, self.identity.width

    def _set_timing(self, timing: Timing) -> None:
        assert self.identity is not None
        low, high = self.identity.shortest_period_us, self.identity.longest_period_us
        if not low <= timing.period_us <= high:
            raise InputError(f"a period of {timing.period_us} µs is out of range; give {low} to {high} µs.")
        if min(timing.light_delay_us, timing.light_width_us) < 0 or (
            timing.light_delay_us + timing.light_width_us > timing.period_us
        ):
            raise InputError("the light does not fit the period; lower light_delay_us or light_width_us.")
        self._link.control_out(TIMING, timing_bytes(timing))
        if self._ask(TIMING, TIMING_BYTES, parse_timing) != timing:
            raise DeviceError(f"{self._link.name} did not take its timing; power it off and on.")

    def _ask(self, request: int, length: int, parse: Any) -> Any:
        """A parsed reply; requested once more where the first was missing or garbled."""
        try:
            return parse(self._link.control_in(request, length))
        except DeviceGoneError:
            raise
        except (DeviceError, ValueError):
            pass
        try:
            return parse(self._link.control_in(request, length))
        except ValueError as error:
            raise DeviceError(f"{self._link.name}: {error}; check its cable and its firmware.") from error


class BulkFrames:
    """Frames over the bulk endpoint, each sent once more if the first try failed.

    Parameters
    ----------
    link : UsbLink
    control : BoardControl
    most_fields : int
        Fields of a frame at most: how many periods a frame may take.
    """

    def __init__(self, link: UsbLink, control: BoardControl, most_fields: int = 1) -> None:
        assert control.identity is not None
        self.shape = control.identity.height, control.identity.width
        self.most_fields = most_fields
        self._link, self._control = link, control
        self._sequence = 0

    def send(self, gray: Gray) -> int:
        """Write a frame to the back buffer and commit it; it is displayed from the next period on."""
        return self._send(partial(frame_bytes, gray))

    def _send(self, as_bytes: Callable[[int], tuple[bytes, int]]) -> int:
        self._sequence = self._sequence % 0xFFFFFFFF + 1
        frame, crc = as_bytes(self._sequence)
        try:
            self._send_and_commit(frame, crc)
        except DeviceGoneError:
            raise
        except DeviceError:
            self._control.recover()
            try:
                self._send_and_commit(frame, crc)
            except DeviceGoneError:
                raise
            except DeviceError as error:
                refusal = self._control.recover()
                raise DeviceError(
                    f"{error} Frame {self._sequence} was sent twice and not taken: "
                    f"the board refused {refusal}; check its cable."
                ) from error
        return self._sequence

    def wait(self, sequence: int) -> None:
        """Return when the board displays this frame."""
        period_s = self._control.timing.period_us * 1e-6
        end = time.monotonic() + 3 * self.most_fields * period_s + self._link.timeout_s
        while True:
            status = self._control.read_status()
            if status.displayed_sequence == sequence:
                return
            if status.committed_sequence != sequence or time.monotonic() > end:
                raise DeviceError(
                    f"{self._link.name} lost frame {sequence}: it displays {status.displayed_sequence}; "
                    "show it again."
                )
            time.sleep(min(period_s / 8, 1e-3))

    def close(self) -> None:
        self._link.close()

    def _send_and_commit(self, frame: bytes, crc: int) -> None:
        self._link.write(FRAMES_OUT, frame)
        self._control.commit(self._sequence, crc)


class FieldsOverBulk(BulkFrames):
    """Frames of several fields over the bulk endpoint, in version 2 of the protocol."""

    @property
    def field_us(self) -> int:
        """Time of one field, µs."""
        return self._control.timing.period_us

    @property
    def every_laser(self) -> int:
        """Mask of the board's light outputs."""
        assert self._control.versions is not None
        return (1 << self._control.versions.light_outputs) - 1

    def send_fields(self, fields: Sequence[Field]) -> int:
        """Write a frame to the back buffer and commit it; displayed after the last field of the frame before."""
        return self._send(partial(fields_bytes, fields))


def open_board(
    serial: str | None = None,
    *,
    backend: Any = None,
    timing: Timing | None = None,
    timeout_s: float = 0.5,
    fields: int = 1,
) -> Panel:
    """Open the panel board.

    Parameters
    ----------
    serial : str or None
        Serial number, where several are attached.
    backend : pyusb backend or None
        None is the system's libusb.
    timing : Timing or None
        Of the panel's period; None is 60 Hz.
    timeout_s : float, s
        Longest wait for one transfer.
    fields : int
        Fields that a frame may need, for colours in turn. More than 1 needs a board of protocol version 2 and gives a
        FieldPanel; the timing's period is then a field's.

    Returns
    -------
    Panel

    Raises
    ------
    InputError
        Where the board shows fewer fields.
    DeviceGoneError
        Where it is not attached.
    DeviceError
        Where it does not answer as it should.
    """
    link = UsbLink(VENDOR, PRODUCT, "the panel board", serial=serial, backend=backend, timeout_s=timeout_s)
    control = BoardControl(link, timing, fields)
    if fields > 1:
        return FieldPanel(control, FieldsOverBulk(link, control, fields), fields)
    return Panel(control, BulkFrames(link, control))
