"""Captures that show the same gray levels are of one pattern, whatever the table calls them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image

from trainer.captures.capture_table import Capture


def one_name_each(captures: Sequence[Capture]) -> list[Capture]:
    """The captures, where those of one channel with the same gray levels have the name of the first of them.

    A file that cannot be read keeps its name: whoever opens the picture reports it.
    """
    contents = {path: _content(path) for path in {c.phase for c in captures}}
    first: dict[tuple[str, str], str] = {}
    return [replace(c, pattern=first.setdefault((c.channel, contents[c.phase]), c.pattern)) for c in captures]


def same_gray_levels(one: Capture, other: Capture) -> bool:
    """Whether two captures show the same gray levels; True where a file cannot be read, which its reader reports."""
    contents = {path: _content(path) for path in (one.phase, other.phase)}
    unread = any(content == str(path) for path, content in contents.items())
    return unread or len(set(contents.values())) == 1


def _content(path: Path) -> str:
    """A text that is the same for files of the same gray levels, and for no others."""
    try:
        about = path.stat()
        return _digest(path, about.st_mtime_ns, about.st_size)
    except Exception:  # any fault of the file is for its reader to report
        return str(path)


@lru_cache(maxsize=100_000)
def _digest(path: Path, changed: int, size: int) -> str:
    with Image.open(path, formats=["PNG"]) as picture:
        gray = np.asarray(picture)
    return hashlib.sha256(f"{gray.shape} {gray.dtype}".encode() + gray.tobytes()).hexdigest()
