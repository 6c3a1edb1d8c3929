"""The service, unchanged, with a solver that also records its patterns: `python -m tests.campaigns.service CONFIG`.

The panel's frames are compared with this record: CRC-32 by CRC-32, written before the service gets the pattern. So are
its fields and the light that each of them had, where colours are shown in turn.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path

from firmware_iface.configured_devices import laser_numbers
from runtime.bundle.bundle_folder import read_bundle
from runtime.service import solver_process
from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import Pattern, shown_colours
from runtime.service.process_messages import SolveJob
from runtime.service.shared_memory import crc32
from runtime.service.supervisor import Supervisor

NOTES, FIELDS = "patterns.crc", "fields.crc"


def noted(folder: Path) -> set[int]:
    """CRC-32 of every pattern that a solver made for the configuration in `folder`."""
    data = (folder / NOTES).read_bytes()
    return {int.from_bytes(data[k : k + 4], "little") for k in range(0, len(data), 4)}


def noted_fields(folder: Path) -> set[tuple[int, int]]:
    """(CRC-32, mask of the lasers that may shine on it) of every pattern of a picture in several colours."""
    data = (folder / FIELDS).read_bytes()
    return {(int.from_bytes(data[k : k + 4], "little"), data[k + 4]) for k in range(0, len(data), 5)}


def solve(fd: str, configuration: str) -> None:
    """The solver's process."""
    notes, fields = (
        os.open(Path(configuration).with_name(name), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        for name in (NOTES, FIELDS)
    )
    publish = solver_process.Worker.publish
    settings = read_configuration(configuration)
    shown = shown_colours(settings, read_bundle(settings.bundle))
    lasers = laser_numbers(settings.devices["lasers"], shown)

    def note(
        worker: solver_process.Worker, job: SolveJob, pattern: Pattern, began_ns: int, refined: bool = False
    ) -> None:
        for field in pattern.gray:
            os.write(notes, crc32(field).to_bytes(4, "little"))
        for k, field in enumerate(pattern.gray if pattern.brightness else ()):
            laser = lasers[k % len(lasers)]
            if pattern.brightness[k % len(lasers)] > 0:
                os.write(fields, crc32(field).to_bytes(4, "little") + bytes([1 << laser]))
        publish(worker, job, pattern, began_ns, refined)

    solver_process.Worker.publish = note  # type: ignore[method-assign]
    solver_process.main(fd, configuration)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        try:
            solve(*sys.argv[1:])
        except ConnectionError:
            os._exit(0)
    else:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # it ends with its campaign
        supervisor = Supervisor(read_configuration(sys.argv[1]))
        supervisor.pipeline.solver.process.module = "tests.campaigns.service"
        supervisor.run()
