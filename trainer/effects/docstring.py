"""What a docstring says of an effect: its first line, the paragraphs after it, and its references."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_SECTION = re.compile(r"^(?P<title>[A-Z][A-Za-z ]+)\n-{3,}\s*$", re.MULTILINE)  # as NumPy's style writes them


@dataclass(frozen=True)
class EffectText:
    """The words of an effect's docstring.

    Attributes
    ----------
    about : str
        The first line.
    description : str
        The paragraphs after it, up to the first section, each on one line.
    references : tuple of str
        The lines of the section `References`, one reference a paragraph.
    """

    about: str
    description: str
    references: tuple[str, ...]


def effect_text(function: Callable[..., Any]) -> EffectText:
    """The words of a function's docstring; the function's name where it has none."""
    text = inspect.getdoc(function) or str(getattr(function, "__name__", "effect"))
    sections = list(_SECTION.finditer(text))
    head = text[: sections[0].start()] if sections else text
    about, _, rest = head.partition("\n")
    references = ""
    for k, section in enumerate(sections):
        end = sections[k + 1].start() if k + 1 < len(sections) else len(text)
        if section["title"] == "References":
            references = text[section.end() : end]
    return EffectText(about, "\n\n".join(_paragraphs(rest)), tuple(_paragraphs(references)))


def _paragraphs(text: str) -> list[str]:
    return [" ".join(part.split()) for part in re.split(r"\n\s*\n", text) if part.strip()]
