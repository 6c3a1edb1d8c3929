"""Bytes of the panel board's protocol (PROTOCOL.md): its replies parsed, frames laid out."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from firmware_iface.panel.fields import Field
from firmware_iface.panel.panel import Gray

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
FIELDS_REFUSAL = "a frame whose fields are not all there, in their order"  # version 2 only
DARK_REASONS = ("", "its pattern was not on the panel", "its record was not that of the field")
FAULTS = ("panel supply", "too hot", "panel link")

_IDENTITY = struct.Struct("<4sHHHBxIIIHH")
_TIMING = struct.Struct("<III")
_STATUS = struct.Struct("<BBBBIIIIIIIhxx")
_HEADER = struct.Struct("<4sIHHII")
_VERSIONS = struct.Struct("<HHBBxx")
_FIELDS = struct.Struct("<BBBBII")
_FIELDS_HEADER = struct.Struct("<4sIHHBxxxI")
_RECORD = struct.Struct("<3sBBxxxIII")
IDENTITY_BYTES, TIMING_BYTES, STATUS_BYTES, VERSIONS_BYTES, FIELDS_BYTES = (
    layout.size + 4 for layout in (_IDENTITY, _TIMING, _STATUS, _VERSIONS, _FIELDS)
)  # with CRC


@dataclass(frozen=True)
class Identity:
    """Identity of a board, as its reply gives it."""

    width: int
    height: int
    pixel_pitch_nm: int
    shortest_period_us: int
    longest_period_us: int
    firmware: str


@dataclass(frozen=True)
class Timing:
    """One period of the panel, and the part of it in which the light may be on."""

    period_us: int = 16667
    light_delay_us: int = 4000
    light_width_us: int = 12000


@dataclass(frozen=True)
class Status:
    """The reply to STATUS; sequence numbers are 0 before the first frame."""

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


@dataclass(frozen=True)
class Versions:
    """The reply to VERSION: what the board can do."""

    lowest: int
    highest: int
    most_fields: int
    light_outputs: int


@dataclass(frozen=True)
class FieldsShown:
    """The reply to FIELDS: the frame on display; `kept_dark_because` is empty where no field was kept dark."""

    fields: int
    field: int
    lasers: int
    kept_dark_because: str
    fields_displayed: int
    fields_kept_dark: int


def parse_identity(reply: bytes) -> Identity:
    """Parse a reply to IDENTITY.

    Raises
    ------
    ValueError
        Where these 32 bytes are not an identity of version 1.
    """
    magic, version, width, height, bits, pitch, shortest, longest, minor, major = _IDENTITY.unpack(
        _checked(reply, _IDENTITY.size)
    )
    if magic != b"HLPB" or version != 1 or bits != 8 or not width or not height or shortest > longest:
        raise ValueError("its identity is not that of a panel board of protocol version 1")
    return Identity(width, height, pitch, shortest, longest, f"{major}.{minor}")


def parse_timing(reply: bytes) -> Timing:
    """Parse a reply to TIMING.

    Raises
    ------
    ValueError
        Where these 16 bytes are not a timing.
    """
    return Timing(*_TIMING.unpack(_checked(reply, _TIMING.size)))


def parse_status(reply: bytes, version: int = 1) -> Status:
    """Parse a reply to STATUS, in a version of the protocol.

    Raises
    ------
    ValueError
        Where these 40 bytes are not a status.
    """
    mode, buffer, refusal, faults, *counts, temperature = _STATUS.unpack(_checked(reply, _STATUS.size))
    refusals = REFUSALS if version == 1 else (*REFUSALS, FIELDS_REFUSAL)
    if mode >= len(MODES) or buffer >= len(BUFFERS) or refusal >= len(refusals) or faults >> len(FAULTS):
        raise ValueError("its status has values that the protocol does not know")
    named = tuple(name for bit, name in enumerate(FAULTS) if faults >> bit & 1)
    received, committed, displayed, shown, rejected, periods, since_us = counts
    return Status(
        MODES[mode],
        BUFFERS[buffer],
        refusals[refusal],
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


def parse_versions(reply: bytes) -> Versions:
    """Parse a reply to VERSION.

    Raises
    ------
    ValueError
        Where these 12 bytes are not versions.
    """
    found = Versions(*_VERSIONS.unpack(_checked(reply, _VERSIONS.size)))
    if not 1 <= found.lowest <= found.highest or not found.most_fields or not 1 <= found.light_outputs <= 8:
        raise ValueError("its versions have values that the protocol does not know")
    return found


def parse_fields(reply: bytes) -> FieldsShown:
    """Parse a reply to FIELDS.

    Raises
    ------
    ValueError
        Where these 16 bytes do not describe a frame.
    """
    fields, field, lasers, reason, displayed, kept_dark = _FIELDS.unpack(_checked(reply, _FIELDS.size))
    if reason >= len(DARK_REASONS) or field >= max(fields, 1):
        raise ValueError("its fields have values that the protocol does not know")
    return FieldsShown(fields, field, lasers, DARK_REASONS[reason], displayed, kept_dark)


def timing_bytes(timing: Timing) -> bytes:
    """A timing as it is sent, with its CRC."""
    return with_crc(_TIMING.pack(timing.period_us, timing.light_delay_us, timing.light_width_us))


def with_crc(data: bytes) -> bytes:
    """`data` and its CRC-32."""
    return data + struct.pack("<I", zlib.crc32(data))


def frame_bytes(gray: Gray, sequence: int) -> tuple[bytes, int]:
    """One frame as it is sent, and the CRC-32 of its pixels."""
    pixels = gray.tobytes()
    crc = zlib.crc32(pixels)
    height, width = gray.shape
    return with_crc(_HEADER.pack(b"HLPF", sequence, width, height, len(pixels), crc)) + pixels, crc


def fields_bytes(fields: Sequence[Field], sequence: int) -> tuple[bytes, int]:
    """One frame of fields as it is sent in version 2, and the CRC-32 of its records."""
    pixels = [field.gray.tobytes() for field in fields]
    records = b"".join(
        with_crc(_RECORD.pack(b"FLD", k, field.lasers, field.delay_us, field.width_us, zlib.crc32(pixels[k])))
        for k, field in enumerate(fields)
    )
    height, width = fields[0].gray.shape
    crc = zlib.crc32(records)
    header = with_crc(_FIELDS_HEADER.pack(b"HLPS", sequence, width, height, len(fields), crc))
    return b"".join((header, records, *pixels)), crc


def _checked(reply: bytes, size: int) -> bytes:
    if len(reply) != size + 4:
        raise ValueError(f"{len(reply)} bytes came instead of {size + 4}")
    if zlib.crc32(reply[:size]) != int.from_bytes(reply[size:], "little"):
        raise ValueError("the CRC of its reply is wrong")
    return reply[:size]
