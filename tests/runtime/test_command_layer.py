"""What both programs have in common: names, help, JSON, exit codes, and a reader that goes away."""

from __future__ import annotations

import json
import os
import pkgutil
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import runtime.commands
import trainer.commands
from firmware_iface.errors import InputError
from runtime import cli as runtime_cli
from runtime.program.command import Command
from runtime.program.interrupt import Interrupted
from runtime.program.options import (
    comma_list,
    distances,
    exposure_ms,
    millimetres,
    milliseconds,
    number,
    one_of,
)
from runtime.program.program import Program
from runtime.program.progress import forward_only, part_of
from runtime.program.screen import Screen
from trainer import cli as trainer_cli

ROOT = Path(__file__).resolve().parent.parent.parent
PROGRAMS = [trainer_cli.PROGRAM, runtime_cli.PROGRAM]
BY_NAME = pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.name)


def started(program: Program, *words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own."""
    module = program.name.removeprefix("hololoop-") + ".cli"
    line = [sys.executable, "-m", module, *words]
    return subprocess.run(line, cwd=ROOT, text=True, timeout=60, check=False, **options)


def with_result(program: Program, result: dict[str, Any]) -> Program:
    """The program, its first command without options and with this result."""

    def run(args: Namespace, screen: Screen) -> dict[str, Any]:
        print("a library prints this")
        return result

    first = replace(program.commands[0], options=lambda parser: None, run=run)
    return replace(program, commands=(first,))


def failing(program: Program, error: BaseException) -> Program:
    """The program, its first command without options and with this error."""

    def run(args: Namespace, screen: Screen) -> dict[str, Any]:
        raise error

    first = replace(program.commands[0], options=lambda parser: None, run=run)
    return replace(program, commands=(first,))


@pytest.mark.parametrize(
    ("program", "package"),
    [(trainer_cli.PROGRAM, trainer.commands), (runtime_cli.PROGRAM, runtime.commands)],
    ids=["trainer", "runtime"],
)
def test_every_command_is_a_file_of_its_name(program: Program, package: ModuleType) -> None:
    modules = [import_module(f"{package.__name__}.{m.name}") for m in pkgutil.iter_modules(package.__path__)]
    commands = {m.__name__.rpartition(".")[2]: m.COMMAND for m in modules if hasattr(m, "COMMAND")}
    assert all(isinstance(command, Command) for command in commands.values())
    assert {name: c.name for name, c in commands.items()} == {
        c.name.replace("-", "_"): c.name for c in program.commands
    }
    assert {id(c) for c in commands.values()} == {id(c) for c in program.commands}
    assert not [
        m.__name__ for m in modules if len([v for v in vars(m).values() if isinstance(v, Command)]) > 1
    ]


@BY_NAME
def test_the_programs_start_without_what_is_heavy(program: Program) -> None:
    module = program.name.removeprefix("hololoop-") + ".cli"
    script = (
        f"import sys; from {module} import main; main(['--help'])\n"
        "print(sorted({'numpy', 'scipy', 'PIL', 'cv2', 'torch', 'rich'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


@BY_NAME
def test_a_number_that_is_none_is_null(program: Program, capsys: pytest.CaptureFixture[str]) -> None:
    result = {
        "nan": float("nan"),
        "deep": [{"infinity": float("inf")}, (float("-inf"), 1.5)],
        "array": np.array([np.nan, 2.0], np.float32),
        "scalar": np.float64("nan"),
    }
    program = with_result(program, result)
    assert program.main([program.commands[0].name, "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert found == {
        "nan": None,
        "deep": [{"infinity": None}, [None, 1.5]],
        "array": [None, 2.0],
        "scalar": None,
    }
    assert out.count("\n") == 1
    assert "a library prints this" in err


@BY_NAME
@pytest.mark.parametrize("words", [["--help"], ["--version"], []])
def test_a_reader_that_goes_away_is_no_error(program: Program, words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = started(program, *words, stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (trainer_cli.PROGRAM, ["effects", "--json"]),
        (trainer_cli.PROGRAM, ["effects"]),
        (runtime_cli.PROGRAM, ["devices", "--json"]),
        (runtime_cli.PROGRAM, ["devices"]),
    ],
)
def test_a_reader_that_goes_away_before_the_result_is_no_error(program: Program, words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = started(program, *words, stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@BY_NAME
def test_a_pipe_that_breaks_within_the_work_is_not_stdouts(
    program: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    program = failing(program, BrokenPipeError(32, "Broken pipe"))
    assert program.main([program.commands[0].name]) == 2
    assert capsys.readouterr().err == f"{program.name}: Broken pipe\n"


@BY_NAME
def test_the_version_has_one_shape(program: Program, capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    assert program.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{program.name} {version('hololoop')}\n"


@pytest.mark.parametrize(
    ("program", "line", "message"),
    [
        (trainer_cli.PROGRAM, "check x --jsn", "check has no option --jsn: did you mean '--json'?"),
        (
            trainer_cli.PROGRAM,
            "export --modl m.toml --out b",
            "export has no option --modl: did you mean '--model'?",
        ),
        (
            trainer_cli.PROGRAM,
            "--versoin",
            "hololoop-trainer has no option --versoin: did you mean '--version'?",
        ),
        (
            trainer_cli.PROGRAM,
            "effects a b",
            "'b' is one argument too many for effects; see: hololoop-trainer effects",
        ),
        (trainer_cli.PROGRAM, "expalin x", "there is no command 'expalin': did you mean 'explain'?"),
        (
            runtime_cli.PROGRAM,
            "solve b p --out o --fitt",
            "solve has no option --fitt: did you mean '--fit'?",
        ),
        (runtime_cli.PROGRAM, "solve b p --ot=o.png", "solve has no option --ot: did you mean '--out'?"),
        (
            runtime_cli.PROGRAM,
            "--versoin",
            "hololoop-runtime has no option --versoin: did you mean '--version'?",
        ),
        (
            runtime_cli.PROGRAM,
            "devices a b",
            "'b' is one argument too many for devices; see: hololoop-runtime devices",
        ),
        (runtime_cli.PROGRAM, "devises", "there is no command 'devises': did you mean 'devices'?"),
        (runtime_cli.PROGRAM, "help slove", "there is no command 'slove': did you mean 'solve'?"),
        (runtime_cli.PROGRAM, "hlep", "there is no command 'hlep': did you mean 'help'?"),
    ],
)
def test_the_nearest_name_is_suggested(
    program: Program, line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.main(line.split()) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"{program.name}: {message}")


@BY_NAME
def test_help_is_a_word_too(program: Program, capsys: pytest.CaptureFixture[str]) -> None:
    name = program.commands[1].name
    pages = []
    for words in (["--help"], ["help"], [name, "--help"], ["help", name]):
        assert program.main(words) == 0
        pages.append(capsys.readouterr().out)
    assert pages[0] == pages[1]
    assert pages[2] == pages[3]
    assert pages[0] != pages[2]


@BY_NAME
def test_every_example_can_be_parsed_and_help_shows_it(
    program: Program, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in program.commands:
        assert program.main([command.name, "--help"]) == 0
        page = capsys.readouterr().out
        for example in command.examples:
            assert f"  {program.name} {example}\n" in page
            assert program.parser().parse(example.split()).chosen is command


@BY_NAME
@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted; what was finished is kept, and nothing is half written"),
        (Interrupted("interrupted; one file is there"), 130, "interrupted; one file is there"),
        (OSError(28, "No space left on device", "x.toml"), 2, "x.toml: No space left on device"),
        (MemoryError(), 2, "there is not enough memory"),
        (InputError("two\nlines"), 2, "two lines"),
        (
            ModuleNotFoundError("no module", name="rare"),
            2,
            "rare is not installed; get it with: pip install 'hololoop",
        ),
    ],
)
def test_what_goes_wrong_is_one_line(
    program: Program, error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    program = failing(program, error)
    assert program.main([program.commands[0].name, "--json"]) == code
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith(f"{program.name}: {message}")


def test_ctrl_c_in_code_made_from_text_keeps_the_exit_code(tmp_path: Path) -> None:
    """As in a dataclass that a module defines while it is imported."""
    (tmp_path / "interrupted.py").write_text(
        "import sys\n"
        "from runtime import cli\n"
        "from runtime.program.program import Program\n"
        "def interrupt(*_):\n"
        "    exec('import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(9)')\n"
        "Program._main = interrupt\n"
        "sys.exit(cli.main())\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.startswith("hololoop-runtime: interrupted; ")


@BY_NAME
def test_our_own_missing_modules_are_not_the_users_fault(program: Program) -> None:
    program = failing(program, ModuleNotFoundError("no module", name="runtime.nothing"))
    with pytest.raises(ModuleNotFoundError):
        program.main([program.commands[0].name])


@BY_NAME
def test_a_program_without_stdout_does_its_work(program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    program = with_result(program, {"done": True})
    monkeypatch.setattr(sys, "stdout", None)
    assert program.main([program.commands[0].name, "--json"]) == 0


@pytest.mark.parametrize(
    ("read", "text", "value", "bad", "message"),
    [
        (number(0, 1), "0.5", 0.5, "nan", "'nan' is not a number from 0 to 1"),
        (milliseconds, "12", 12.0, "-1", "'-1' is not a time in ms"),
        (exposure_ms, "8", 8.0, "20000", "'20000' is not an exposure in ms"),
        (millimetres, "-3.5", -3.5, "inf", "'inf' is not a distance in mm"),
        (comma_list, "a, b", ["a", "b"], "a,,b", "'a,,b' is not a list of words"),
        (distances, "1,2.5", [1.0, 2.5], "1,b", "'b' is not a number from -2000 to 2000"),
        (
            one_of(["panel", "pupil"], "a stage"),
            "panel",
            "panel",
            "pannel",
            "'pannel' is not a stage; did you mean",
        ),
    ],
)
def test_options_are_read_or_refused_with_a_sentence(
    read: Any, text: str, value: Any, bad: str, message: str
) -> None:
    from argparse import ArgumentTypeError

    assert read(text) == value
    with pytest.raises(ArgumentTypeError) as caught:
        read(bad)
    assert str(caught.value).startswith(message)


def test_a_part_of_the_work_says_its_share_of_the_whole() -> None:
    said: list[tuple[float, str]] = []
    part = part_of(lambda done, what="": said.append((done, what)), 0.6, 1.0, "the rest")
    part(0)
    part(0.5, "half of it")
    part(1)
    assert said == [
        (pytest.approx(0.6), "the rest"),
        (pytest.approx(0.8), "the rest: half of it"),
        (pytest.approx(1.0), ""),
    ]


def test_progress_does_not_go_back_where_work_begins_again() -> None:
    said: list[tuple[float, str]] = []
    told = forward_only(lambda done, what="": said.append((done, what)))
    for done, what in ((0.1, "a"), (0.3, "a"), (0.0, "b"), (0.2, "b"), (0.4, "b")):
        told(done, what)
    assert said == [(0.1, "a"), (0.3, "a"), (0.3, "b"), (0.3, "b"), (0.4, "b")]
