"""The process that turns pictures into patterns: `python -m runtime.service.solver_process FD CONFIGURATION`.

It takes one job at a time, writes each pattern into a slot of its own ring and sends a message about it. The supervisor
frees the slot when it has copied the pattern.
"""

from __future__ import annotations

import dataclasses
import os
import select
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from firmware_iface.errors import InputError
from runtime.service.child_processes import child_link
from runtime.service.configuration import Configuration, read_configuration
from runtime.service.frame_solver import Pattern, open_solver
from runtime.service.process_messages import (
    DARK,
    FINAL,
    REFINED,
    SOLVER,
    FailedJob,
    FreeSlot,
    OverdriveTables,
    PatternRing,
    Ping,
    Pong,
    RefinementCapture,
    RefinePicture,
    SolvedPattern,
    SolveJob,
    TargetRing,
)
from runtime.service.protocol import Code
from runtime.service.refinement_client import RefinementClient
from runtime.service.shared_memory import Ring, crc32, make_ring, open_ring, sealed_copy
from runtime.service.socket_link import MessageLink

SLOTS = 4
FULL_SCALE = 65535

Solve = Callable[[np.ndarray, int], Iterator[Pattern]]


class Worker:
    """The solver's loop: messages from the supervisor, and the jobs that are to be done.

    Parameters
    ----------
    shape : tuple of int
        (C, H, W) of a picture.
    fields : int
        Patterns of a picture.
    colours : sequence of str
        Their names.
    """

    def __init__(
        self,
        link: MessageLink,
        shape: tuple[int, int, int],
        fields: int,
        colours: Sequence[str],
        configuration: Configuration,
    ) -> None:
        self.link, self.shape, self.configuration = link, shape, configuration
        self.refinement_request: RefinePicture | None = None  # for the picture of the next job
        self.refinement: RefinementClient | None = None
        self.ring = make_ring(SLOTS, (fields, *shape[1:]), np.uint8)
        self.free = set(range(SLOTS))
        self.targets: Ring | None = None
        self.jobs: deque[SolveJob] = deque()
        self.solved: tuple[int, Pattern] | None = (
            None  # CRC-32 of the picture solved last, and its last pattern
        )
        link.send(PatternRing(SLOTS, fields, *shape, ",".join(colours)), fds=[self.ring.fd])

    def receive(self, wait: bool) -> None:
        """Receive one message; without `wait`, only if there is one."""
        if not wait and not select.select([self.link], [], [], 0)[0]:
            return
        _, message, fd = self.link.receive()
        match message:
            case Ping():
                self.link.send(Pong())
            case FreeSlot(slot):
                self.free.add(slot)
            case TargetRing(slots) if fd is not None:
                self.targets = open_ring(fd, slots, self.shape, np.uint16)
                self.targets.close()
                self.jobs.clear()
            case SolveJob():
                self.jobs.append(message)
            case RefinePicture():
                self.refinement_request = message if message.captures else None
                self.end_refinement()
            case RefinementCapture() if fd is not None:
                if self.refinement is not None:
                    self.refinement.take(message, fd)
                os.close(fd)

    def target(self, job: SolveJob) -> np.ndarray:
        """The picture of a job, float32 [C, H, W], 0 to 1.

        Raises
        ------
        InputError
            Where its bytes have changed.
        """
        if self.targets is None:
            raise InputError("there is no ring")
        counts = self.targets.slots[job.slot].copy()  # a copy, so that the bytes that are checked are used
        if crc32(counts) != job.crc:
            raise InputError("the picture in the slot is not the one that was announced: its CRC-32 differs")
        return counts.astype(np.float32) / FULL_SCALE

    def end_refinement(self) -> None:
        """Go back to the solver's own patterns."""
        if self.refinement is not None:
            self.refinement.stop()
            self.refinement = None

    def refined_pattern(self, job: SolveJob, target: np.ndarray) -> Pattern | None:
        """The refinement's pattern for a job; None where there is none."""
        if self.refinement_request is not None:
            self.refinement = RefinementClient(
                self.configuration, target, job.crc, self.refinement_request, self.link.send
            )
            self.refinement_request = None
            self.refinement.start()
        elif self.refinement is not None and self.refinement.crc != job.crc:
            self.end_refinement()
        return self.refinement.pattern if self.refinement is not None else None

    def kept_pattern(self, job: SolveJob) -> Pattern | None:
        """The pattern that a picture has, while its refinement makes the first one; None where the job is to be solved.

        A solver that went on until each deadline would leave the refinement no time.
        """
        if self.refinement is None or not self.refinement.is_alive() or self.solved is None:
            return None
        crc, pattern = self.solved
        return pattern if crc == job.crc else None

    def publish(self, job: SolveJob, pattern: Pattern, began_ns: int, refined: bool = False) -> None:
        """Send a pattern to the supervisor; waits for a free slot."""
        while not self.free:
            self.receive(wait=True)
        slot = self.free.pop()
        self.ring.slots[slot] = pattern.gray
        microseconds = (time.monotonic_ns() - began_ns) // 1000
        flags = FINAL * pattern.final | DARK * pattern.dark | REFINED * refined
        took_us = min(microseconds, 2**32 - 1)
        self.link.send(
            SolvedPattern(
                job.job,
                slot,
                crc32(pattern.gray),
                flags,
                pattern.psnr_db,
                took_us,
                struct.pack(f"<{len(pattern.shares)}f", *pattern.shares),
                struct.pack(f"<{len(pattern.brightness)}f", *pattern.brightness),
            )
        )

    def run(self, solve: Solve) -> None:
        """Serve until the supervisor closes the link."""
        while True:
            while not self.jobs:
                self.receive(wait=True)
            job = self.jobs.popleft()
            began = time.monotonic_ns()
            try:
                target = self.target(job)
            except InputError as error:
                self.link.send(FailedJob(job.job, Code.TORN, str(error)))
                continue
            if (refined := self.refined_pattern(job, target)) is not None:
                self.publish(job, refined, began, refined=True)
                continue
            if (kept := self.kept_pattern(job)) is not None:
                self.publish(job, kept, began)
                continue
            try:
                for pattern in solve(target, job.deadline_ns):
                    self.solved = job.crc, dataclasses.replace(pattern, final=True)
                    self.publish(job, pattern, began)
                    self.receive(wait=False)
            except InputError as error:
                self.link.send(FailedJob(job.job, Code.SOLVER, str(error)))


def main(fd: str, configuration: str) -> None:
    """Run the process until its supervisor closes the link."""
    link = child_link(fd, SOLVER)
    try:
        settings = read_configuration(configuration)
        solver = open_solver(settings)
    except InputError as error:
        link.send(FailedJob(0, Code.SOLVER, str(error)))
        return
    solver.rehearse()  # before the first frame, which would be silent for so long that it counted as hung
    if solver.overdrive is not None:
        tables = sealed_copy(solver.overdrive)
        link.send(OverdriveTables(len(solver.overdrive)), fds=[tables])
        os.close(tables)
    Worker(link, solver.shape, solver.fields, solver.colours, settings).run(solver.patterns)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except ConnectionError:
        os._exit(0)
