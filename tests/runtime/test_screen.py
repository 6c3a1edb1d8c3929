"""What a command shows: colour and progress for terminals alone, numbers with errors, and plain JSON."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from runtime.program.plain_values import plain
from runtime.program.screen import Screen


def test_colour_is_for_terminals_and_no_color_turns_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    def page(stream: io.StringIO) -> str:
        screen = Screen(stream, io.StringIO())
        screen.say("hello [world]", style="red")
        screen.table(("a", "b"), [("x [y]", 1.5)])
        return stream.getvalue()

    for variable in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    assert "\x1b[31m" in page(Terminal())
    assert "\x1b" not in page(io.StringIO())
    monkeypatch.setenv("NO_COLOR", "1")
    assert "[31m" not in page(Terminal())
    assert "hello [world]" in page(io.StringIO())


def test_progress_is_for_terminals() -> None:
    err = io.StringIO()
    with Screen(io.StringIO(), err).progress("fitting") as progress:
        progress(0.5, "half")
        progress(1.0)
    assert err.getvalue() == ""


def test_numbers_are_made_plain() -> None:
    found = plain(
        {"a": np.float32(0.5), "b": np.arange(2), "c": float("inf"), "d": (1, None, True), "e": Path("x")}
    )
    assert found == {"a": 0.5, "b": [0, 1], "c": None, "d": [1, None, True], "e": "x"}
