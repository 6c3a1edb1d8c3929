"""The command line: help that teaches, one object under --json, one line and exit 2 for bad input."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_iface.errors import InputError
from runtime.program.screen import Screen
from trainer import cli
from trainer.effects import testing
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model, instance_with
from trainer.model.model_file import read_model, write_model

ROOT = Path(__file__).resolve().parent.parent.parent
NAMES = [c.name for c in cli.PROGRAM.commands]


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Test workers that each take every core slow each other down."""
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture set with a shifted image plane."""
    folder = tmp_path_factory.mktemp("cli") / "captures"
    testing.captures_with(folder, catalogue()["distance"], {"offset": 0.2}, patterns=4)
    return folder


def one_line_of_error(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize("name", NAMES)
def test_help_says_what_it_is_for_shows_an_example_and_what_comes_next(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([name, "--help"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "example:\n  hololoop-trainer " + name in out
    assert "next:\n" in out
    assert "--json" in out
    assert max(map(len, out.splitlines())) <= 140


def test_the_examples_of_the_help_can_be_parsed() -> None:
    for command in cli.PROGRAM.commands:
        for example in command.examples:
            args = cli.PROGRAM.parser().parse(shlex.split(example))
            assert args.chosen is command
            assert args.command == command.name


def test_help_does_not_wait_for_torch() -> None:
    script = (
        "import sys; from trainer.cli import main; main(['explain', '--help']); print('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.splitlines()[-1] == "False"


def test_the_base_install_says_what_to_install() -> None:
    script = (
        "import sys; sys.modules['torch'] = None; from trainer.cli import main; sys.exit(main(['effects']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    said = "hololoop-trainer: torch is not installed; get it with: pip install 'hololoop[trainer]'"
    assert done.stderr.splitlines() == [said]


def test_nothing_prints_the_help_and_the_version_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    assert "usual way" in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("hololoop-trainer ")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("diagnos x", "no command 'diagnos': did you mean 'diagnose'"),
        ("check", "CAPTURES; see: hololoop-trainer check --help"),
        ("check x --jsn", "check has no option --jsn: did you mean '--json'"),
        ("check x y", "'y' is one argument too many"),
        ("check /nowhere/at/all", "is not a folder"),
        ("compare /nowhere/at/all", "is not a folder"),
        ("diagnose /nowhere/at/all --level 2", "--level: '2' is not a number from 1e-09 to 0.5"),
        ("diagnose /nowhere/at/all --workers 0", "--workers: '0' is not a whole number"),
        ("explain /nowhere/at/all", "--out"),
        ("explain /nowhere/at/all --out /nowhere/x.toml", "--out /nowhere/x.toml: there is no folder"),
        ("explain /nowhere/at/all --out .", "--out . is a folder"),
        ("add zero_ordr /nowhere/at/all --out x.toml", "unknown effect 'zero_ordr': did you mean"),
        ("effects --effects nothing.py", "effects file nothing.py is not there"),
        ("new-effect x --stage pannel", "'pannel' is not a stage; did you mean 'panel'"),
        ("new-effect X --stage panel", "lower-case"),
        ("capture --bench virtual:demoo --out x", "did you mean 'demo'"),
        ("capture --bench virtual:demo --out x --planes 1,b", "--planes: 'b' is not a number"),
        ("export --model nothing.toml --out x", "nothing.toml"),
    ],
)
@pytest.mark.parametrize("as_json", [False, True])
def test_bad_input_is_one_line_and_exit_2(
    line: str,
    message: str,
    as_json: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [*shlex.split(line), *(["--json"] if as_json else [])]
    assert cli.main(arguments) == 2
    assert message in one_line_of_error(capsys)
    assert not list(tmp_path.iterdir())


def one_object(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    out, _ = capsys.readouterr()
    assert out.count("\n") == 1
    found = json.loads(out, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert isinstance(found, dict)
    return found


def test_check_gives_its_object_and_its_page(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(captures), "--json"]) == 0
    found = one_object(capsys)
    assert found["captures"] == 4
    assert all(set(p) >= {"severity", "kind", "capture", "message"} for p in found["problems"])
    assert cli.main(["check", str(captures)]) == 0
    out = capsys.readouterr().out
    assert f"hololoop-trainer compare {captures}" in out
    assert "\x1b" not in out


def test_check_of_a_folder_without_a_bench_is_a_problem_not_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["check", str(tmp_path), "--json"]) == 1
    found = one_object(capsys)
    assert found["captures"] == 0
    assert found["problems"][0]["kind"] == "unreadable"


def test_compare_gives_its_object_and_its_page(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["compare", str(captures), "--json"]) == 0
    found = one_object(capsys)
    assert set(found) >= {"heldout", "psnr_db", "by_channel", "by_capture", "where"}
    assert set(found["where"]) >= {"field", "frequency", "brightness", "time"}
    assert cli.main(["compare", str(captures)]) == 0
    out = capsys.readouterr().out
    assert "excess" in out
    assert f"hololoop-trainer diagnose {captures}" in out


def test_add_writes_a_model_that_compare_and_add_take(
    captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "new.toml"
    assert cli.main(["add", "distance", str(captures), "--out", str(model), "--json"]) == 0
    found = one_object(capsys)
    assert found["after"]["excess"] < 0.05 * found["before"]["excess"]
    assert found["parameters"]["offset_mm"]["value"] == pytest.approx(0.2, rel=0.05)
    assert read_model(model, catalogue()).names == ("distance",)
    again = tmp_path / "again.toml"
    arguments = ["add", "zero_order", str(captures), "--model", str(model), "--out", str(again)]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "zero_order (" in out
    assert "hololoop-trainer diagnose" in out
    assert read_model(again, catalogue()).names == ("distance", "zero_order")


def test_a_model_of_another_bench_is_refused(
    captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(tmp_path / "m.toml", Model(testing.small_bench(72, 100)))
    assert cli.main(["compare", str(captures), "--model", str(tmp_path / "m.toml")]) == 2
    assert "another bench: panel.width is 100 there and 96" in one_line_of_error(capsys)


def test_effects_are_listed_and_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["effects", "--json"]) == 0
    found = one_object(capsys)
    assert [e["name"] for e in found["effects"]] == list(catalogue())
    assert cli.main(["effects", "zero_order"]) == 0
    assert "fill_factor" in capsys.readouterr().out


def test_a_new_effect_is_written_and_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["new-effect", "ripple", "--stage", "drive", "--out", str(tmp_path), "--json"]) == 0
    found = one_object(capsys)
    assert Path(found["effect"]).is_file()
    assert Path(found["test"]).is_file()
    assert cli.main(["effects", "ripple", "--effects", found["effect"], "--json"]) == 0
    assert one_object(capsys)["effects"][0]["stage"] == "drive"


# --- diagnose and explain have stand-ins here: how they are called, and what is made of their answers ---

DIAGNOSIS = {
    "heldout": {"nrmse": 0.2, "noise_nrmse": 0.05, "excess": 0.04},
    "verdict": "missing",
    "stage": "pupil",
    "stages": [
        {"stage": "pupil", "excess_removed": 0.03},
        {"stage": "drive", "excess_removed": float("nan")},
    ],
    "ranking": [
        {
            "effect": "distance",
            "stage": "pupil",
            "excess_after": 0.001,
            "excess_removed": 0.039,
            "ci95": [0.03, 0.05],
            "parameters": {"offset_mm": {"value": 0.2031, "error": 0.0012, "unit": "mm"}},
            "indistinguishable_from": ["panel_wavefront"],
        }
    ],
    "suggested_captures": ["another plane"],
    "thresholds": {"level": 0.05},
    "ideal_excess": 0.04,
    "sentence": "distance is missing (offset 0.203 ± 0.001 mm).",
}


@dataclass
class Found:
    """A stand-in for a diagnosis or an explanation."""

    answer: dict[str, Any]

    def as_json(self, *path: Path) -> dict[str, Any]:
        return self.answer | ({"model": str(path[0])} if path else {})


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Any]]:
    """Puts functions in the place of diagnose and explain."""

    def put(**functions: Callable[..., Any]) -> list[Any]:
        seen: list[Any] = []

        def diagnose(
            captures: Any, model: Any, known: Any, pool: Any, thresholds: Any, progress: Any
        ) -> Found:
            seen.extend([model, pool, thresholds])
            progress(0.5, "half")
            print("a library prints this")
            return Found(DIAGNOSIS)

        def explain(
            captures: Any,
            model: Any,
            known: Any,
            pool: Any,
            thresholds: Any,
            save: Any,
            progress: Any,
            learn: bool,
        ) -> Any:
            return functions["explain"](model, known, save)

        monkeypatch.setitem(sys.modules, "trainer.diagnosis.diagnosis", SimpleNamespace(diagnose=diagnose))
        monkeypatch.setitem(sys.modules, "trainer.diagnosis.explanation", SimpleNamespace(explain=explain))
        return seen

    return put


def test_diagnose_says_what_to_do_next(
    captures: Path, stand_ins: Callable[..., list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    seen = stand_ins()
    arguments = ["diagnose", str(captures), "--workers", "1", "--level", "0.01", "--min-excess", "0.001"]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0] == "distance is missing (offset 0.203 ± 0.001 mm)."
    assert f"hololoop-trainer add distance {captures} --out with_distance.toml" in out
    assert "0.2031 ± 0.0012 mm" in out
    assert "another plane" in out
    assert seen[1].workers == 1
    assert (seen[2].level, seen[2].excess, seen[2].share) == (0.01, 0.001, 0.0)


def test_json_is_alone_on_stdout_and_has_no_nan(
    captures: Path, stand_ins: Callable[..., list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    stand_ins()
    assert cli.main(["diagnose", str(captures), "--workers", "1", "--json"]) == 0
    found = one_object(capsys)
    assert found["stages"][1]["excess_removed"] is None
    assert found["verdict"] == "missing"


def test_an_interrupted_explain_leaves_the_last_good_model_and_says_so(
    captures: Path, tmp_path: Path, stand_ins: Callable[..., list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def explain(model: Model, known: Any, save: Callable[[Model], None]) -> None:
        save(model)
        save(model.having(instance_with(known["distance"], model.bench, {"offset": 0.2})))
        raise KeyboardInterrupt

    stand_ins(explain=explain)
    out = tmp_path / "new.toml"
    assert cli.main(["explain", str(captures), "--out", str(out), "--workers", "1", "--json"]) == 130
    said = one_line_of_error(capsys)
    assert f"interrupted after adding distance; the model so far is in {out}" in said
    assert read_model(out, catalogue()).names == ("distance",)


def test_an_explain_interrupted_at_once_writes_nothing(
    captures: Path, tmp_path: Path, stand_ins: Callable[..., list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def explain(*_: Any) -> None:
        raise KeyboardInterrupt

    stand_ins(explain=explain)
    assert cli.main(["explain", str(captures), "--out", str(tmp_path / "new.toml"), "--workers", "1"]) == 130
    assert "nothing was written" in one_line_of_error(capsys)
    assert not list(tmp_path.iterdir())


def test_explain_shows_the_ladder_and_writes_the_model(
    captures: Path, tmp_path: Path, stand_ins: Callable[..., list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def explain(model: Model, known: Any, save: Callable[[Model], None]) -> Any:
        better = model.having(instance_with(known["distance"], model.bench, {"offset": 0.2}))
        save(better)
        steps = [
            {"added": None, "nrmse": 0.2, "excess": 0.04, "indistinguishable_from": []},
            {
                "added": "distance",
                "nrmse": 0.05,
                "excess": 1e-5,
                "indistinguishable_from": ["panel_wavefront"],
            },
        ]
        found = Found(
            {"steps": steps, "verdict": "complete", "stage": None, "noise_nrmse": 0.05, "sentence": "Done."}
        )
        return SimpleNamespace(as_json=found.as_json, model=better, diagnosis=Found(DIAGNOSIS))

    stand_ins(explain=explain)
    out = tmp_path / "new.toml"
    arguments = ["explain", str(captures), "--out", str(out), "--workers", "1"]
    assert cli.main(arguments) == 0
    page = capsys.readouterr().out
    assert page.startswith("distance (offset 0.200 mm) took the excess from 0.04 to 1e-05. Done.")
    assert "panel_wavefront" in page
    assert f"hololoop-trainer export --out bundle --model {out}" in page
    about = out.read_text(encoding="utf-8")
    assert "captures_sha256" in about
    assert cli.main([*arguments, "--json", "--overwrite"]) == 0
    assert one_object(capsys)["model"] == str(out)


def test_other_interruptions_and_a_full_disk_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (effects,) = (c for c in cli.PROGRAM.commands if c.name == "effects")
    for error, code, message in (
        (KeyboardInterrupt(), 130, "interrupted; what was finished is kept, and nothing is half written"),
        (OSError(28, "No space left on device", "x.toml"), 2, "x.toml: No space left on device"),
        (InputError("two\nlines"), 2, "two lines"),
        (MemoryError(), 2, "not enough memory"),
    ):

        def fails(args: Namespace, screen: Screen, error: BaseException = error) -> dict[str, Any]:
            raise error

        program = replace(cli.PROGRAM, commands=(replace(effects, run=fails),))
        monkeypatch.setattr(cli, "PROGRAM", program)
        assert cli.main(["effects"]) == code
        assert message in one_line_of_error(capsys)
        monkeypatch.undo()
