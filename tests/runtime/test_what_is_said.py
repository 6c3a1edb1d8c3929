"""Progress as lines, --quiet, --verbose, --log, --csv, exit codes and completion, for every command."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from firmware_iface.errors import InputError
from runtime.cli import PROGRAM
from runtime.program.progress_lines import ProgressLines
from runtime.program.screen import Screen

ROOT = Path(__file__).resolve().parent.parent.parent


def show(result: dict[str, Any], args: Namespace, screen: Screen) -> None:
    screen.say("A sentence.")
    screen.table(("name", "value"), [("a", 1 / 3), ("b, c", None)], "first")
    screen.table(("", ""), [("x", 2)])


def program(run: Any = None, **given: Any) -> Any:
    """The program with one command without options."""

    def works(args: Namespace, screen: Screen) -> dict[str, Any]:
        with screen.progress("working") as progress:
            progress(0.5, "halfway")
            progress(0.6, "more")
        screen.note("a warning")
        return {"problems": 3}

    command = replace(
        PROGRAM.commands[0], name="work", options=lambda parser: None, run=run or works, show=show, **given
    )
    return replace(PROGRAM, commands=(command,))


def test_lines_come_now_and_then_and_short_work_says_nothing() -> None:
    now = 0.0
    lines: list[str] = []
    progress = ProgressLines("working", lines.append, every_s=10, clock=lambda: now)
    for now in range(0, 36, 5):
        progress(now / 40, f"step {now}")
    assert lines == ["25 % step 10 (10 s)", "50 % step 20 (20 s)", "75 % step 30 (30 s)"]


def test_work_that_does_not_say_what_it_does_still_does_the_same() -> None:
    now = 0.0
    lines: list[str] = []
    progress = ProgressLines("working", lines.append, every_s=10, each_step=True, clock=lambda: now)
    for at, done, what in (
        (10, 0.2, ""),
        (12, 0.3, "step"),
        (14, 0.4, ""),
        (24, 0.5, ""),
        (26, 0.6, "other"),
    ):
        now = at
        progress(done, what)
    assert lines == ["20 % working (10 s)", "30 % step (12 s)", "50 % step (24 s)", "60 % other (26 s)"]


def test_a_line_comes_also_while_the_work_itself_says_nothing() -> None:
    """A screen of all effects at full size says nothing for minutes."""
    lines: list[str] = []
    said = Event()

    def say(line: str) -> None:
        lines.append(line)
        if len(lines) == 2:
            said.set()

    progress = ProgressLines("working", say, every_s=0.05)
    progress(0.3, "screening")
    with progress.going_on():
        assert said.wait(60)
    assert all(line.startswith("30 % screening (") for line in lines)
    ended = len(lines)
    assert not Event().wait(0.2) and len(lines) == ended


def test_verbose_says_every_step_and_quiet_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert program().main(["work"]) == 0
    assert capsys.readouterr().err == "a warning\n"
    assert program().main(["work", "--verbose"]) == 0
    assert "50 % halfway (0 s)\n" in capsys.readouterr().err
    assert program().main(["work", "--quiet"]) == 0
    assert capsys.readouterr().err == "a warning\n"
    assert program().main(["work", "--quiet", "--verbose"]) == 2


def test_the_log_has_everything_with_times_and_grows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.txt"
    for _ in range(2):
        assert program().main(["work", "--log", str(log), "--quiet"]) == 0

    def fails(args: Namespace, screen: Screen) -> dict[str, Any]:
        raise InputError("the bench is wrong")

    assert program(fails).main(["work", "--log", str(log)]) == 2
    text = log.read_text()
    for said in ("50 % halfway", "a warning", "A sentence.", "b, c", "ends with exit code 0"):
        assert text.count(said) == 2, said
    assert "stopped by InputError: the bench is wrong" in text
    assert all(line[:2] == "20" and "T" in line[:20] for line in text.splitlines())
    capsys.readouterr()
    assert program().main(["work", "--log", str(tmp_path / "no" / "log")]) == 2
    assert "--log" in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_csv_holds_every_table_with_all_digits(
    more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tables.csv"
    words = ["work", "--csv", str(out), *more]
    assert program().main(words) == 0
    rows = list(csv.reader(out.open()))
    assert rows == [
        ["# first"],
        ["name", "value"],
        ["a", str(1 / 3)],
        ["b, c", ""],
        [],
        ["name", "value"],
        ["x", "2"],
    ]
    if more:
        assert capsys.readouterr().out == '{"problems": 3}\n'
    assert program().main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert program().main([*words, "--overwrite"]) == 0


def test_faults_that_were_found_are_exit_code_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert program(problems=lambda result: result["problems"] > 2).main(["work"]) == 1
    assert program(problems=lambda result: result["problems"] > 3).main(["work", "--json"]) == 0


@pytest.mark.parametrize("module", ["trainer", "runtime"])
def test_a_shell_gets_completions(module: str, tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    name = f"hololoop-{module}"
    line = f"{name} s" if module == "runtime" else f"{name} explain captures --ov"
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "found"),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    subprocess.run(
        [sys.executable, "-m", f"{module}.cli"], cwd=ROOT, env=environment, timeout=60, check=False
    )
    found = {word.strip() for word in (tmp_path / "found").read_text().split("\n")}
    assert found >= ({"solve", "show", "serve"} if module == "runtime" else {"--overwrite"})
