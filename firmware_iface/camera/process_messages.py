"""Messages from the camera's process to ours, on a pipe: what it is doing, and frames as they came."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

MAGIC = b"HLCM"
STATE, FRAME = 0, 1
LONGEST = 64 * 1024 * 1024

_HEADER = struct.Struct("<4sB3xIHHIIIQQ")  # kind, length, h, w, stride, exposure us, ISO, number, end ns


@dataclass(frozen=True)
class Frame:
    """One frame as the camera packs it; `end_ns` is when its exposure ended, on the monotonic clock."""

    height: int
    width: int
    stride: int
    exposure_us: int
    iso: int
    number: int
    end_ns: int
    data: bytes

    @property
    def begin_ns(self) -> int:
        """When its exposure began."""
        return self.end_ns - 1000 * self.exposure_us


def state_message(text: str) -> bytes:
    """A word on what the process is doing; also its sign of life."""
    data = text.encode()
    return _HEADER.pack(MAGIC, STATE, len(data), 0, 0, 0, 0, 0, 0, 0) + data


def frame_message(frame: Frame) -> bytes:
    """One frame."""
    f = frame
    head = _HEADER.pack(
        MAGIC, FRAME, len(f.data), f.height, f.width, f.stride, f.exposure_us, f.iso, f.number, f.end_ns
    )
    return head + f.data


class Messages:
    """Takes bytes as they come and gives whole messages; half a message at the end is simply not given."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[str | Frame]:
        """States and frames that are complete with `data`.

        Raises
        ------
        ValueError
            Where it is no such stream.
        """
        self._rest += data
        while len(self._rest) >= _HEADER.size:
            magic, kind, length, *numbers = _HEADER.unpack_from(self._rest)
            if magic != MAGIC or kind not in (STATE, FRAME) or length > LONGEST:
                raise ValueError("this is not a message of the camera's process")
            end = _HEADER.size + length
            if len(self._rest) < end:
                return
            body = bytes(self._rest[_HEADER.size : end])
            del self._rest[:end]
            if kind == STATE:
                yield body.decode(errors="replace")
            else:
                height, width, stride, exposure_us, iso, number, end_ns = numbers
                yield Frame(height, width, stride, exposure_us, iso, number, end_ns, body)
