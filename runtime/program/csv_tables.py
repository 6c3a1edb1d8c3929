"""The file of `--csv`: the tables that a command prints."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.bundle.whole_files import whole_file


@dataclass(frozen=True)
class PrintedTable:
    """A table as it was printed.

    Attributes
    ----------
    columns : sequence of str
        Names; all empty where none are printed.
    rows : sequence of sequence
    title : str
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    title: str = ""


def write_tables(path: Path, tables: Sequence[PrintedTable]) -> None:
    """Write tables to one file, with an empty line between two of them; of several, a title is a line of its own.

    Numbers have all their digits; what is not known is empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for number, table in enumerate(tables):
        if number:
            text.write("\n")
        if table.title and len(tables) > 1:
            writer.writerow([f"# {table.title}"])
        columns = table.columns if any(table.columns) else ("name", "value")[: len(table.columns)]
        writer.writerow(columns)
        writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    with whole_file(path, "w") as file:
        file.write(text.getvalue())
