"""The protocol of programs and the service, version 1, over a Unix socket of type SOCK_SEQPACKET.

    program                                   service
    Hello (versions it supports)         ->
                                         <-   Welcome (the version to use; the panel's size)
    Ring, with a sealed memfd            ->
                                         <-   Done
    Wait                                 ->
                                         <-   Timing, when the next frame may begin; with its predicted display time
    Begin                                ->
                                         <-   Done
    (the program draws into a free slot of the ring)
    End (slot, CRC-32 of the slot)       ->
                                         <-   Done: accepted. The slot belongs to the service
                                         <-   Shown, or Error with the frame's number: the slot is free again

Every accepted frame ends in exactly one Shown or Error. A request that cannot be done is answered by Error
with the request's serial. Begin without an End before it discards the frame that was begun.

A slot holds linear irradiance, u16 [channels][height][width], 65535 for the brightest. Times are
CLOCK_MONOTONIC, ns. The ring is made by memfd_create(MFD_ALLOW_SEALING) and sealed with F_SEAL_SHRINK and
F_SEAL_GROW before it is sent, else it is refused. One program at a time has a ring and so the display; any
number of programs may send Status, Capture and Dark.

Refine starts a refinement of the next frame's picture with the camera, while it is displayed: as long as frames with
the same picture follow, they show the refinement's patterns. It ends by itself, with Refined; the best pattern is shown
as long as that picture is. Another picture ends it. Refine with 0 captures ends it and goes back to the solver's own
pattern. It does not change the lasers: it learns only from patterns that are lit.

Lasers: Clear (forget a latched fault), then Arm. Both are needed, in this order, after every fault and every
start; nothing else makes light. Dark always works.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import NamedTuple

from runtime.service.message_format import F32, U16, U32, U64, Magic, Text, Vocabulary

MAGIC = b"hololoop"
LOWEST, HIGHEST = 1, 1  # versions supported here
MOST_SLOTS = 16


class Hello(NamedTuple):
    """First message of a program: the versions that it supports."""

    magic: Magic
    lowest: U16
    highest: U16
    reserved: U32 = 0


class Welcome(NamedTuple):
    """The highest version that both support, and the display's properties."""

    version: U16
    channels: U16
    height: U32
    width: U32
    period_us: U32
    stale_limit_us: U32  # a pattern is lit no longer than this after its display time
    most_slots: U32


class Ring(NamedTuple):
    """Comes with the memfd: slots of `slot_bytes`, one after the other."""

    slots: U32
    slot_bytes: U32


class Done(NamedTuple):
    """The request was done."""


class Error(NamedTuple):
    """A request that was refused or, with `frame` above 0, an accepted frame that was not shown, and why."""

    code: U32
    frame: U32
    text: Text


class Wait(NamedTuple):
    """Asks for the next frame."""


class Timing(NamedTuple):
    """The frame to draw: when it will be displayed, and by when End must be sent for that."""

    display_ns: U64
    submit_by_ns: U64
    frame: U32
    period_us: U32


class Begin(NamedTuple):
    """Drawing of a frame begins."""

    frame: U32
    reserved: U32 = 0


class End(NamedTuple):
    """The frame is drawn, in this slot, with this CRC-32 (zlib's)."""

    frame: U32
    slot: U32
    crc: U32
    reserved: U32 = 0


class Shown(NamedTuple):
    """The frame's pattern was put on the panel; its slot is free."""

    display_ns: U64
    frame: U32
    slot: U32
    psnr_db: F32  # of amplitude, as the calibrated model predicts it
    flags: U32
    pattern_crc: U32  # of the gray levels that are wanted; a slow panel is sent others
    reserved: U32 = 0


class Status(NamedTuple):
    """Asks for the state of the headset."""


class State(NamedTuple):
    """The state of the headset.

    `panel`, `solver` and `camera` are a PartState, `lasers` is a LaserState, `laser_faults` are the bits of the safety
    controller's faults.
    """

    time_ns: U64
    shown: U64
    late: U64
    failed: U64
    lasers: U32
    laser_faults: U32
    panel: U32
    solver: U32
    camera: U32
    faults: U32  # of all kinds, since the start


class Clear(NamedTuple):
    """First step to light: forget a latched fault whose cause was removed."""


class Arm(NamedTuple):
    """Second step to light, within 5 s of Clear."""


class Dark(NamedTuple):
    """Lasers off at once; they stay off until Clear and Arm."""


class Capture(NamedTuple):
    """Asks for a picture from the camera."""


class Picture(NamedTuple):
    """Comes with a memfd, sealed against any change: counts, u16 [height][width]."""

    time_ns: U64
    height: U32
    width: U32
    bit_depth: U32
    exposure_us: U32


class Refine(NamedTuple):
    """Asks for a refinement of the next frame's picture, with at most so many captures; 0: end it."""

    captures: U32
    reserved: U32 = 0


class Refined(NamedTuple):
    """A refinement has ended, and why; amplitude PSNR of the captured picture, dB, at first and at best."""

    captures: U32
    first_psnr_db: F32
    best_psnr_db: F32
    text: Text


class PartState(IntEnum):
    """The state of a device or of a process."""

    ABSENT = 0  # the configuration has none
    FRESH = 1
    STALE = 2  # there, but its last sign of life is too old
    LOST = 3  # disconnected or ended; the service tries to open or start it again


class LaserState(IntEnum):
    """The state of the lasers."""

    OFF = 0
    ARMED = 1  # may emit; there is no fresh pattern
    EMITTING = 2
    FAULT = 3  # latched
    LOST = 4  # the safety controller does not answer: it switches the lasers off by itself


class Flags(IntFlag):
    """Flags of a frame that was shown."""

    LATE = 1  # after its predicted display time
    UNFINISHED = 2  # the best pattern so far: the solver had not finished


class Code(IntEnum):
    """Reasons of an Error."""

    MALFORMED = 1
    VERSION = 2
    ORDER = 3
    RING = 4
    SLOT = 5
    TORN = 6
    BUSY = 7
    SOLVER = 8
    PANEL = 9
    LASERS = 10
    CAMERA = 11
    REFUSED = 12
    STOPPING = 13


PROTOCOL = Vocabulary(
    {
        1: Hello,
        2: Welcome,
        3: Ring,
        4: Done,
        5: Error,
        6: Wait,
        7: Timing,
        8: Begin,
        9: End,
        10: Shown,
        11: Status,
        12: State,
        13: Clear,
        14: Arm,
        15: Dark,
        16: Capture,
        17: Picture,
        18: Refine,
        19: Refined,
    }
)


def agreed_version(hello: Hello) -> int | None:
    """The highest version that both sides support, or None."""
    version = min(hello.highest, HIGHEST)
    return version if version >= max(hello.lowest, LOWEST) else None
