"""Tests that must keep time say so: they use the fixture `real_time`, by which one of them runs at a time."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
# what runs a service, or lasers that go dark after 100 ms of silence
IMPORTED = {"open_guarded_lasers", "guard_process", "emulated", "hardware", "served", "urgent", "Lane"}
TYPED = ("--emulated",)


def keeps_time(source: str) -> bool:
    """Whether a test file imports or types something that must keep time."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and IMPORTED & {alias.name for alias in node.names}:
            return True
        if isinstance(node, ast.Constant) and node.value in TYPED:
            return True
    return False


@pytest.mark.parametrize(
    ("source", "answer"),
    [
        ("from runtime.headset.open_devices import emulated", True),
        ("from tests.campaigns.headset import (\n    SHAPE,\n    hardware,\n)", True),
        ("main(['show', 'pattern.png', '--emulated'])", True),
        ("from tests.campaigns.headset import write_configuration", False),
        ("'an emulated headset'", False),
    ],
)
def test_the_check_sees(source: str, answer: bool) -> None:
    assert keeps_time(source) == answer


def test_every_file_that_must_keep_time_asks_for_it() -> None:
    files = [path for path in TESTS.rglob("test_*.py") if path != Path(__file__)]
    sources = {path.relative_to(TESTS).as_posix(): path.read_text(encoding="utf-8") for path in files}
    timed = {name for name, source in sources.items() if keeps_time(source)}
    assert len(timed) > 15
    assert {name for name in timed if "real_time" not in sources[name]} == set()
