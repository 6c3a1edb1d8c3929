"""What a shell may complete a command line with, where argcomplete is installed."""

from __future__ import annotations

import os

from runtime.program.parser import ProgramParser


def complete(parser: ProgramParser) -> None:
    """Answer a shell that asks for completions, and end; return at once for every other start."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    import argcomplete

    argcomplete.autocomplete(parser.whole)
