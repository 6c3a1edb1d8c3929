"""Command lines for a person to type next."""

from __future__ import annotations

import shlex
from argparse import Namespace
from pathlib import Path

PROGRAM_NAME = "hololoop-trainer"


def command_line(*words: str | Path, args: Namespace | None = None, model: Path | None = None) -> str:
    """A command to type next.

    Parameters
    ----------
    words : str or Path
        The command and its arguments.
    args : Namespace, optional
        The present command's arguments: the same files of effects are named.
    model : Path, optional
        The model that is to be used.
    """
    line = [PROGRAM_NAME, *map(str, words)]
    if model is not None:
        line += ["--model", str(model)]
    for path in getattr(args, "effects", []) or []:
        line += ["--effects", str(path)]
    return shlex.join(line)
