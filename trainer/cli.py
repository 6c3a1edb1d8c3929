"""`hololoop-trainer`: the workstation's program. Its commands are in trainer/commands/, a file each."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from runtime.program.program import Program
from trainer.commands import (
    add,
    capture,
    check,
    compare,
    demo,
    diagnose,
    effects,
    evaluate,
    explain,
    export,
    field,
    fleet,
    initialiser,
    loop,
    new_effect,
    next,
    propose,
    register,
    response,
    studio,
    train,
)
from trainer.commands.command_line import PROGRAM_NAME

ABOUT = """Learn how a holographic display's bench differs from its model, from camera captures.

The usual way:
  hololoop-trainer check captures/                        is the capture set sound?
  hololoop-trainer compare captures/                      how far off is the ideal model, and where?
  hololoop-trainer explain captures/ --out model.toml     what is missing, effect after effect
  hololoop-trainer next captures/ --model model.toml --count 4 --out patterns/     captures that decide what is in doubt
  hololoop-trainer field captures/ --model model.toml --out learned.toml     stripes, dust: the wave at the panel
  hololoop-trainer train captures/ --model model.toml --out run/     a network for what has no name
  hololoop-trainer export --model model.toml --out bundle/

All of it in a browser, with or without captures: hololoop-trainer studio
Without captures at hand, start with: hololoop-trainer demo --quick"""

IN_ORDER_OF_USE = (
    check,
    compare,
    diagnose,
    add,
    explain,
    next,
    field,
    train,
    fleet,
    loop,
    evaluate,
    effects,
    new_effect,
    propose,
    capture,
    export,
    demo,
    studio,
    initialiser,
    register,
    response,
)

PROGRAM = Program(
    name=PROGRAM_NAME,
    about=ABOUT,
    commands=tuple(module.COMMAND for module in IN_ORDER_OF_USE),
    package="hololoop[trainer]",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    return PROGRAM.main(argv)


if __name__ == "__main__":
    sys.exit(main())
