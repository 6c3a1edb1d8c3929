"""What a command is."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from runtime.program.outputs import Output
from runtime.program.screen import Screen

Result = dict[str, Any]


def _no_outputs(args: Namespace) -> Sequence[Output]:
    return ()


def _no_problems(result: Result) -> bool:
    return False


@dataclass(frozen=True)
class Command:
    """One command of a program.

    Attributes
    ----------
    name : str
        The word that chooses it.
    about : str
        Its purpose, one sentence for the list of commands.
    options : callable
        Declares its arguments in a parser.
    run : callable
        Does the work and returns the object that `--json` prints, as plain values.
    show : callable
        Shows that object to a person.
    examples : tuple of str
        Command lines that work, without the program's name.
    after : str
        What comes next.
    description : str
        What the command's own help says in place of `about`.
    more : str
        What the help says after the examples.
    outputs : callable
        Says what it will write, which is checked before it runs.
    problems : callable
        Whether the result says that something examined is faulty, which is exit code 1.
    """

    name: str
    about: str
    options: Callable[[ArgumentParser], None]
    run: Callable[[Namespace, Screen], Result]
    show: Callable[[Result, Namespace, Screen], None]
    examples: tuple[str, ...]
    after: str = ""
    description: str = ""
    more: str = ""
    outputs: Callable[[Namespace], Sequence[Output]] = _no_outputs
    problems: Callable[[Result], bool] = _no_problems

    def help_text(self, program: str) -> str:
        """The text at the head of the command's help."""
        lines = "".join(f"\n  {program} {example}" for example in self.examples)
        parts = [
            self.description or self.about,
            f"example{'s' * (len(self.examples) > 1)}:{lines}",
            self.more,
        ]
        if self.after:
            parts.append(f"next:\n  {self.after}")
        return "\n\n".join(part for part in parts if part)
