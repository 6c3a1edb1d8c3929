"""The process that turns pictures into patterns: `python -m runtime.service.solver_process FD CONFIGURATION`.

It takes one job at a time, writes each pattern into a slot of its own ring and says so; the supervisor gives
the slot back when it has taken the pattern.
"""

from __future__ import annotations

import os
import select
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from firmware_iface.errors import InputError
from runtime.service.children import child_link
from runtime.service.configuration import Configuration, read_configuration
from runtime.service.frame_solver import Pattern, open_solver
from runtime.service.inside import (
    DARK,
    FINAL,
    REFINED,
    SOLVER,
    Free,
    Job,
    Look,
    Patterns,
    Ping,
    Pong,
    Refine,
    Solved,
    Targets,
    Unsolved,
)
from runtime.service.link import Link
from runtime.service.protocol import Code
from runtime.service.refining import Refiner
from runtime.service.ring import Ring, crc32, make_ring, open_ring, read_sealed

SLOTS = 4
FULL_SCALE = 65535

Solve = Callable[[np.ndarray, int], Iterator[Pattern]]


class Worker:
    """The solver's loop: what came over the link, and what is being done about it."""

    def __init__(self, link: Link, shape: tuple[int, int, int], configuration: Configuration) -> None:
        self.link, self.shape, self.configuration = link, shape, configuration
        self.asked: Refine | None = None  # of a refinement that begins with the next job
        self.refiner: Refiner | None = None
        self.ring = make_ring(SLOTS, shape, np.uint8)
        self.free = set(range(SLOTS))
        self.targets: Ring | None = None
        self.jobs: deque[Job] = deque()
        link.send(Patterns(SLOTS, *shape), fds=[self.ring.fd])

    def receive(self, wait: bool) -> None:
        """Take one message, if there is one; with `wait`, when there is one."""
        if not wait and not select.select([self.link], [], [], 0)[0]:
            return
        _, message, fd = self.link.receive()
        match message:
            case Ping():
                self.link.send(Pong())
            case Free(slot):
                self.free.add(slot)
            case Targets(slots) if fd is not None:
                self.targets = open_ring(fd, slots, self.shape, np.uint16)
                self.targets.close()
                self.jobs.clear()
            case Job():
                self.jobs.append(message)
            case Refine():
                self.asked = message if message.captures else None
                self.refine_no_more()
            case Look(crc, height, width) if fd is not None:
                counts = read_sealed(fd, (height, width), np.uint16)
                if self.refiner is not None:
                    self.refiner.look(crc, counts)

    def target(self, job: Job) -> np.ndarray:
        """The picture of a job, float32 [C, H, W], 0 to 1. Raises InputError where its bytes changed."""
        if self.targets is None:
            raise InputError("there is no ring")
        counts = self.targets.slots[job.slot].copy()  # what is checked is what is used
        if crc32(counts) != job.crc:
            raise InputError("the picture in the slot is not the one that was announced: its CRC-32 differs")
        return counts.astype(np.float32) / FULL_SCALE

    def refine_no_more(self) -> None:
        """The solver's own pattern again."""
        if self.refiner is not None:
            self.refiner.stop()
            self.refiner = None

    def refined(self, job: Job, target: np.ndarray) -> Pattern | None:
        """What a refinement has for a job; none where the job is to be solved."""
        if self.asked is not None:
            self.refiner = Refiner(self.configuration, target, job.crc, self.asked, self.link.send)
            self.asked = None
            self.refiner.start()
        elif self.refiner is not None and self.refiner.crc != job.crc:
            self.refine_no_more()
        return self.refiner.pattern if self.refiner is not None else None

    def publish(self, job: Job, pattern: Pattern, began_ns: int, refined: bool = False) -> None:
        """Hand a pattern over; waits for a free slot."""
        while not self.free:
            self.receive(wait=True)
        slot = self.free.pop()
        self.ring.slots[slot] = pattern.gray
        microseconds = (time.monotonic_ns() - began_ns) // 1000
        flags = FINAL * pattern.final | DARK * pattern.dark | REFINED * refined
        shares = struct.pack("<13f", *pattern.shares) if pattern.shares else bytes(52)
        took_us = min(microseconds, 2**32 - 1)
        self.link.send(Solved(job.job, slot, crc32(pattern.gray), flags, pattern.psnr_db, took_us, shares))

    def run(self, solve: Solve) -> None:
        """Serve until the supervisor goes."""
        while True:
            while not self.jobs:
                self.receive(wait=True)
            job = self.jobs.popleft()
            began = time.monotonic_ns()
            try:
                target = self.target(job)
            except InputError as error:
                self.link.send(Unsolved(job.job, Code.TORN, str(error)))
                continue
            if (refined := self.refined(job, target)) is not None:
                self.publish(job, refined, began, refined=True)
                continue
            try:
                for pattern in solve(target, job.deadline_ns):
                    self.publish(job, pattern, began)
                    self.receive(wait=False)
            except InputError as error:
                self.link.send(Unsolved(job.job, Code.SOLVER, str(error)))


def main(fd: str, configuration: str) -> None:
    """Run the process until its supervisor closes the link."""
    link = child_link(fd, SOLVER)
    try:
        asked = read_configuration(configuration)
        solver = open_solver(asked)
    except InputError as error:
        link.send(Unsolved(0, Code.SOLVER, str(error)))
        return
    for _ in solver.patterns(np.ones(solver.shape, np.float32), time.monotonic_ns()):
        pass  # what is made at the first use is made before the first frame
    Worker(link, solver.shape, asked).run(solver.patterns)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except ConnectionError:
        os._exit(0)
