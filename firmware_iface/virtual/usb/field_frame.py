"""A frame of fields as it arrives at the panel board in version 2 of its protocol: checked piece by piece."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

HEADER, RECORD = 24, 24
BAD_HEADER, BAD_LENGTH, BAD_PIXELS, OUT_OF_RANGE, NOT_ALL_FIELDS = 3, 4, 5, 7, 8


class RefusedFrame(Exception):
    """The frame is refused, for a reason that STATUS gives."""

    def __init__(self, reason: int) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class ReceivedField:
    """A field that was received whole.

    Attributes
    ----------
    number : int
    outputs : int
        Mask of the light outputs.
    delay_us, width_us : int, µs
    crc : int
        CRC-32 of the pixels, as the record has it.
    pixels : bytes
    """

    number: int
    outputs: int
    delay_us: int
    width_us: int
    crc: int
    pixels: bytes = b""


class FieldFrame:
    """One frame, from the first byte of its header on.

    Parameters
    ----------
    shape : (int, int)
        (H, W) of the panel.
    most_fields, light_outputs : int
        What the board can do.
    period_us : int, µs
        Time of a field.

    Attributes
    ----------
    sequence : int
    crc : int
        Of the records.
    fields : list of ReceivedField
        Those that are whole so far.
    complete : bool
    """

    def __init__(self, shape: tuple[int, int], most_fields: int, light_outputs: int, period_us: int) -> None:
        self._shape, self._most_fields, self._period_us = shape, most_fields, period_us
        self._every_output = (1 << light_outputs) - 1
        self._data = bytearray()
        self._records: list[ReceivedField] = []
        self._count = 0
        self.sequence = self.crc = 0
        self.fields: list[ReceivedField] = []

    @property
    def complete(self) -> bool:
        return 0 < self._count == len(self.fields)

    def add(self, data: bytes) -> None:
        """Take more bytes.

        Raises
        ------
        RefusedFrame
            Where they are no part of a frame.
        """
        self._data += data
        if not self._count:
            self._take_header()
        if not self._records and len(self._data) >= HEADER + self._count * RECORD:
            self._take_records()
        size = self._shape[0] * self._shape[1]
        while self._records and not self.complete:
            record = self._records[len(self.fields)]
            begins = HEADER + self._count * RECORD + len(self.fields) * size
            if len(self._data) < begins + size:
                return
            pixels = bytes(self._data[begins : begins + size])
            if zlib.crc32(pixels) != record.crc:
                raise RefusedFrame(BAD_PIXELS)
            self.fields.append(
                ReceivedField(
                    record.number, record.outputs, record.delay_us, record.width_us, record.crc, pixels
                )
            )
        if self.complete and len(self._data) > HEADER + self._count * (RECORD + size):
            raise RefusedFrame(BAD_LENGTH)

    def _take_header(self) -> None:
        if len(self._data) < HEADER:
            raise RefusedFrame(BAD_HEADER)
        magic, sequence, width, height, count, spare, crc = struct.unpack_from("<4sIHHB3sI", self._data)
        whole = zlib.crc32(self._data[:20]) == int.from_bytes(self._data[20:24], "little")
        if magic != b"HLPS" or not whole or (height, width) != self._shape or not sequence or any(spare):
            raise RefusedFrame(BAD_HEADER)
        if not 1 <= count <= self._most_fields:
            raise RefusedFrame(OUT_OF_RANGE)
        self.sequence, self.crc, self._count = sequence, crc, count

    def _take_records(self) -> None:
        records = bytes(self._data[HEADER : HEADER + self._count * RECORD])
        if zlib.crc32(records) != self.crc:
            raise RefusedFrame(BAD_HEADER)
        for k in range(self._count):
            record = records[k * RECORD : (k + 1) * RECORD]
            magic, number, outputs, spare, delay, width, crc = struct.unpack_from("<3sBB3sIII", record)
            if (
                magic != b"FLD"
                or any(spare)
                or zlib.crc32(record[:20]) != int.from_bytes(record[20:], "little")
            ):
                raise RefusedFrame(BAD_HEADER)
            if number != k:
                raise RefusedFrame(NOT_ALL_FIELDS)
            if outputs & ~self._every_output or delay + width > self._period_us:
                raise RefusedFrame(OUT_OF_RANGE)
            self._records.append(ReceivedField(number, outputs, delay, width, crc))
