"""Messages of the camera's process on its pipe: its state, and frames as the camera packed them."""

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
    """One frame as the camera packs it.

    Attributes
    ----------
    height, width : int, pixels
    stride : int
        Bytes from the start of one row to the next.
    exposure_us : int, µs
    iso : int
        100 at gain 1.
    number : int
        Counts frames.
    end_ns : int, ns
        End of the exposure, monotonic clock.
    data : bytes
    """

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
        """Begin of its exposure, ns, monotonic clock."""
        return self.end_ns - 1000 * self.exposure_us


def state_message(text: str) -> bytes:
    """The state of the process, as a message; it also shows that the process is alive."""
    data = text.encode()
    return _HEADER.pack(MAGIC, STATE, len(data), 0, 0, 0, 0, 0, 0, 0) + data


def frame_message(frame: Frame) -> bytes:
    """A frame as a message."""
    f = frame
    head = _HEADER.pack(
        MAGIC, FRAME, len(f.data), f.height, f.width, f.stride, f.exposure_us, f.iso, f.number, f.end_ns
    )
    return head + f.data


class Messages:
    """Takes bytes as they come and gives whole messages; an incomplete message at the end is kept for later."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> Iterator[str | Frame]:
        """States and frames that are complete with `data`.

        Raises
        ------
        ValueError
            Where the bytes are no such stream.
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
