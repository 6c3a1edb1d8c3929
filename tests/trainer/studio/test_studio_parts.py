"""The studio without a browser: steps of a model, effect files from probes, projects, access."""

from __future__ import annotations

import resource
import shutil
import socket
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("panel", reason="the studio needs the extra 'studio'")

from firmware_iface.errors import InputError
from runtime.excess import RemovedExcess
from tests.trainer.hidden import with_few_effects
from tests.waiting import until
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.diagnosis.probes import ProbeResult
from trainer.effects.effect_catalogue import catalogue, load_effects
from trainer.effects.testing import captures_with
from trainer.model.model import Model, instance_with
from trainer.model.model_file import read_model, write_model
from trainer.report.ladder import ladder_rows, with_network
from trainer.report.palettes import DIFFERENCE, palette
from trainer.studio import gain_tasks, guess_benches
from trainer.studio.jobs import WorkerProcess, picture_worker
from trainer.studio.learned_network import network_of
from trainer.studio.model_steps import ModelSteps
from trainer.studio.probe_template import write_effect_of_probe
from trainer.studio.project import Project
from trainer.studio.server import _checked_token, _free_port


@pytest.fixture(scope="module")
def pictures() -> Iterator[WorkerProcess]:
    """The process that predicts pictures for all projects, one after the other: each start imports torch."""
    one = picture_worker()
    yield one
    one.close()


@pytest.fixture
def project(tmp_path: Path, pictures: WorkerProcess, monkeypatch: pytest.MonkeyPatch) -> Iterator[Project]:
    monkeypatch.setattr(pictures, "close", pictures.cancel)
    one = Project(tmp_path, worker=pictures)
    yield one
    one.close()


# Steps of a model


def models(captures: CaptureSet, *leaks: float) -> list[Model]:
    effect = catalogue()["zero_order"]
    ideal = replace(Model(captures.bench), gain={"green": 1.0})
    return [ideal, *(ideal.having(instance_with(effect, captures.bench, {"leak_real": v})) for v in leaks)]


def test_steps_are_undone_and_redone_and_forgotten(captures: CaptureSet, tmp_path: Path) -> None:
    steps, known = ModelSteps(tmp_path / "m.toml"), catalogue()
    ideal, one, two = models(captures, 0.1, 0.2)
    assert not steps.can_undo() and not steps.can_redo()
    steps.write(one, ideal, {})
    steps.write(two, one, {})
    assert [p.name for p in steps.files()] == ["0001.toml", "0002.toml", "0003.toml"]
    assert steps.step(-1, known, {}).instance("zero_order").values["leak_real"] == pytest.approx(0.1)
    assert steps.step(-1, known, {}).names == ()
    assert not steps.can_undo()
    with pytest.raises(InputError, match="nothing to undo"):
        steps.step(-1, known, {})
    assert steps.step(1, known, {}).names == ("zero_order",)
    assert steps.can_redo()
    steps.write(models(captures, 0.3)[1], one, {})
    assert not steps.can_redo() and len(steps.files()) == 3


def test_a_change_by_another_program_is_a_step(captures: CaptureSet, tmp_path: Path) -> None:
    steps = ModelSteps(tmp_path / "m.toml")
    ideal, one, two = models(captures, 0.1, 0.2)
    steps.write(one, ideal, {})
    write_model(steps.path, two, {"written_by": "somebody"})
    assert steps.position() is None
    steps.notice(two, one, {})
    assert steps.position() == 2 and steps.can_undo()


def test_a_model_that_cannot_be_written_leaves_the_old_one(
    captures: CaptureSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = ModelSteps(tmp_path / "m.toml")
    ideal, one, two = models(captures, 0.1, 0.2)
    steps.write(one, ideal, {})
    before = steps.path.read_bytes()
    real = write_model

    def full(path: Path, *rest: Any) -> None:
        if path == steps.path:
            raise InputError(f"{path} cannot be written: No space left on device")
        real(path, *rest)

    monkeypatch.setattr("trainer.studio.model_steps.write_model", full)
    with pytest.raises(InputError, match="No space left"):
        steps.write(two, one, {})
    assert steps.path.read_bytes() == before and len(steps.files()) == 2


def test_the_ladder_counts_steps_as_a_person_does() -> None:
    record = {"nrmse": 0.5, "noise_nrmse": 0.1, "excess": 0.24}
    history = [
        {"added": "", **record},
        {"added": "zero_order", **record},
        {"added": "", **record},
        {"added": "", "removed": "iris", **record},
    ]
    assert [r["label"] for r in ladder_rows(history)] == ["ideal model", "+ zero order", "− iris"]


# Effect files from probes


@pytest.mark.parametrize("stage", ["drive", "panel", "pupil", "sensor"])
def test_an_effect_file_is_filled_with_what_the_probe_shows(stage: str, tmp_path: Path) -> None:
    x = np.arange(120)
    fringe = 1 + 0.1 * np.cos(2 * np.pi * x[None, :] / 12) * np.ones((90, 1))
    titles = {
        "drive": ("response, deviation (green)", 0.1 * np.cos(2 * np.pi * np.arange(33) / 8)),
        "panel": ("amplitude multiplied", fringe),
        "pupil": ("amplitude passed, over spatial frequency", fringe),
        "sensor": ("gain over the picture", fringe),
    }
    title, values = titles[stage]
    found = ProbeResult(stage, RemovedExcess(0.1, 0.001), 0.01, ((title, values, "relative"),))
    path = write_effect_of_probe(f"odd_{stage}", stage, found, (90, 120), tmp_path, ())
    text = path.read_text()
    assert title in text and "amplitude 0.1" in text
    if stage in ("panel", "sensor"):
        assert '"period": 12' in text
    (effect,) = load_effects(path)
    assert effect.name == f"odd_{stage}" and effect.stage == stage


# The project


def test_a_project_predicts_adds_undoes_and_sees_the_command_line(
    project: Project, captures: CaptureSet
) -> None:
    project.open_set(captures.folder)
    until(lambda: project.set.errors is not None and project.set.problems is not None, 60)
    assert project.set.errors is not None and project.set.errors.errors.excess > 0.05
    assert project.set.problems == [] or all(p.severity == "warning" for p in project.set.problems or ())
    path = project.set.model_path
    assert path is not None and not path.exists()
    project.add("zero_order")
    assert project.work is not None and project.work.name == "Add zero_order"
    until(lambda: project.set.model is not None and project.set.model.names == ("zero_order",), 60)
    until(lambda: project.results.diagnosis is not None, 60)
    assert project.set.model is not None
    assert path.is_file()
    assert project.results.diagnosis is not None and project.results.diagnosis.verdict == "complete"
    until(lambda: project.set.errors, 60)
    assert project.set.errors.errors.excess < 1e-3
    assert [r["label"] for r in ladder_rows(project.set.model.history)] == ["ideal model", "+ zero order"]
    project.undo()
    assert (
        project.set.model.names == () and project.set.can_redo() and read_model(path, catalogue()).names == ()
    )
    project.redo()
    assert project.set.model.names == ("zero_order",)
    write_model(path, read_model(path, catalogue()).without("zero_order"))
    until(lambda: "another program" in project.notice[1], 60)
    assert project.set.model.names == ()


def test_a_broken_set_is_a_sentence(project: Project, captures: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(captures.folder, folder)
    (folder / "bench.toml").write_text("[panel\n")
    project.open_set(folder)
    assert project.set.captures is None and "bench.toml" in project.set.fault
    until(lambda: project.set.problems, 60)
    (folder / "bench.toml").write_text((captures.folder / "bench.toml").read_text())
    until(lambda: project.set.captures is not None, 60)
    with pytest.raises(InputError, match="is not a folder"):
        project.open_set(tmp_path / "nowhere")


def test_a_saved_effect_file_takes_part_at_once(
    project: Project, captures: CaptureSet, tmp_path: Path
) -> None:
    project.open_set(captures.folder)
    until(lambda: project.set.errors, 60)
    path = write_effect_of_probe("my_stripe", "panel", None, (72, 96), tmp_path, ())
    project.add_effect_file(path)
    until(lambda: any(r.effect.name == "my_stripe" for r in project.results.ranking), 60)
    assert "my_stripe" in project.results.previews
    path.write_text(path.read_text() + "\nthis is not Python\n")
    until(lambda: project.effects.fault, 60)
    assert str(path) in project.effects.fault and "line" in project.effects.fault


def test_a_full_disk_is_a_sentence_and_the_model_stays(project: Project, captures: CaptureSet) -> None:
    """A limit on the size of files stands for the full disk."""
    project.open_set(captures.folder)
    until(lambda: project.set.errors, 60)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        project.add("zero_order")
        until(lambda: project.work is None and project.notice[1], 60)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    severity, sentence = project.notice
    assert severity == "error" and "cannot be written" in sentence and "\n" not in sentence
    assert project.set.model is not None and project.set.model.names == ()
    assert project.set.model_path is not None and not project.set.model_path.exists()
    project.add("zero_order")
    until(lambda: project.set.model is not None and project.set.model.names == ("zero_order",), 60)


def test_a_network_that_is_a_gain_takes_part_and_goes_into_the_bundle(
    project: Project, tmp_path: Path
) -> None:
    uneven = {"log_amplitude": [0.3, 0.2, -0.4, 0.0, -0.4]}
    captures = captures_with(tmp_path / "uneven", catalogue()["illumination"], uneven, patterns=6)
    project.open_set(captures.folder)
    before = until(lambda: project.set.errors, 60).errors.excess
    project.train_network(20)
    until(lambda: project.work is None and project.notice[1], 200)
    network = project.set.network
    assert network is not None, project.notice
    assert network.after < network.before == pytest.approx(before, rel=0.02)
    assert "takes part" in project.notice[1]
    after = until(lambda: project.set.errors, 60).errors.excess
    assert after == pytest.approx(network.after, rel=0.02)
    project.export(tmp_path / "bundle")
    until(lambda: "The bundle is" in project.notice[1], 120)
    assert "the network" in project.notice[1]
    assert list((tmp_path / "bundle").rglob("*.onnx"))
    assert project.set.model_path is not None
    again = network_of(project.set.model_path, project.set.model_now, captures.folder.name)
    assert again == network  # found again when the studio is started anew
    other = project.set.model_now.having(
        instance_with(catalogue()["zero_order"], captures.bench, {"leak_real": 0.1})
    )
    assert network_of(project.set.model_path, other, captures.folder.name) is None
    rows = with_network(ladder_rows([{"nrmse": 0.5, "noise_nrmse": 0.1, "excess": before}]), network.after)
    assert rows[-1]["label"] == "+ network" and rows[-1]["excess"] == network.after


# What is gained


def test_a_gain_is_displayed_by_the_simulated_bench_kept_and_read_again(tmp_path: Path) -> None:
    said: list[str] = []
    folder = guess_benches.capture_guess(
        lambda kind, value: said.append(kind), "one", 3, tmp_path / "guess-3"
    )
    assert said.count("picture") > 10 and guess_benches.noted(folder) == ("one", 3)
    hidden = guess_benches.hidden_in(folder)
    assert hidden is not None and len(hidden) == 1
    model = Model(read_captures(folder).bench)
    for where in (gain_tasks.OWN, gain_tasks.PREDICTED):
        found = gain_tasks.show_gain(_quiet, folder, model, "coffee", "green", 18.0, where)
        assert found.target.shape == found.ideal.shape == (144, 192) and found.ideal_db > 5
    gain_tasks.keep(found, tmp_path / "kept.npz")
    again = gain_tasks.recorded(tmp_path / "kept.npz")
    assert again.where == found.where and np.array_equal(again.explained, found.explained)
    with pytest.raises(InputError, match="is not that of these captures"):
        gain_tasks.show_gain(_quiet, folder, model, "coffee", "green", 18.0, "virtual:demo")
    with pytest.raises(InputError, match="holds no displayed picture"):
        gain_tasks.recorded(folder / "bench.toml")


def _quiet(kind: str, value: Any) -> None:
    pass


# Simulated benches


@pytest.mark.parametrize("kind", guess_benches.KINDS.values())
def test_simulated_benches_hide_what_their_kind_says(kind: str) -> None:
    counts = {"one": 1, "two": 2, "three": 3, "colours": 1, "outside": 1}
    for number in range(5):
        bench = guess_benches.guess_bench(kind, number)
        assert bench == guess_benches.guess_bench(kind, number)
        assert len(bench.defects) in ((counts[kind],) if kind in counts else (0, 1))


# Access


def test_tokens_and_ports() -> None:
    assert len(_checked_token(None)) > 20
    assert _checked_token("abcdefgh") == "abcdefgh"
    for wrong in ("short", "with space!", "äöüäöüäöü"):
        with pytest.raises(InputError, match="--token"):
            _checked_token(wrong)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port} cannot be used"):
            _free_port(port)
    assert 1024 < _free_port(None) < 65536


def test_differences_are_white_at_zero_and_equally_deep_on_both_sides() -> None:
    colours = [tuple(int(c[k : k + 2], 16) for k in (1, 3, 5)) for c in palette(DIFFERENCE)]
    assert len(colours) == 255 and min(colours[127]) > 235
    light = [0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in colours]
    assert all(a < b + 2 for a, b in pairwise(light[:128]))
    assert light[0] == pytest.approx(light[-1], abs=25)


def test_a_notebook_shows_the_same_views(
    captures: CaptureSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hololoop

    with_few_effects(monkeypatch, "zero_order", "illumination")
    hololoop.compare(captures).view().save(tmp_path / "view.html", resources="inline", title="captures")
    text = (tmp_path / "view.html").read_text(encoding="utf-8")
    assert "\\u2212 predicted" in text or "Measured − predicted" in text
    assert "Over spatial frequency" in text and "gray level" in text
    assert len(hololoop.compare(captures).view("failures")) == 1
    with pytest.raises(InputError, match="there is no view 'ladders'"):
        hololoop.explain(captures, workers=1).view("ladders")
