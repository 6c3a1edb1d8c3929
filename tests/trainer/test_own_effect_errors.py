"""A user's effect that fails: one line with the file, the line and what came back, and exit code 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainer.cli import main
from trainer.effects import effect_catalogue, testing
from trainer.effects.effect_catalogue import load_effects

HEAD = """import math
import sys
from dataclasses import replace
import torch
from trainer.effects import Parameter, effect, bare_stages
"""
DECORATED = """
@effect(stage="{stage}", acts_on="camera", {more}parameters=[Parameter("size", "1", scale=0.1, low=-1, high=1)])
def odd(stage, size):
    'Something odd.'
    {body}
"""
GOOD = "return stage.multiplied(1 + size * stage.y)"


def effect_text(body: str = GOOD, stage: str = "sensor", more: str = "", before: str = "") -> str:
    return HEAD + before + DECORATED.format(stage=stage, body=body, more=more)


def starting(body: str) -> str:
    """An effect whose starting points come from a function with this body."""
    return effect_text(more="starts=found, ", before=f"\ndef found(evidence):\n    {body}\n")


def measuring(body: str) -> str:
    """An effect whose value comes from a measurement with this body."""
    return effect_text(more="measure=read, ", before=f"\ndef read(evidence):\n    {body}\n")


def line_with(text: str, piece: str) -> int:
    return next(k for k, line in enumerate(text.splitlines(), 1) if piece in line)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture set in which rows differ in sensitivity."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "tilt.py").write_text(effect_text())
    testing.captures_with(folder / "set", load_effects(folder / "tilt.py")[0], {"size": 0.2}, patterns=3)
    return folder / "set"


def refusal(capfd: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line that a command ends with, as it ends with exit code 2."""
    capfd.readouterr()
    assert main([*map(str, words), "--quiet"]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1 and "Traceback" not in err, err
    return err


@pytest.mark.parametrize(
    ("body", "stage", "piece", "says"),
    [
        ("raise ValueError('no\\nsuch thing')", "sensor", "raise", "ValueError: no such thing"),
        ("return stage.multiplied(size @ size)", "sensor", "size @", "RuntimeError: "),
        ("return 1 / 0", "pupil", "1 / 0", "ZeroDivisionError: division by zero"),
        ("sys.exit(0)", "sensor", "sys.exit", "it ends the program (SystemExit)"),
        ("pass", "sensor", "def odd", "returned None: return the Sensor that it is given, changed"),
        ("return stage.y * size", "panel", "def odd", "returned a value of type Tensor: return the Panel"),
        (
            "from trainer.effects.testing import small_bench; from trainer.prediction.scene import scene_at; "
            "return bare_stages(scene_at(small_bench(), 'green', 6.0, 'angular_spectrum', 1.0, torch.float32)).panel",
            "sensor",
            "def odd",
            "returned a value of type Panel: return the Sensor",
        ),
        (
            "return stage.multiplied(1 + size * torch.ones(5, 7))",
            "sensor",
            "def odd",
            "returned a Sensor whose gain has the shape [5, 7] at size = 0",
        ),
        (
            "return replace(stage, response=stage.response[:3] * (1 + size))",
            "drive",
            "def odd",
            "whose response has the shape [3] at size = 0: give a tensor [256]",
        ),
        ("return replace(stage, source=None)", "panel", "def odd", "whose source is None"),
        (
            "return stage.delayed(torch.zeros(2, 3) * size)",
            "pupil",
            "def odd",
            "whose path_difference has the shape [2, 3]",
        ),
        ("return stage.displaced(size, size)", "sensor", "def odd", "whose displacement has the shape []"),
        (
            "return stage.multiplied(stage.y * math.nan)",
            "sensor",
            "def odd",
            "whose gain has NaN or infinite values",
        ),
        (
            "return stage.multiplied(1 + size / size)",
            "panel",
            "def odd",
            "whose source has NaN or infinite values",
        ),
        ("return replace(stage, distance='far')", "pupil", "def odd", "whose distance is of type str"),
        (
            "return stage.responding(lambda share: share[0])",
            "sensor",
            "def odd",
            "response curve of effect 'odd'",
        ),
        ("return stage.responding(lambda share: 1 / 0)", "sensor", "lambda", "ZeroDivisionError"),
        (
            "return stage.responding(lambda share: share / 0)",
            "sensor",
            "def odd",
            "NaN or infinite values: let it",
        ),
    ],
)
def test_what_an_effects_function_did_is_said_with_its_line(
    body: str,
    stage: str,
    piece: str,
    says: str,
    captures: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    own, text = tmp_path / "own.py", effect_text(body, stage)
    own.write_text(text)
    said = refusal(capfd, "add", "odd", captures, "--effects", own, "--out", tmp_path / "model.toml")
    assert f"effect 'odd' ({own}, line {line_with(text, piece)})" in said
    assert says in said
    assert not (tmp_path / "model.toml").exists()


@pytest.mark.parametrize(
    ("text", "piece", "says"),
    [
        (starting("return evidence[99]"), "evidence[99]", "IndexError: "),
        (starting("yield {'size': 1 / 0}"), "1 / 0", "ZeroDivisionError: "),
        (starting("return None"), "def found", "returned None: return a list of {parameter: value}"),
        (starting("return {'size': 1}"), "def found", "returned a value of type dict: return a list"),
        (starting("return [0.1]"), "def found", "returned a list with a value of type float"),
        (
            starting("return [{'sise': 0.1}]"),
            "def found",
            "names a parameter 'sise': did you mean 'size'?",
        ),
        (starting("return [{'size': math.nan}]"), "def found", "gives NaN or an infinite value for 'size'"),
        (
            starting("return [{'size': 'large'}]"),
            "def found",
            "gives a value of type str for 'size': give a number",
        ),
        (starting("return [{'size': [1, 2]}]"), "def found", "gives an array of shape [2] for 'size'"),
        (measuring("return evidence[0].nothing"), "nothing", "AttributeError: "),
        (measuring("return 3"), "def read", "returned a value of type int: return {parameter: value}"),
        (measuring("return {'sise': 3}"), "def read", "names a parameter 'sise': did you mean 'size'?"),
    ],
)
def test_what_starts_and_measure_did_is_said_with_the_line(
    text: str, piece: str, says: str, captures: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.py"
    own.write_text(text)
    said = refusal(capfd, "add", "odd", captures, "--effects", own, "--out", tmp_path / "model.toml")
    role = "starts" if "def found" in text else "measure"
    assert f"{role} of effect 'odd' ({own}, line {line_with(text, piece)})" in said
    assert says in said


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    "text", [effect_text("raise ValueError('odd')"), starting("raise ValueError('odd')")]
)
def test_diagnose_ends_with_it_wherever_it_happens(
    text: str,
    workers: int,
    captures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(effect_catalogue, "BUILT_IN", effect_catalogue.BUILT_IN[:1])  # to be quick
    own = tmp_path / "own.py"
    own.write_text(text)
    said = refusal(capfd, "diagnose", captures, "--effects", own, "--workers", workers)
    assert f"effect 'odd' ({own}, line {line_with(text, 'raise')}): ValueError: odd" in said


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        (effect_text(before="sys.exit(0)\n"), 6, "it ends the program (SystemExit)"),
        (
            effect_text(before="import no_such_package\n"),
            6,
            "ModuleNotFoundError: No module named 'no_such_package'",
        ),
        (
            effect_text(before="from trainer.effects import nothing\n"),
            6,
            "ImportError: cannot import name 'nothing'",
        ),
        (effect_text(before="class Stop(BaseException): ...\nraise Stop('here')\n"), 7, "Stop: here"),
        (effect_text(before="def broken(:\n"), 6, "SyntaxError: "),
        (effect_text(stage="screen"), 7, "stage 'screen' is not one of"),
        (effect_text().replace("low=-1", "low=1"), 7, "Parameter 'size': make low 1 less than high 1"),
    ],
)
def test_a_file_that_cannot_be_run_is_said_with_its_line(
    text: str,
    line: int,
    says: str,
    captures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "own.py").write_text(text)
    monkeypatch.chdir(tmp_path)  # a relative path has its line, too
    said = refusal(capfd, "diagnose", captures, "--effects", "own.py")
    assert f"effects file own.py, line {line}: " in said
    assert says in said


@pytest.mark.parametrize("wrong", ["absent=lambda bench: bench.nothing", "count=lambda order: order / 0"])
def test_a_parameters_function_is_said_with_its_line(
    wrong: str, captures: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    own, text = tmp_path / "own.py", effect_text().replace("low=-1", f"{wrong}, low=-1")
    own.write_text(text)
    said = refusal(capfd, "add", "odd", captures, "--effects", own, "--out", tmp_path / "model.toml")
    assert f"a Parameter of effect 'odd' ({own}, line {line_with(text, wrong)}): " in said


def test_forms_that_broadcast_are_taken(captures: Path, tmp_path: Path) -> None:
    own, out = tmp_path / "own.py", tmp_path / "model.toml"
    own.write_text(
        starting("yield {'size': [0.1]}").replace(GOOD, "return stage.multiplied(1 + size * stage.y[:, :1])")
    )
    assert main(["add", "odd", str(captures), "--effects", str(own), "--out", str(out), "--quiet"]) == 0
    assert out.exists()
