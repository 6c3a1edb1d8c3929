"""`hololoop-runtime`: the headset's program. Its commands are in runtime/commands/, a file each."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from runtime.commands import benchmark, calibrate, devices, refine, serve, show, solve
from runtime.program.program import Program

ABOUT = """Compute the patterns that look right through a calibrated bench.

The usual way:
  hololoop-runtime solve bundle/ picture.png --out pattern.png
  hololoop-runtime show pattern.png --headset headset.toml --out seen/

A bundle comes from the workstation: hololoop-trainer export --model model.toml --out bundle/"""

PROGRAM = Program(
    name="hololoop-runtime",
    about=ABOUT,
    commands=tuple(module.COMMAND for module in (solve, show, serve, calibrate, refine, devices, benchmark)),
    package="hololoop",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    return PROGRAM.main(argv)


if __name__ == "__main__":
    sys.exit(main())
