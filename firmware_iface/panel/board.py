"""The panel board of PROTOCOL.md: control over requests, frames over the bulk endpoint."""

from __future__ import annotations

import struct
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel.panel import Gray, Panel
from firmware_iface.usb_link import UsbLink

VENDOR, PRODUCT = 0x1209, 0x0001
IDENTITY, MODE, TIMING, STATUS, COMMIT, CLEAR = 1, 2, 3, 4, 5, 6
MODES = ("dark", "show", "test")
BUFFERS = ("empty", "filling", "complete", "pending")
REFUSALS = (
    "nothing",
    "a request that it does not know",
    "a request whose CRC is wrong",
    "a frame whose header is wrong",
    "a frame of the wrong length",
    "a frame whose CRC is wrong",
    "to display a frame that it does not hold",
    "a value out of range",
)
FAULTS = ("panel supply", "too hot", "panel link")

FRAMES_OUT = 0x01
_IDENTITY = struct.Struct("<4sHHHBxIIIHH")
_TIMING = struct.Struct("<III")
_STATUS = struct.Struct("<BBBBIIIIIIIhxx")
_HEADER = struct.Struct("<4sIHHII")


@dataclass(frozen=True)
class Identity:
    """Which board it is; periods in µs, as the board counts."""

    width: int
    height: int
    pixel_pitch_nm: int
    shortest_period_us: int
    longest_period_us: int
    firmware: str


@dataclass(frozen=True)
class Timing:
    """One period of the panel, and when in it the light may be on."""

    period_us: int = 16667
    light_delay_us: int = 4000
    light_width_us: int = 12000


@dataclass(frozen=True)
class Status:
    """What STATUS reports; sequence numbers are 0 before the first frame."""

    mode: str
    buffer: str
    refusal: str
    faults: tuple[str, ...]
    received_sequence: int
    committed_sequence: int
    displayed_sequence: int
    frames_displayed: int
    frames_rejected: int
    periods: int
    since_period_us: int
    temperature_c: float


def parse_identity(reply: bytes) -> Identity:
    """Raises ValueError with the reason where these 32 bytes are not an identity of version 1."""
    magic, version, width, height, bits, pitch, shortest, longest, minor, major = _IDENTITY.unpack(
        _checked(reply, _IDENTITY.size)
    )
    if magic != b"HLPB" or version != 1 or bits != 8 or not width or not height or shortest > longest:
        raise ValueError("its identity is not that of a panel board of protocol version 1")
    return Identity(width, height, pitch, shortest, longest, f"{major}.{minor}")


def parse_timing(reply: bytes) -> Timing:
    """Raises ValueError where these 16 bytes are not a timing."""
    return Timing(*_TIMING.unpack(_checked(reply, _TIMING.size)))


def parse_status(reply: bytes) -> Status:
    """Raises ValueError with the reason where these 40 bytes are not a status."""
    mode, buffer, refusal, faults, *counts, temperature = _STATUS.unpack(_checked(reply, _STATUS.size))
    if mode >= len(MODES) or buffer >= len(BUFFERS) or refusal >= len(REFUSALS) or faults >> len(FAULTS):
        raise ValueError("its status has values that the protocol does not know")
    named = tuple(name for bit, name in enumerate(FAULTS) if faults >> bit & 1)
    received, committed, displayed, shown, rejected, periods, since_us = counts
    return Status(
        MODES[mode],
        BUFFERS[buffer],
        REFUSALS[refusal],
        named,
        received,
        committed,
        displayed,
        shown,
        rejected,
        periods,
        since_us,
        temperature / 100,
    )


def with_crc(data: bytes) -> bytes:
    """`data` and its CRC-32."""
    return data + struct.pack("<I", zlib.crc32(data))


def frame_bytes(gray: Gray, sequence: int) -> tuple[bytes, int]:
    """One frame as it travels, and the CRC-32 of its pixels."""
    pixels = gray.tobytes()
    crc = zlib.crc32(pixels)
    height, width = gray.shape
    return with_crc(_HEADER.pack(b"HLPF", sequence, width, height, len(pixels), crc)) + pixels, crc


def _checked(reply: bytes, size: int) -> bytes:
    if len(reply) != size + 4:
        raise ValueError(f"{len(reply)} bytes came instead of {size + 4}")
    if zlib.crc32(reply[:size]) != int.from_bytes(reply[size:], "little"):
        raise ValueError("the CRC of its reply is wrong")
    return reply[:size]


class BoardControl:
    """Identity, mode, timing and status of a board.

    timing : set each time the board was found, and checked by reading it back

    Attribute: identity.
    """

    def __init__(self, link: UsbLink, timing: Timing | None = None) -> None:
        self._link = link
        self._timing = timing or Timing()
        self.identity: Identity | None = None
        link.opened.append(self._set_up)
        link.open()

    @property
    def timing(self) -> Timing:
        """What the board is set to; assign to change it. InputError where the board cannot do it."""
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
        """The board's status; raises DeviceError."""
        return self._ask(STATUS, _STATUS.size, parse_status)

    def status(self) -> dict[str, Any]:
        status, identity = self.read_status(), self.identity
        return vars(status) | {"faults": list(status.faults)} | (vars(identity) if identity else {})

    def commit(self, sequence: int, crc: int) -> None:
        """Let the frame in the back buffer be displayed from the next period on."""
        self._link.control_out(COMMIT, with_crc(struct.pack("<II", sequence, crc)))

    def recover(self) -> str:
        """After a failed transfer: make the board ready for a frame; says what it had refused."""
        refusal = self.read_status().refusal
        self._link.clear_halt(FRAMES_OUT)
        self._link.control_out(CLEAR)
        return refusal

    def close(self) -> None:
        if self._link.is_open:
            with suppress(DeviceError):  # a board that is gone is dark already
                self.set_mode("dark")
        self._link.close()

    def _set_up(self) -> None:
        found = self._ask(IDENTITY, _IDENTITY.size, parse_identity)
        if self.identity is not None and (found.height, found.width) != self._shape():
            raise DeviceError(
                f"{self._link.name} came back as another board, {found.width} x {found.height} pixels; "
                "attach the one that was there, or start again with this one."
            )
        self.identity = found
        self._set_timing(self._timing)
        self.set_mode("show")

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
        data = _TIMING.pack(timing.period_us, timing.light_delay_us, timing.light_width_us)
        self._link.control_out(TIMING, with_crc(data))
        if self._ask(TIMING, _TIMING.size, parse_timing) != timing:
            raise DeviceError(f"{self._link.name} did not take its timing; power it off and on.")

    def _ask(self, request: int, size: int, parse: Any) -> Any:
        """A parsed reply; asked for once more where the first did not come or was garbled."""
        try:
            return parse(self._link.control_in(request, size + 4))
        except DeviceGoneError:
            raise
        except (DeviceError, ValueError):
            pass
        try:
            return parse(self._link.control_in(request, size + 4))
        except ValueError as error:
            raise DeviceError(f"{self._link.name}: {error}; check its cable and its firmware.") from error


class BulkFrames:
    """Frames over the bulk endpoint, each sent once more if the first try failed."""

    def __init__(self, link: UsbLink, control: BoardControl) -> None:
        assert control.identity is not None
        self.shape = control.identity.height, control.identity.width
        self._link, self._control = link, control
        self._sequence = 0

    def send(self, gray: Gray) -> int:
        """Write a frame to the back buffer and commit it; it is displayed from the next period on."""
        self._sequence = self._sequence % 0xFFFFFFFF + 1
        frame, crc = frame_bytes(gray, self._sequence)
        try:
            self._hand_over(frame, crc)
        except DeviceGoneError:
            raise
        except DeviceError:
            self._control.recover()
            try:
                self._hand_over(frame, crc)
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
        end = time.monotonic() + 3 * period_s + self._link.timeout_s
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

    def _hand_over(self, frame: bytes, crc: int) -> None:
        self._link.write(FRAMES_OUT, frame)
        self._control.commit(self._sequence, crc)


def open_board(
    serial: str | None = None,
    *,
    backend: Any = None,
    timing: Timing | None = None,
    timeout_s: float = 0.5,
) -> Panel:
    """Open the panel board, or that of this serial number.

    backend : a pyusb backend; None is the system's libusb
    timeout_s : longest wait for one transfer
    Raises DeviceGoneError where it is not attached, DeviceError where it does not answer as it should.
    """
    link = UsbLink(VENDOR, PRODUCT, "the panel board", serial=serial, backend=backend, timeout_s=timeout_s)
    control = BoardControl(link, timing)
    return Panel(control, BulkFrames(link, control))
