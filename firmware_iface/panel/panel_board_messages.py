"""Bytes of the panel board's protocol (PROTOCOL.md): its replies parsed, frames laid out."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

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
FAULTS = ("panel supply", "too hot", "panel link")

_IDENTITY = struct.Struct("<4sHHHBxIIIHH")
_TIMING = struct.Struct("<III")
_STATUS = struct.Struct("<BBBBIIIIIIIhxx")
_HEADER = struct.Struct("<4sIHHII")
IDENTITY_BYTES, TIMING_BYTES, STATUS_BYTES = (s.size + 4 for s in (_IDENTITY, _TIMING, _STATUS))  # with CRC


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


def parse_status(reply: bytes) -> Status:
    """Parse a reply to STATUS.

    Raises
    ------
    ValueError
        Where these 40 bytes are not a status.
    """
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


def _checked(reply: bytes, size: int) -> bytes:
    if len(reply) != size + 4:
        raise ValueError(f"{len(reply)} bytes came instead of {size + 4}")
    if zlib.crc32(reply[:size]) != int.from_bytes(reply[size:], "little"):
        raise ValueError("the CRC of its reply is wrong")
    return reply[:size]
