"""Captures that show the same gray levels are of one pattern, whatever the table calls them."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from trainer.captures.capture_table import Capture


def one_name_each(captures: Sequence[Capture]) -> list[Capture]:
    """The captures, where those of one channel with the same pattern file have the name of the first of them.

    Files are the same where they have the same path or the same bytes. Only files of equal size are read, since
    others cannot be the same. A file that cannot be read keeps its name: whoever opens the picture reports it.
    """
    contents = _contents({c.phase for c in captures})
    first: dict[tuple[str, str], str] = {}
    return [replace(c, pattern=first.setdefault((c.channel, contents[c.phase]), c.pattern)) for c in captures]


def _contents(paths: set[Path]) -> dict[Path, str]:
    """A text for each file that is the same for files of the same bytes."""
    sizes: dict[Path, int] = {}
    for path in paths:
        try:
            sizes[path] = path.stat().st_size
        except OSError:
            sizes[path] = -1
    number = Counter(sizes.values())
    found = {path: str(path) for path in paths}
    for path, size in sizes.items():
        if size >= 0 and number[size] > 1:
            try:
                with path.open("rb") as stream:
                    found[path] = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError:
                continue
    return found
