"""The service, unchanged, with a solver that also records its patterns: `python -m tests.campaigns.service CONFIG`.

The panel's frames are compared with this record: CRC-32 by CRC-32, written before the service gets the pattern.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from pathlib import Path

from runtime.service import solver_process
from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import Pattern
from runtime.service.shared_memory import crc32
from runtime.service.supervisor import Supervisor

NOTES = "patterns.crc"


def noted(folder: Path) -> set[int]:
    """CRC-32 of every pattern that a solver made for the configuration in `folder`."""
    data = (folder / NOTES).read_bytes()
    return {int.from_bytes(data[k : k + 4], "little") for k in range(0, len(data), 4)}


def solve(fd: str, configuration: str) -> None:
    """The solver's process."""
    notes = os.open(Path(configuration).with_name(NOTES), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    publish = solver_process.Worker.publish

    def note(worker: solver_process.Worker, job: object, pattern: Pattern, began_ns: int) -> None:
        for field in pattern.gray:
            os.write(notes, crc32(field).to_bytes(4, "little"))
        publish(worker, job, pattern, began_ns)  # type: ignore[arg-type]

    solver_process.Worker.publish = note  # type: ignore[method-assign,assignment]
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
