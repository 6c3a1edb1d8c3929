"""Many sets in one run: the truth in the table, a failure that costs one row, and a run that goes on."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from tests.trainer.hidden import ran
from tests.trainer.made_fleet import column_added, drifting, fitted, result, set_of_bench, start_model
from trainer.captures.capture_set import opened, read_captures
from trainer.cli import main
from trainer.effects.effect_catalogue import catalogue
from trainer.fleet import fleet_run
from trainer.fleet.fleet_table import COLUMNS, read_table, write_table
from trainer.fleet.outcomes import outcomes
from trainer.fleet.set_facts import set_facts, time_of
from trainer.fleet.set_result import SetResult
from trainer.fleet.set_task import SetTask, failed

pandas = pytest.importorskip("pandas")
pytest.importorskip("pyarrow")

HEADSETS = 12


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


@pytest.fixture(scope="module")
def headsets(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A small set of each headset: distance and phase gain drift together, the leak does not."""
    folder = tmp_path_factory.mktemp("fleet")
    return [
        set_of_bench(folder, f"unit-{k:02d}", k, *defects, patterns=3)
        for k, defects in enumerate(drifting(HEADSETS))
    ]


@pytest.fixture(scope="module")
def model(headsets: list[Path]) -> Path:
    """A model with the three effects, at values of no headset."""
    return start_model(headsets[0].parent / "start.toml", headsets[0])


# --- the numbers ---


def test_recalibrated_headsets_show_what_drifts_together(
    headsets: list[Path], model: Path, tmp_path: Path, capsys: Any
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(headsets[0], broken)
    (next((broken / "image").iterdir())).unlink()
    table, page = tmp_path / "fleet.parquet", tmp_path / "fleet.html"
    words = ("fleet", *headsets, broken, "--model", model, "--out", table, "--report", page)
    found = ran(capsys, *words)

    assert (found["sets"], found["finished"], found["headsets"]) == (HEADSETS + 1, HEADSETS, HEADSETS)
    assert [f["folder"] for f in found["failed"]] == [str(broken)]
    assert "is not there" in found["failed"][0]["why"]
    assert found["effects"] == {"distance": HEADSETS, "phase_response": HEADSETS, "zero_order": HEADSETS}
    pairs = {
        frozenset((p["first"]["effect"], p["second"]["effect"])): p
        for p in found["drift"]["headsets"]["pairs"]
    }
    together = {names for names, p in pairs.items() if p["together"]}
    assert together == {frozenset(("distance", "phase_response"))}
    assert pairs[frozenset(("distance", "phase_response"))]["correlation"] > 0.9
    assert found["drift"]["time"]["pairs"] == []

    rows = pandas.read_parquet(table)
    assert list(rows.columns) == list(COLUMNS)
    distance = rows[(rows.effect == "distance") & (rows.parameter == "offset")]
    truth = [float(one[0].split("offset_mm = ")[1]) for one in drifting(HEADSETS)]
    assert distance.value.to_numpy() == pytest.approx(np.array(truth), abs=0.005)
    assert (distance.unit == "mm").all()
    assert (distance.error > 0).all()
    assert (distance.excess_after < distance.excess_before).all()
    assert list(distance.headset) == [f"unit-{k:02d}" for k in range(HEADSETS)]
    assert set(distance.time_from) == {"file"}
    lost = rows[rows.folder == str(broken)]
    assert len(lost) == 1
    assert lost.effect.isna().all()
    assert "is not there" in lost.failed.iloc[0]
    assert "distance and phase response" in page.read_text()

    # The same command again: only what failed is tried, and the page is written anew.
    before = table.stat().st_mtime_ns, distance.value.tolist()
    shutil.rmtree(broken)
    shutil.copytree(headsets[3], broken)
    again = ran(capsys, *words)
    assert (again["taken_up"], again["finished"], again["failed"]) == (HEADSETS, HEADSETS + 1, [])
    now = pandas.read_parquet(table)
    assert now[(now.effect == "distance") & (now.folder != str(broken))].value.tolist() == before[1]
    third = ran(capsys, *words)
    assert third["taken_up"] == HEADSETS + 1


def test_a_set_is_explained_as_explain_does(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {
        name: effect
        for name, effect in catalogue().items()
        if name in ("distance", "vignetting", "sensor_blur")
    }
    for module in ("effects.effect_catalogue", "fleet.set_task"):
        monkeypatch.setattr(f"trainer.{module}.catalogue", lambda files=(): few)
    folder = set_of_bench(tmp_path, "unit-a", 3, 'kind = "distance"\noffset_mm = 0.15')
    found = ran(capsys, "fleet", folder, "--out", tmp_path / "t.parquet")
    assert found["verdicts"] == {"complete": 1}
    alone = ran(capsys, "explain", folder, "--out", tmp_path / "m.toml")
    row = read_table(tmp_path / "t.parquet")[0][0]
    assert [s["added"] for s in alone["steps"]] == [None, *row.effects]
    assert row.excess_before == pytest.approx(alone["steps"][0]["excess"], rel=1e-6)
    assert row.excess_after == pytest.approx(alone["steps"][-1]["excess"], rel=1e-3, abs=1e-7)
    assert row.effects == ("distance",)
    offset = alone["effects"][0]["parameters"]["offset_mm"]
    (number,) = [n for n in row.numbers if n.parameter == "offset"]
    assert (number.value, number.error) == pytest.approx((offset["value"], offset["error"]), rel=1e-3)
    assert number.value == pytest.approx(0.15, abs=0.01)


# --- the table ---


def test_a_table_gives_back_what_was_written(tmp_path: Path) -> None:
    odd = fitted("odd", "size", 1.0, math.nan)
    written = [
        result("a", 0, fitted("warm", "size", 0.25, 0.5, 1.0), odd),
        result("b", 1, failed='it\'s broken, "really"\nμ'),
        result("c", 2),
    ]
    path = tmp_path / "t.parquet"
    write_table(path, written, {"task": "explain"})
    back, settings = read_table(path)
    assert settings == {"task": "explain"}
    assert [r.facts for r in back] == [r.facts for r in written]
    assert back[1:] == written[1:]
    assert back[0].numbers[0] == written[0].numbers[0]
    assert math.isnan(back[0].numbers[1].error)
    rows = pandas.read_parquet(path)
    assert len(rows) == 4
    assert list(rows.drop_duplicates("folder").headset) == ["a", "b", "c"]
    wide = rows.pivot_table(index="folder", columns=["effect", "parameter"], values="value")
    assert wide.loc["/sets/a-0", ("warm", "size")] == 0.25


def test_the_time_is_that_of_captures_csv_or_else_of_the_first_picture(
    headsets: list[Path], tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    shutil.copytree(headsets[0], folder)
    captures = read_captures(folder)
    os.utime(captures.captures[0].image, (1_700_000_000, 1_700_000_000))
    time, where = time_of(captures)
    assert (time.isoformat(), where) == ("2023-11-14T22:13:20+00:00", "file")
    path = folder / "captures.csv"
    without = path.read_text()

    def taken(text: str) -> None:
        path.write_text(without)
        column_added(path, "taken_at", text)

    taken("2026-03-01T14:30:00+01:00")
    time, where = time_of(read_captures(folder))
    assert (time.isoformat(), where) == ("2026-03-01T13:30:00+00:00", "captures.csv")
    taken("yesterday")
    with pytest.raises(InputError, match="taken_at is 'yesterday'; write a date"):
        time_of(read_captures(folder))
    facts = set_facts(folder, None)
    assert (facts.headset, facts.headset_from, facts.stamp) == ("set", "folder", "")


# --- the run: `finished` is put in place of the work of minutes ---


@pytest.fixture
def sets(headsets: list[Path], tmp_path: Path) -> list[Path]:
    """Four copies of sets."""
    copies = [tmp_path / f"set-{k}" for k in range(4)]
    for copy, source in zip(copies, headsets, strict=False):
        shutil.copytree(source, copy)
    return copies


Stub = Callable[..., list[str]]


@pytest.fixture
def worked(monkeypatch: pytest.MonkeyPatch) -> Stub:
    """Put a stub in place of the work on a set; gives the list of sets that were worked on.

    `fails`: the name of a set that fails. `stops`: how many are done before Ctrl-C.
    """

    def put(fails: str = "", stops: int = 99) -> list[str]:
        done: list[str] = []

        def finished(task: SetTask) -> SetResult:
            if len(done) == stops:
                raise KeyboardInterrupt
            name = Path(task.facts.folder).name
            done.append(name)
            if name == fails:
                return failed(task, ZeroDivisionError("division by zero"))
            one = result("x", 0, fitted("warm", "size", float(name[-1])))
            return SetResult(task.facts, verdict="complete", numbers=one.numbers)

        monkeypatch.setattr(fleet_run, "finished", finished)
        return done

    return put


def test_a_failure_costs_its_own_row_and_is_tried_again(
    sets: list[Path], worked: Stub, tmp_path: Path, capsys: Any
) -> None:
    words = ("fleet", *sets, "--out", tmp_path / "t.parquet")
    done = worked(fails="set-1")
    found = ran(capsys, *words)
    assert done == ["set-0", "set-1", "set-2", "set-3"]
    assert found["failed"] == [{"folder": str(sets[1]), "why": "ZeroDivisionError: division by zero"}]
    assert found["finished"] == 3
    assert main([*map(str, words)]) == 0
    out, err = capsys.readouterr()
    assert "3 of 4 sets" in out
    assert f"warning: {sets[1]} failed: ZeroDivisionError" in err
    done = worked()
    assert ran(capsys, *words)["failed"] == []
    assert done == ["set-1"]


def test_after_ctrl_c_the_same_command_does_what_is_missing(
    sets: list[Path], worked: Stub, tmp_path: Path, capsys: Any
) -> None:
    table = tmp_path / "t.parquet"
    words = [str(w) for w in ("fleet", *sets, "--out", table, "--report", tmp_path / "p.html")]
    done = worked(stops=2)
    assert main(words) == 130
    assert (
        f"interrupted; 2 finished sets are in {table}; go on with the same command" in capsys.readouterr().err
    )
    assert [r.facts.folder for r in read_table(table)[0]] == [str(s) for s in sets[:2]]
    done = worked()
    found = ran(capsys, *words)
    assert done == ["set-2", "set-3"]
    assert (found["taken_up"], found["finished"]) == (2, 4)
    assert [r.facts.folder for r in read_table(table)[0]] == [str(s) for s in sets]


def test_ctrl_c_before_anything_leaves_nothing(
    sets: list[Path], worked: Stub, tmp_path: Path, capsys: Any
) -> None:
    worked(stops=0)
    assert main(["fleet", *map(str, sets), "--out", str(tmp_path / "t.parquet")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "t.parquet").exists()


def test_a_set_that_has_changed_is_done_again_and_others_stay(
    sets: list[Path], worked: Stub, tmp_path: Path, capsys: Any
) -> None:
    words = ("--out", tmp_path / "t.parquet")
    worked()
    ran(capsys, "fleet", *sets[:3], *words)
    image = opened(sets[0]).captures[1].image
    os.utime(image, (1_700_000_000, 1_700_000_000))
    done = worked()
    found = ran(capsys, "fleet", sets[0], sets[3], sets[3], *words)
    assert done == ["set-0", "set-3"]
    assert (found["sets"], found["taken_up"]) == (4, 0)


def test_a_table_of_another_run_and_any_other_file_are_kept(
    sets: list[Path], worked: Stub, model: Path, tmp_path: Path, capsys: Any
) -> None:
    table, page = tmp_path / "t.parquet", tmp_path / "p.html"
    worked()
    ran(capsys, "fleet", *sets, "--out", table)
    words = [str(w) for w in ("fleet", *sets, "--out", table)]

    def refused(*more: object) -> str:
        assert main([*words, *map(str, more)]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err

    assert "another task (explain, now recalibrate)" in refused("--model", model)
    page.write_text("<p>mine</p>")
    assert f"--report {page} is there already" in refused("--report", page)
    done = worked()
    ran(capsys, *words, "--model", model, "--overwrite")
    assert len(done) == 4
    assert read_table(table)[1]["task"] == "recalibrate"
    table.write_text("mine")
    assert "is no table of fleet" in refused()
    assert table.read_text() == "mine"


def test_a_folders_own_model_comes_first(sets: list[Path], model: Path, tmp_path: Path, worked: Stub) -> None:
    shutil.copy(model, sets[1] / "own.toml")
    settings = fleet_run.settings_of(Path("own.toml"), [])
    planned = fleet_run.plan(sets[:2], tmp_path / "t.parquet", settings, [], Path("own.toml"))
    assert [t.model for t in planned.tasks] == [Path("own.toml").absolute(), sets[1] / "own.toml"]
    assert planned.tasks[0].facts.stamp == ""  # there is none: the set fails, and says why
    with pytest.raises(InputError, match="--model none.toml is not there, and in no set's folder either"):
        fleet_run.plan(sets, tmp_path / "t.parquet", settings, [], Path("none.toml"))


def test_when_no_set_can_be_used_it_is_one_sentence(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["fleet", str(tmp_path / "empty"), "--out", str(tmp_path / "t.parquet")]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "none of 1 sets could be used" in said
    assert "bench.toml" in said


def test_without_pyarrow_it_is_one_sentence_before_any_work(
    sets: list[Path], worked: Stub, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = worked()
    assert main(["fleet", *map(str, sets), "--out", str(tmp_path / "t.parquet"), "--overwrite"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].endswith("pip install 'hololoop[cluster]'")
    assert done == []


# --- lost workers ---

ENDS = "__import__('os')._exit(1)"
ONCE = ENDS + " if not __import__('os').path.exists({0!r}) and not open({0!r}, 'w').close() else {1}"


def test_a_process_that_dies_costs_its_task_alone() -> None:
    beside = "__import__('time').sleep(2) or 7"  # under way when the other one dies, and done again
    found = dict(outcomes(eval, [(beside,), (ENDS,), ("2 * 2",)], 2, None))
    assert isinstance(found.pop(1), InputError)
    assert found == {0: 7, 2: 4}


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a scheduler with two workers, processes of their own."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", processes=True
    ) as started:
        yield started.scheduler_address


def test_a_cluster_gives_the_task_of_a_lost_worker_to_another(cluster: str, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    tasks = [(f"open({str(runs)!r}, 'a').write('{k}\\n') and {k} * {k}",) for k in range(6)]
    tasks[2] = (ONCE.format(str(tmp_path / "once"), 4),)
    tasks[4] = ("1 / 0",)
    found = dict(outcomes(eval, tasks, 1, cluster))
    assert isinstance(found.pop(4), ZeroDivisionError)
    assert found == {0: 0, 1: 1, 2: 4, 3: 9, 5: 25}
    # A result that had not been fetched from the lost worker is made once more, and no other.
    assert len(runs.read_text().splitlines()) <= 5


def test_a_cluster_finds_what_this_process_finds(
    cluster: str, headsets: list[Path], model: Path, tmp_path: Path, capsys: Any
) -> None:
    words = ("fleet", *headsets[:2], "--model", model, "--out")
    here = ran(capsys, *words, tmp_path / "here.parquet")
    there = ran(capsys, *words, tmp_path / "there.parquet", "--cluster", cluster)
    assert (here["finished"], there["finished"]) == (2, 2)
    one, other = (read_table(tmp_path / f"{name}.parquet")[0] for name in ("here", "there"))
    for a, b in zip(one, other, strict=True):
        assert a.facts == b.facts
        assert [n.key for n in a.numbers] == [n.key for n in b.numbers]
        assert [n.value for n in a.numbers] == pytest.approx([n.value for n in b.numbers], rel=1e-3, abs=1e-4)
    json.dumps(there)
