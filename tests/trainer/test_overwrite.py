"""The trainer's commands keep what is there, say so before any work, and leave the best model after Ctrl-C."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.trainer.hidden import bench_file, with_few_effects
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.cli import main
from trainer.cycle import demo_run
from trainer.diagnosis import way as ladder
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model
from trainer.model.model_file import read_model, write_model

FEW = ("distance", "zero_order", "ghost", "sensor_blur", "phase_response")


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set in which two things are hidden."""
    folder = tmp_path_factory.mktemp("overwrite")
    defects = ('kind = "distance"', 'kind = "zero_order"')
    bench = bench_file(folder, *defects, width=80, height=64, distance_mm=8)
    acquire_from(str(bench), folder / "captures", patterns=6)
    return folder / "captures"


@pytest.fixture
def model(captures: Path, tmp_path: Path) -> Path:
    """The ideal model's file."""
    write_model(tmp_path / "ideal.toml", Model(read_captures(captures).bench))
    return tmp_path / "ideal.toml"


@pytest.fixture
def interrupted_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes `explain` stop, as by Ctrl-C, before a number of effects more are added.

    The ideal model is diagnosed once only: it lacks the same each time.
    """
    of_ideal: list[Diagnosis] = []

    def put(added: int) -> None:
        monkeypatch.undo()
        monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)
        with_few_effects(monkeypatch, *FEW)
        real, calls, real_diagnose = ladder.chosen_addition, [], ladder.diagnose

        def diagnose_ideal_once(captures: CaptureSet, model: Model, *given: Any, **named: Any) -> Diagnosis:
            if model.names:
                return real_diagnose(captures, model, *given, **named)
            if not of_ideal:
                of_ideal.append(real_diagnose(captures, model, *given, **named))
            return of_ideal[0]

        monkeypatch.setattr(ladder, "diagnose", diagnose_ideal_once)

        def add_or_stop(*given: Any) -> Any:
            calls.append(given)
            if len(calls) > added:
                raise KeyboardInterrupt
            return real(*given)

        monkeypatch.setattr(ladder, "chosen_addition", add_or_stop)

    return put


def words_with_out(captures: Path, model: Path, out: Path) -> dict[str, list[object]]:
    return {
        "add": ["add", "distance", captures, "--out", out],
        "field": ["field", captures, "--out", out],
        "explain": ["explain", captures, "--out", out],
        "compare": ["compare", captures, "--report", out],
        "diagnose": ["diagnose", captures, "--report", out],
        "register": ["register", captures / "bench.toml", "--out", out],
        "new-effect": ["new-effect", out.stem, "--stage", "drive", "--out", out.parent],
    }


@pytest.mark.parametrize("name", ["add", "field", "explain", "compare", "diagnose", "register", "new-effect"])
def test_a_file_that_is_there_stays(
    name: str, captures: Path, model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ripple_of_mine.py"
    out.write_text("kept")
    words = [str(word) for word in words_with_out(captures, model, out)[name]]
    assert main(words) == 2
    assert f"{out} is there already" in capsys.readouterr().err
    assert out.read_text() == "kept"


@pytest.mark.parametrize(
    "words",
    [
        ["export", "--model", "{model}", "--out", "{out}"],
        ["initialiser", "{missing}", "--out", "{out}"],
        ["capture", "--bench", "virtual:demo", "--out", "{out}"],
        ["loop", "--bench", "virtual:demo", "--out", "{out}"],
        ["next", "{missing}", "--count", "2", "--out", "{out}"],
        ["next", "{missing}", "--bench", "virtual:demo", "--count", "2", "--out", "{out}"],
        ["train", "{missing}", "--out", "{out}"],
        ["demo", "--out", "{out}"],
    ],
    ids=lambda words: words[0],
)
def test_a_folder_that_is_there_stays_and_is_said_before_the_work(
    words: list[str], model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "taken"
    out.mkdir()
    (out / "thesis.tex").write_text("kept")
    places = {"model": model, "out": out, "missing": tmp_path / "missing"}
    line = [word.format(**places) for word in words]
    assert main(line) == 2
    assert "is there already and is not empty" in capsys.readouterr().err
    assert main([*line, "--overwrite"]) == 2
    assert "thesis.tex" in capsys.readouterr().err
    assert [p.name for p in out.iterdir()] == ["thesis.tex"]


def test_overwrite_replaces_a_bundle_a_capture_set_and_an_effect(model: Path, tmp_path: Path) -> None:
    bench = bench_file(tmp_path, 'kind = "distance"', width=64, height=64, distance_mm=10)
    effect = ["new-effect", "ripple_of_mine", "--stage", "drive", "--out", str(tmp_path / "effects")]
    for words in (
        ["export", "--model", str(model), "--out", str(tmp_path / "bundle")],
        ["capture", "--bench", str(bench), "--patterns", "2", "--out", str(tmp_path / "set")],
        effect,
    ):
        assert main(words) == 0
        before = sorted(tmp_path.rglob("*"))
        assert main(words) == 2
        assert main([*words, "--overwrite"]) == 0
        assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "effects" / "ripple_of_mine.py").write_text("edited")
    assert main([*effect, "--overwrite"]) == 0
    assert "edited" not in (tmp_path / "effects" / "ripple_of_mine.py").read_text()


def test_an_initialiser_is_not_taught_for_a_bundle_that_would_replace_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    (bundle / "bundle.json").write_text("{}")
    assert main(["initialiser", str(bundle), "--out", str(bundle), "--overwrite"]) == 2
    assert "is an input of this command" in capsys.readouterr().err


def test_explain_goes_on_where_ctrl_c_stopped_it(
    captures: Path,
    tmp_path: Path,
    interrupted_after: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "model.toml"
    words = ["explain", str(captures), "--out", str(out), "--workers", "1", "--quiet"]
    interrupted_after(0)
    assert main(words) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not out.exists()

    interrupted_after(1)
    assert main(words) == 130
    said = capsys.readouterr().err
    first, text = read_model(out, catalogue()), out.read_text()
    assert len(first.names) == 1
    assert f"go on with: hololoop-trainer explain {captures} --out {out} --overwrite --model {out}" in said

    interrupted_after(0)  # from the ideal model again: what is there is better than nothing
    assert main([*words, "--overwrite"]) == 130
    assert f"{out} is as it was" in capsys.readouterr().err
    assert out.read_text() == text

    monkeypatch.undo()
    with_few_effects(monkeypatch, *FEW)
    assert main([*words, "--model", str(out), "--overwrite", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    last = read_model(out, catalogue())
    assert result["verdict"] == "complete"
    assert set(last.names) == {"distance", "zero_order"}
    assert last.history[: len(first.history)] == first.history


def test_a_demo_that_is_interrupted_says_what_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(folder: Path, *_: Any, **__: Any) -> None:
        (folder / "captures").mkdir(parents=True)
        (folder / "model.toml").write_text("")
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_run, "run_demo", stop)
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out)]) == 130
    assert f"interrupted; {out} holds captures and model.toml" in capsys.readouterr().err
