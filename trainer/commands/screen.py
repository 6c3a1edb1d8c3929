"""What a person sees: tables and sentences on stdout, progress and warnings on stderr.

Colour and moving bars are for terminals alone, and NO_COLOR turns colour off there.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

Progress = Callable[..., None]

PLAIN_WIDTH = 110  # columns where there is no terminal to ask


class Screen:
    """Standard output and error of one command.

    out, err : where to write; by default the process's own at that moment
    """

    def __init__(self, out: TextIO | None = None, err: TextIO | None = None) -> None:
        self.out, self.err = out or sys.stdout, err or sys.stderr

    def say(self, text: str = "", style: str = "") -> None:
        """One paragraph, as wide as it is."""
        from rich.text import Text

        self._console(self.out).print(Text(text, style=style), soft_wrap=True)

    def next(self, line: str, why: str = "Next") -> None:
        """The command to type next, on a line of its own."""
        self.say()
        self.say(f"{why}:")
        self.say(f"  {line}", style="bold")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[Any]], title: str = "") -> None:
        """A table; numbers stand on the right."""
        from rich.table import Table
        from rich.text import Text

        if not rows:
            return
        table = Table(
            title=title or None,
            title_justify="left",
            title_style="bold",
            box=None,
            show_header=any(columns),
            pad_edge=False,
            header_style="dim",
            padding=(0, 2, 0, 0),
        )
        for k, name in enumerate(columns):
            right = all(isinstance(row[k], (int, float)) or row[k] is None for row in rows)
            table.add_column(name, justify="right" if right else "left", overflow="fold")
        for row in rows:
            table.add_row(*(Text(shown(cell)) for cell in row))
        self.say()
        self._console(self.out).print(table)

    def note(self, text: str) -> None:
        """A line on stderr."""
        print(one_line(text), file=self.err)

    def json(self, value: Mapping[str, Any]) -> None:
        """One object on stdout, on one line."""
        self.out.write(json.dumps(plain(value), allow_nan=False) + "\n")

    @contextmanager
    def progress(self, what: str) -> Iterator[Progress]:
        """Gives a callback `(share done, what is going on)`; a moving bar on stderr if that is a terminal."""
        if not self.err.isatty():
            yield lambda done, text="": None
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = (
            BarColumn(30),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
        )
        with Progress(*columns, console=self._console(self.err), transient=True) as bar:
            task = bar.add_task(what, total=1.0)

            def told(done: float, text: str = "") -> None:
                bar.update(task, completed=min(max(done, 0.0), 1.0), description=text or what)

            yield told

    def _console(self, stream: TextIO) -> Any:
        from rich.console import Console

        terminal = stream.isatty()
        return Console(
            file=stream,
            force_terminal=terminal,
            width=None if terminal else PLAIN_WIDTH,
            highlight=False,
            markup=False,
            emoji=False,
            legacy_windows=False,
        )


def shown(value: Any) -> str:
    """A cell of a table."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return one_line(str(value))


def plain(value: Any) -> Any:
    """A value as JSON can hold it: NumPy's scalars and arrays as Python's, numbers that are none as null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    return str(value)


def one_line(text: str) -> str:
    """Text on one line."""
    return " ".join(text.split())
