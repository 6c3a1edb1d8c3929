"""What the supervisor and its two child processes say to each other.

supervisor  Targets, Job, Free, Ping      ->  solver    Patterns, Solved, Unsolved, Pong
supervisor  Refine, Look                  ->  solver    Refined
supervisor  Take                          ->  camera    Seen (answers Take with the picture), Missing
"""

from __future__ import annotations

from typing import NamedTuple

from runtime.service.messages import F32, U32, U64, Shares, Text, Vocabulary


class Ping(NamedTuple):
    """Asks for a sign of life."""


class Pong(NamedTuple):
    """The loop turns."""


class Patterns(NamedTuple):
    """The solver is ready; comes with the ring that its patterns will be in, uint8 [slots, C, H, W]."""

    slots: U32
    channels: U32
    height: U32
    width: U32


class Targets(NamedTuple):
    """A program's ring, which comes with it."""

    slots: U32


class Job(NamedTuple):
    """Solve the target in a slot of the program's ring; its bytes have this CRC-32."""

    deadline_ns: U64
    job: U32
    slot: U32
    crc: U32
    reserved: U32 = 0


# Flags of Solved: no better pattern is to come; the picture is black; the pattern is one of a refinement's.
FINAL, DARK, REFINED = 1, 2, 4


class Solved(NamedTuple):
    """A pattern for a job."""

    job: U32
    slot: U32
    crc: U32
    flags: U32
    psnr_db: F32
    solve_us: U32
    shares: Shares  # of its light in its brightest spots (eye_safety.spot_shares); zeros where it is not predicted


class Unsolved(NamedTuple):
    """A job that has no pattern, and why (a protocol.Code)."""

    job: U32
    code: U32
    text: Text


class Free(NamedTuple):
    """A pattern's slot may be used again."""

    slot: U32


class Refine(NamedTuple):
    """Refine the picture of the next job, and show its patterns for all jobs that have it; 0 captures: no more."""

    number: U32  # comes back in Refined
    captures: U32
    black: F32  # counts of the camera without light


class Look(NamedTuple):
    """What the camera saw while the pattern with this CRC-32 was displayed; comes with a memfd, as Picture."""

    crc: U32
    height: U32
    width: U32


class Refined(NamedTuple):
    """A refinement has ended, and why; amplitude PSNR of the captured picture, dB, at first and at best."""

    number: U32
    captures: U32
    first_psnr_db: F32
    best_psnr_db: F32
    text: Text


class Seen(NamedTuple):
    """The camera took a picture."""

    time_ns: U64
    height: U32
    width: U32
    bit_depth: U32
    exposure_us: U32


class Missing(NamedTuple):
    """The camera is not there or does not deliver, and why."""

    text: Text


class Take(NamedTuple):
    """Send the next picture whole."""


SOLVER = Vocabulary(
    {
        1: Ping,
        2: Pong,
        3: Patterns,
        4: Targets,
        5: Job,
        6: Solved,
        7: Unsolved,
        8: Free,
        9: Refine,
        10: Look,
        11: Refined,
    }
)
CAMERA = Vocabulary({1: Seen, 2: Missing, 3: Take})
