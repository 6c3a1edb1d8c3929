"""What a person sees: tables and sentences on stdout, progress and warnings on stderr.

Colour and moving bars are for terminals alone, and NO_COLOR turns colour off there.
"""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from runtime.program.csv_tables import PrintedTable
from runtime.program.log_file import Log, no_log
from runtime.program.plain_values import json_line
from runtime.program.progress import Progress
from runtime.program.progress_lines import EVERY_S, ProgressLines

PLAIN_WIDTH = 110  # columns where there is no terminal to ask
ANSI = re.compile(r"\x1b\[[0-9;]*m")  # the codes of colours


class Screen:
    """Standard output and error of one command.

    Parameters
    ----------
    out, err : text stream
        Where to write; by default the process's own at that moment.
    log : callable
        Takes all that is said as well.
    quiet : bool
        Nothing is said of the progress.
    verbose : bool
        A line is said for every step of the progress.

    Attributes
    ----------
    tables : list of PrintedTable
        Those that were printed.
    """

    def __init__(
        self,
        out: TextIO | None = None,
        err: TextIO | None = None,
        log: Log = no_log,
        quiet: bool = False,
        verbose: bool = False,
    ) -> None:
        # A process may have been started without stdout or stderr: then what it says goes nowhere.
        self.out: TextIO = out or sys.stdout or io.StringIO()
        self.err: TextIO = err or sys.stderr or io.StringIO()
        self.log, self.quiet, self.verbose = log, quiet, verbose
        self.tables: list[PrintedTable] = []

    def say(self, text: str = "", style: str = "") -> None:
        """One paragraph, as wide as it is."""
        from rich.text import Text

        self._print(Text(text, style=style), soft_wrap=True)

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
        self.tables.append(PrintedTable(columns, rows, title))
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
            table.add_row(*(Text(cell_text(cell)) for cell in row))
        self.say()
        self._print(table)

    def facts(self, values: Mapping[str, Any]) -> None:
        """A table of the words and numbers among some values, each with its name."""
        self.table(
            ("", ""),
            [(k.replace("_", " "), v) for k, v in values.items() if isinstance(v, str | int | float)],
        )

    def note(self, text: str) -> None:
        """A line on stderr; where nobody reads stderr any more, the work goes on."""
        self.log(one_line(text))
        self._note(text)

    def _note(self, text: str) -> None:
        """A line on stderr alone."""
        with suppress(BrokenPipeError):
            print(one_line(text), file=self.err)

    def json(self, value: Mapping[str, Any]) -> None:
        """One object on stdout, on one line."""
        line = json_line(value)
        self.log(line)
        self.out.write(line + "\n")

    @contextmanager
    def progress(self, title: str) -> Iterator[Progress]:
        """Give a callback that says how far the work is.

        It moves a bar on stderr if that is a terminal; elsewhere, and with `verbose`, it says a line now and then.
        """
        logged = ProgressLines(title, self.log, EVERY_S, each_step=True)
        if self.quiet:
            yield logged
            return
        if self.verbose or not self.err.isatty():
            said = ProgressLines(title, self._note, EVERY_S, each_step=self.verbose)

            def lines(done: float, what: str = "") -> None:
                said(done, what)
                logged(done, what)

            with said.going_on():
                yield lines
            return
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        columns = (
            BarColumn(30),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
        )
        with Bars(*columns, console=self._console(self.err), transient=True) as bars:
            task = bars.add_task(title, total=1.0)

            def progress(done: float, what: str = "") -> None:
                logged(done, what)
                bars.update(task, completed=min(max(done, 0.0), 1.0), description=what or None)

            yield progress

    def _print(self, what: Any, soft_wrap: bool = False) -> None:
        """Something of rich's on stdout; written here, since rich would end the process where stdout is closed."""
        console = self._console(self.out)
        with console.capture() as text:
            console.print(what, soft_wrap=soft_wrap)
        printed = text.get()
        self.log(ANSI.sub("", printed))
        self.out.write(printed)

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


def cell_text(value: Any) -> str:
    """A cell of a table."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return one_line(str(value))


def one_line(text: str) -> str:
    """Text on one line."""
    return " ".join(text.split())
