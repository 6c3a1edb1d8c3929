"""Messages between the supervisor and its two child processes, and between the solver and its own.

From the supervisor to the solver   TargetRing, SolveJob, FreeSlot, RefinePicture, RefinementCapture, Ping
From the solver to the supervisor   OverdriveTables, PatternRing, SolvedPattern, FailedJob, RefinementEnd, Pong
From the supervisor to the camera   TakePicture
From the camera to the supervisor   CameraPicture (the answer to TakePicture has the picture), CameraMissing
From the solver to the refinement   RefinementTarget, RefinementCapture, StopRefinement
From the refinement to the solver   RefinedPattern, RefinementEnd
"""

from __future__ import annotations

from typing import NamedTuple

from runtime.service.message_format import F32, U32, U64, Brightness, Shares, Text, Vocabulary


class Ping(NamedTuple):
    """Asks for a sign of life."""


class Pong(NamedTuple):
    """A sign of life: the loop runs."""


class PatternRing(NamedTuple):
    """The solver is ready; comes with the ring for its patterns, uint8 [slots, fields, H, W]."""

    slots: U32
    fields: U32  # of a frame: a pattern each, of all channels in turn, as often as each has patterns
    channels: U32
    height: U32
    width: U32
    colours: Text  # their names, in this order, with commas


class OverdriveTables(NamedTuple):
    """What to send to a slow panel; comes before PatternRing, with a memfd: uint8 [channels, 3, 256, 256]."""

    channels: U32


class TargetRing(NamedTuple):
    """A program's ring of pictures; comes with its descriptor."""

    slots: U32


class SolveJob(NamedTuple):
    """Solve the target in a slot of the program's ring; its bytes have this CRC-32."""

    deadline_ns: U64
    job: U32
    slot: U32
    crc: U32
    reserved: U32 = 0


# Flags of SolvedPattern: no better pattern follows; the picture is black; the pattern is one of a refinement's.
FINAL, DARK, REFINED = 1, 2, 4


class SolvedPattern(NamedTuple):
    """A pattern for a job."""

    job: U32
    slot: U32
    crc: U32
    flags: U32
    psnr_db: F32
    solve_us: U32
    shares: Shares  # 13 f32 a colour: of its light in its brightest spots (eye_safety.spot_shares); 0: not predicted
    brightness: Brightness  # f32 a colour: for how much of its fields' light it is lit; 0: dark


class FailedJob(NamedTuple):
    """A job that has no pattern, and why (a protocol.Code); job 0: the solver cannot work at all."""

    job: U32
    code: U32
    text: Text


class FreeSlot(NamedTuple):
    """A pattern's slot may be used again."""

    slot: U32


class RefinePicture(NamedTuple):
    """Refine the picture of the next job, and show its patterns for all jobs that have it; 0 captures: stop."""

    number: U32  # comes back in RefinementEnd
    captures: U32
    black: F32  # counts of the camera without light


class RefinementCapture(NamedTuple):
    """A capture of the display while it showed the pattern with this CRC-32; comes with a memfd, as Picture."""

    crc: U32
    height: U32
    width: U32


class RefinementTarget(NamedTuple):
    """The picture to refine, with a memfd, float32 [1, H, W]; otherwise as RefinePicture."""

    number: U32
    captures: U32
    black: F32
    height: U32
    width: U32


class RefinedPattern(NamedTuple):
    """The refinement wants this pattern displayed and captured; comes with a memfd, uint8 [1, H, W]."""

    crc: U32
    height: U32
    width: U32
    psnr_db: F32
    shares: Shares  # of one colour, as in SolvedPattern


class StopRefinement(NamedTuple):
    """The picture is no longer displayed."""


class RefinementEnd(NamedTuple):
    """A refinement has ended, and why; amplitude PSNR of the captured picture, dB, at first and at best."""

    number: U32
    captures: U32
    first_psnr_db: F32
    best_psnr_db: F32
    text: Text


class CameraPicture(NamedTuple):
    """The camera took a picture; comes with a memfd where it was asked for."""

    time_ns: U64
    height: U32
    width: U32
    bit_depth: U32
    exposure_us: U32


class CameraMissing(NamedTuple):
    """The camera is not there or does not deliver, and why."""

    text: Text


class TakePicture(NamedTuple):
    """Send the next picture whole."""


SOLVER = Vocabulary(
    {
        1: Ping,
        2: Pong,
        3: PatternRing,
        4: TargetRing,
        5: SolveJob,
        6: SolvedPattern,
        7: FailedJob,
        8: FreeSlot,
        9: RefinePicture,
        10: RefinementCapture,
        11: RefinementEnd,
        12: OverdriveTables,
    }
)
REFINEMENT = Vocabulary(
    {1: RefinementTarget, 2: RefinementCapture, 3: StopRefinement, 4: RefinedPattern, 5: RefinementEnd}
)
CAMERA = Vocabulary({1: CameraPicture, 2: CameraMissing, 3: TakePicture})
