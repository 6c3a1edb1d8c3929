"""A model of the panel board, written from firmware_iface/panel/PROTOCOL.md alone: bytes in, bytes out.

It shares no code with the driver, so that a mistake in one shows against the other.
"""

from __future__ import annotations

import struct
import time
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.usb.field_frame import FieldFrame, RefusedFrame
from firmware_iface.virtual.usb.field_sequence import MOST_PERIODS, FieldSequence
from firmware_iface.virtual.usb.usb_model import (
    BULK,
    Nak,
    Stall,
    UsbModel,
    configuration_descriptor,
    device_descriptor,
    endpoint_descriptor,
    interface_descriptor,
)

PACKET = 512
EMPTY, FILLING, COMPLETE, PENDING = range(4)
DARK, SHOW, TEST = range(3)
LOWEST, HIGHEST, MOST_FIELDS, LIGHT_OUTPUTS = 1, 2, 8, 3  # versions, and what version 2 can do
EVERY_OUTPUT = (1 << LIGHT_OUTPUTS) - 1


def _sealed(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(4, "little")


@dataclass(frozen=True)
class LitPattern:
    """A pattern on the panel and the light that it has.

    Attributes
    ----------
    gray : uint8 array [H, W]
    outputs : int
        Mask of the light outputs that are open.
    begins_s, width_s : float, s
        From the start of the frame to the light, and for how long; in version 1, all the time.
    """

    gray: NDArray[np.uint8]
    outputs: int
    begins_s: float
    width_s: float


class BoardModel(UsbModel):
    """The board and the panel behind it.

    Parameters
    ----------
    shape : (int, int)
        (H, W), pixels.
    serial : str
        Serial number.
    faults : Faults or None
        See UsbModel.
    clock : callable
        Gives the time, s.
    newest : int
        The highest version of the protocol that its firmware speaks.

    Attributes
    ----------
    link_faults : Faults
        Of the link between the board and the panel, asked once a field in version 2: torn_field, swapped_gate,
        missing_field.
    sequence : FieldSequence
        The panel in version 2.
    gray : uint8 array [H, W]
        On the panel now.
    shown : deque of (int, int)
        Sequence and CRC-32 of the patterns displayed, the newest last, up to 4096.
    fault_bits : int
    temperature_c : float, °C
        As STATUS reports them.
    """

    def __init__(
        self,
        shape: tuple[int, int] = (240, 320),
        serial: str = "HL0001",
        faults: Faults | None = None,
        clock: Callable[[], float] = time.monotonic,
        newest: int = HIGHEST,
    ) -> None:
        self.shape = shape
        self.link_faults = Faults()
        self._newest = newest
        self.shown: deque[tuple[int, int]] = deque(maxlen=4096)
        self.fault_bits, self.temperature_c = 0, 31.25
        self._clock = clock
        self._started = clock()
        super().__init__(
            device_descriptor(0x1209, 0x0001),
            configuration_descriptor(
                interface_descriptor(1, 0xFF, 0x48, 1), endpoint_descriptor(0x01, BULK, PACKET)
            ),
            ("hololoop", "panel board", serial),
            faults,
        )
        self.on_reset()

    @property
    def gray(self) -> NDArray[np.uint8]:
        """Gray levels on the panel, uint8 [H, W]; gray 0 without power."""
        with self._lock:
            if not self.present or self._mode == DARK:
                return np.zeros(self.shape, np.uint8)
            if self._mode == TEST:
                row, column = np.indices(self.shape)
                return ((row // 8 + column // 8) % 2 * 128).astype(np.uint8)
            self._run()
            front = self._front if self._version == 1 else self.sequence.on_panel
            return self._picture(front)

    @property
    def outputs(self) -> int:
        """Mask of the light outputs that are open, at some time of the frame on display."""
        with self._lock:
            if not self.present or self._mode == DARK:
                return 0
            self._run()
            return EVERY_OUTPUT if self._version == 1 else self.sequence.outputs

    def lit(self) -> tuple[float, float, list[LitPattern]]:
        """The time of a frame, the time since the one on display began, both s, and the patterns that are lit in it."""
        gray, outputs = self.gray, self.outputs
        with self._lock:
            period_s = self._period_us * 1e-6
            if self._version == 1:
                return period_s, 0.0, [LitPattern(gray, outputs, 0.0, period_s)]
            shown = self.sequence.shown() if outputs else []
            patterns = [
                LitPattern(
                    self._picture(pixels),
                    open_,
                    k * period_s + field.delay_us * 1e-6,
                    field.width_us * 1e-6,
                )
                for k, (field, pixels, open_) in enumerate(shown)
            ]
            frame_s = max(1, len(shown)) * period_s
            since_s = self._clock() - self._epoch - self.sequence.began * period_s
            return frame_s, since_s % frame_s, patterns

    def shown_before(self) -> list[tuple[NDArray[np.uint8], int]]:
        """Patterns on the panel before those of `lit`, and for how many periods each; the last one last."""
        with self._lock:
            self._run()
            shown = self._before(self._periods()) if self._version == 1 else self.sequence.before
            return [(self._picture(pixels), len(list(same))) for pixels, same in groupby(shown)]

    def _before(self, period: int) -> list[bytes]:
        """Pixels that version 1 showed before a period, a period each."""
        periods = min(period - self._since, MOST_PERIODS)
        return [*self._history, *periods * [self._front]][-MOST_PERIODS:]

    def _picture(self, pixels: bytes) -> NDArray[np.uint8]:
        return np.frombuffer(pixels, np.uint8).reshape(self.shape).copy()

    def on_reset(self) -> None:
        self._version = 1
        self._empty()

    def _empty(self) -> None:
        self._mode, self._period_us, self._delay_us, self._width_us = DARK, 16667, 0, 0
        self._front = bytes(self.shape[0] * self.shape[1])
        self._back = bytearray()
        self._state, self._refusal = EMPTY, 0
        self._header: tuple[int, int, int] | None = None  # sequence, bytes, CRC of the pixels
        self._history: list[bytes] = []  # what version 1 showed before `_front`, a period each
        self._since = 0  # the period from which on it shows `_front`
        self._received = self._committed = self._displayed = 0
        self._count = self._rejected = 0
        self._restart_fields()

    def _restart_fields(self) -> None:
        """Version 2 without a frame, from a new period on."""
        self._epoch = self._clock()
        self._due = 0
        self._incoming: FieldFrame | None = None
        self.sequence = FieldSequence(self.shape[0] * self.shape[1], self.link_faults)
        self.sequence.lit = self._mode == SHOW

    def on_control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        self._run()
        match kind, request, data:
            case 0xC0, 1, int():
                height, width = self.shape
                return _sealed(
                    struct.pack("<4sHHHBBIIIHH", b"HLPB", 1, width, height, 8, 0, 8000, 1000, 100_000, 4, 1)
                )
            case 0x40, 2, b"":
                if value > TEST:
                    self._refuse(7)
                self._mode = value
                self.sequence.lit = value == SHOW
            case 0xC0, 3, int():
                return _sealed(struct.pack("<III", self._period_us, self._delay_us, self._width_us))
            case 0x40, 3, bytes():
                period, delay, width = struct.unpack("<III", self._opened(data, 12))
                if not 1000 <= period <= 100_000 or delay + width > period:
                    self._refuse(7)
                self._period_us, self._delay_us, self._width_us = period, delay, width
                if self._version == 2:
                    self._state, self._header = EMPTY, None
                    self._restart_fields()
                self._epoch, self._since = self._clock(), 0
                self._due = 1 if self._state == PENDING else 0
            case 0xC0, 4, int():
                return self._status()
            case 0x40, 5, bytes():
                sequence, crc = struct.unpack("<II", self._opened(data, 8))
                held = self._header and (self._header[0], self._header[2])
                if self._state != COMPLETE or held != (sequence, crc):
                    self._refuse(6)
                self._state, self._committed, self._due = PENDING, sequence, self._periods() + 1
            case 0x40, 6, b"":
                if self._state != PENDING:
                    self._state, self._header = EMPTY, None
                self._refusal = 0
            case 0xC0, 7, int() if self._newest > 1:
                return _sealed(struct.pack("<HHBBH", LOWEST, self._newest, MOST_FIELDS, LIGHT_OUTPUTS, 0))
            case 0x40, 7, b"" if self._newest > 1:
                if not LOWEST <= value <= self._newest:
                    self._refuse(7)
                self._version = value
                self._empty()
            case 0xC0, 8, int() if self._version == 2:
                return self._fields()
            case _:
                self._refuse(1)
        return b""

    def on_write(self, endpoint: int, data: bytes) -> None:
        self._run()
        if self._state == PENDING:
            raise Nak
        short = len(data) % PACKET > 0
        if self._version == 2:
            self._write_fields(data, short)
            return
        if self._state != FILLING:
            self._begin(data)
            data = data[24:]
        self._back += data
        assert self._header is not None
        _, length, crc = self._header
        if len(self._back) > length or (short and len(self._back) < length):
            self._reject(4)
        if len(self._back) == length:
            if zlib.crc32(self._back) != crc:
                self._reject(5)
            self._state, self._received = COMPLETE, self._header[0]

    def _write_fields(self, data: bytes, short: bool) -> None:
        if self._state != FILLING or self._incoming is None:
            self._incoming = FieldFrame(self.shape, MOST_FIELDS, LIGHT_OUTPUTS, self._period_us)
            self._state, self._header = FILLING, None
        frame = self._incoming
        try:
            frame.add(data)
        except RefusedFrame as refused:
            self._reject(refused.reason)
        if frame.complete:
            self._state, self._received = COMPLETE, frame.sequence
            self._header = (frame.sequence, 0, frame.crc)
        elif short:
            self._reject(4)

    def _begin(self, data: bytes) -> None:
        self._back.clear()
        if len(data) < 24:
            self._reject(3)
        magic, sequence, width, height, length, pixels_crc, crc = struct.unpack_from("<4sIHHIII", data)
        good = magic == b"HLPF" and crc == zlib.crc32(data[:20])
        if not good or (height, width) != self.shape or length != height * width or not sequence:
            self._reject(3)
        self._state, self._header = FILLING, (sequence, length, pixels_crc)

    def _run(self) -> None:
        """Carry out what is due after the periods that have passed."""
        if self._version == 2:
            self._run_fields()
            return
        if self._state == PENDING and self._periods() >= self._due:
            assert self._header is not None
            self._history, self._since = self._before(self._due), self._due
            self._front = bytes(self._back)
            self._displayed = self._committed
            self._count += 1
            self.shown.append((self._displayed, zlib.crc32(self._front)))
            self._state, self._header = EMPTY, None

    def _run_fields(self) -> None:
        frame = self._incoming if self._state == PENDING else None
        pending = None if frame is None else frame.fields
        if self.sequence.advance(self._periods(), pending, self._due):
            assert frame is not None
            self._displayed = self._committed
            self._count += 1
            self.shown.extend((self._displayed, field.crc) for field in frame.fields)
            self._state, self._header, self._incoming = EMPTY, None, None

    def _fields(self) -> bytes:
        sequence = self.sequence
        front = sequence.front
        mask = front[sequence.number].outputs if front else 0
        return _sealed(
            struct.pack(
                "<BBBBII",
                len(front),
                sequence.number if front else 0,
                mask,
                sequence.reason,
                sequence.displayed,
                sequence.kept_dark,
            )
        )

    def _periods(self) -> int:
        return int((self._clock() - self._epoch) * 1e6 / self._period_us)

    def _status(self) -> bytes:
        since = int((self._clock() - self._epoch) * 1e6) % self._period_us
        return _sealed(
            struct.pack(
                "<BBBBIIIIIIIhH",
                self._mode,
                self._state,
                self._refusal,
                self.fault_bits,
                self._received,
                self._committed,
                self._displayed,
                self._count,
                self._rejected,
                int((self._clock() - self._started) * 1e6 / self._period_us),
                since,
                round(self.temperature_c * 100),
                0,
            )
        )

    def _opened(self, data: bytes, size: int) -> bytes:
        if len(data) != size + 4:
            self._refuse(1)
        if zlib.crc32(data[:size]) != int.from_bytes(data[size:], "little"):
            self._refuse(2)
        return data[:size]

    def _refuse(self, reason: int) -> NoReturn:
        self._refusal = reason
        raise Stall

    def _reject(self, reason: int) -> NoReturn:
        self._rejected += 1
        self._state, self._header = EMPTY, None
        self._back.clear()
        self._refuse(reason)
