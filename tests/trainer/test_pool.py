"""The same numbers wherever fits run, and one sentence where they cannot."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

from firmware_iface.errors import InputError
from tests.waiting import until
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.cli import main
from trainer.diagnosis.diagnosis import Diagnosis, diagnose
from trainer.effects import testing
from trainer.effects.effect_catalogue import Catalogue, catalogue, load_effects
from trainer.fitting import pool
from trainer.fitting.pool import open_pool
from trainer.model.model import Model

ROOT = Path(__file__).resolve().parent.parent.parent

OWN = '''
"""A sensor that is more sensitive at the bottom, and at the corners."""
from trainer.effects import Parameter, effect

@effect(stage="sensor", acts_on="camera", parameters=[Parameter("tilt", "1", scale=0.03, low=-1, high=1)])
def row_tilt(sensor, tilt):
    """Rows differ in sensitivity."""
    return sensor.multiplied(1 + tilt * sensor.y)

@effect(stage="sensor", acts_on="camera", parameters=[Parameter("twist", "1", scale=0.03, low=-1, high=1)])
def corner_twist(sensor, twist):
    """Corners differ in sensitivity."""
    return sensor.multiplied(1 + twist * sensor.y * sensor.x)
'''


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's file of effects."""
    path = tmp_path_factory.mktemp("own") / "own.py"
    path.write_text(OWN)
    return path


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, own: Path) -> CaptureSet:
    """A small capture set with a user's effect hidden in it."""
    effect = next(e for e in load_effects(own) if e.name == "row_tilt")
    return testing.captures_with(tmp_path_factory.mktemp("pool") / "set", effect, {"tilt": 0.2}, patterns=4)


def few(known: Catalogue, own: Path) -> Catalogue:
    """Effects that are quick to try, and those of the user's file."""
    return {n: e for n, e in known.items() if e.source == str(own) or n in ("vignetting", "sensor_blur")}


def watched(captures: CaptureSet, own: Path, workers: int) -> tuple[Diagnosis, list[float]]:
    """A diagnosis by that many processes, and the shares done that it reported."""
    known = few(catalogue([own]), own)
    assert len(known) == 4
    shares: list[float] = []
    with open_pool(workers) as running:
        assert running.workers == workers
        found = diagnose(
            captures, Model(captures.bench), known, running, progress=lambda s, _: shares.append(s)
        )
    return found, shares


@pytest.fixture(scope="module")
def alone(captures: CaptureSet, own: Path) -> Iterator[tuple[Diagnosis, list[float]]]:
    """What one process finds, by sums in the order of the pool's processes, which have one thread each."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield watched(captures, own, 1)
    torch.set_num_threads(threads)


def test_one_process_and_two_give_the_same_numbers(
    captures: CaptureSet, own: Path, alone: tuple[Diagnosis, list[float]]
) -> None:
    found, shares = alone
    assert found.best is not None
    assert found.best.effect.name in ("row_tilt", "vignetting")
    together, shares_of_two = watched(captures, own, 2)
    assert_same(found.as_json(), together.as_json())
    for one in (shares, shares_of_two):
        assert one[-1] == 1
        assert all(0 <= share <= 1 for share in one)


def assert_same(here: dict[str, Any], there: dict[str, Any]) -> None:
    """The same words at the same places, and the same numbers up to rounding."""
    one, other = numbers(here), numbers(there)
    assert list(one) == list(other)
    assert list(one.values()) == pytest.approx(list(other.values()), rel=1e-3, abs=1e-7)


def numbers(found: Any, where: str = "") -> dict[str, float]:
    """Every number of a JSON object by its place; words are part of the place."""
    if isinstance(found, dict):
        parts = [numbers(v, f"{where}.{k}") for k, v in found.items() if k != "sentence"]
    elif isinstance(found, list | tuple):
        parts = [numbers(v, f"{where}[{k}]") for k, v in enumerate(found)]
    else:
        number = isinstance(found, int | float) and not isinstance(found, bool)
        return {where: found} if number else {f"{where} = {found}": 0.0}
    return {place: value for part in parts for place, value in part.items()}


# How many threads products of matrices have in workers, where the environment says two.
PRODUCTS = """
from threadpoolctl import threadpool_info
from trainer.fitting.pool import open_pool
with open_pool(2) as pool:
    for library in sum(pool.map(threadpool_info, [(), ()]), []):
        if library["user_api"] == "blas":
            print(library["num_threads"])
"""


def test_workers_multiply_on_one_thread() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PRODUCTS],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(done.stdout.split()) == {"1"}


def test_results_come_in_the_order_of_the_tasks_and_errors_come_out() -> None:
    counts: list[int] = []
    with open_pool(1) as running:
        assert running.map(pow, [(2, k) for k in range(5)], counts.append) == [1, 2, 4, 8, 16]
        assert counts == [1, 2, 3, 4, 5]
        assert running.map(pow, []) == []
        with pytest.raises(ZeroDivisionError):
            running.map(divmod, [(1, 1), (1, 0)])
    with pytest.raises(InputError, match="--workers -1"), open_pool(-1):
        pass


def test_a_process_that_is_lost_is_one_sentence() -> None:
    with pytest.raises(InputError, match="memory"), open_pool(2) as running:
        running.map(os._exit, [(3,)])


def test_nothing_of_it_runs_on_after_an_interruption() -> None:
    before = set(threading.enumerate())
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), open_pool(2) as two:
        busy = [two.submit(time.sleep, (60,)) for _ in range(8)]
        until(lambda: sum(future.running() for future in busy) >= 2, 30)
        raise KeyboardInterrupt
    assert time.monotonic() - start < 30
    assert all(future.done() for future in busy)
    assert set(threading.enumerate()) <= before


# --- in processes of their own: what a signal does to workers that are in the middle of a task ---

SCRIPT = """
import sys, time
from trainer.fitting.pool import open_pool
if __name__ == "__main__":
    try:
        with open_pool(2) as pool:
            if sys.argv[1] == "ready":
                pool.map(time.sleep, [(0.5,)] * 2)
            print("go", flush=True)
            pool.map(time.sleep, [(60,)] * 4)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def test_lost_processes_say_nothing_of_tasks_that_were_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after Ctrl-C, when tasks are cancelled and processes are ended: only one message is for the user."""
    unhandled: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", unhandled.append)
    with pytest.raises(InputError, match="has ended"), open_pool(2) as two:
        tasks = [two.submit(time.sleep, (60,)) for _ in range(12)]  # five of them may be past cancelling
        until(lambda: sum(task.running() for task in tasks) >= 2, 30)
        assert sum(task.cancel() for task in tasks) >= 4
        for process in list(two.executor._processes.values()):
            process.terminate()
        try:
            two.result(next(task for task in tasks if not task.cancelled()))
        except BrokenExecutor as error:
            two.executor._executor_manager_thread.join(30)
            raise InputError(pool.LOST) from error
    assert not unhandled


@pytest.mark.parametrize(
    ("when", "delay", "which"),
    [
        ("starting", 0.3, "SIGINT"),
        ("starting", 0.8, "SIGINT"),
        ("ready", 0.5, "SIGINT"),
        ("ready", 0.5, "SIGKILL"),
    ],
)
def test_workers_stop_at_once_and_silently(when: str, delay: float, which: str, tmp_path: Path) -> None:
    psutil = pytest.importorskip("psutil")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script), when],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "go\n"
    time.sleep(delay)
    family = psutil.Process(process.pid).children(recursive=True)
    assert len(family) >= 2
    if which == "SIGINT":
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of them
    else:
        process.kill()
    start = time.monotonic()
    try:
        _, err = process.communicate(timeout=40)
    finally:
        _, alive = psutil.wait_procs(family, timeout=10)
        for one in alive:
            one.kill()
    assert time.monotonic() - start < 20
    assert not alive
    if which == "SIGINT":
        assert (process.returncode, err) == (130, "")


# --- on a Dask cluster ---


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a scheduler with one worker, a process of its own."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=":0", processes=True
    ) as started:
        yield started.scheduler_address


Run = Callable[..., dict[str, Any]]


@pytest.fixture
def diagnosed(captures: CaptureSet, own: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> Run:
    """`diagnose --json` of the set with a user's effects; only a few of the others are tried, to be quick."""
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)
    monkeypatch.setattr(
        "trainer.effects.effect_catalogue.catalogue", lambda files=(): few(catalogue(files), own)
    )

    def run(*options: str) -> dict[str, Any]:
        capsys.readouterr()
        code = main(["diagnose", str(captures.folder), "--effects", str(own), "--json", *options])
        out, err = capsys.readouterr()
        assert code == 0, err
        found: dict[str, Any] = json.loads(out)
        return found

    return run


def test_a_cluster_gives_the_ranking_that_this_process_gives(
    cluster: str, diagnosed: Run, alone: tuple[Diagnosis, list[float]]
) -> None:
    here = alone[0].as_json()
    assert "row_tilt" in [r["effect"] for r in here["ranking"]]
    assert "corner_twist" in [s["effect"] for s in here["screen"]]
    assert_same(here, diagnosed("--cluster", cluster))


def test_a_cluster_sees_captures_and_effects_as_they_are_now(
    cluster: str, captures: CaptureSet, own: Path, tmp_path: Path
) -> None:
    path = tmp_path / "mine.py"
    sizes = []
    for sign in ("+", "-"):
        path.write_text(OWN.replace("1 + tilt", f"1 {sign} tilt"))
        known = few(catalogue([path]), path)
        with open_pool(cluster=cluster) as running:
            found = diagnose(captures, Model(captures.bench), known, running, thorough=False)
        best = next(r for r in found.ranking if r.effect.name == "row_tilt")
        sizes.append(float(best.model.present[0].values["tilt"]))
    assert sizes == pytest.approx([0.2, -0.2], abs=0.01)

    folder = tmp_path / "set"
    for tilt in (0.2, 0.1):
        if folder.exists():
            folder.rename(tmp_path / "before")
        testing.captures_with(folder, catalogue([own])["row_tilt"], {"tilt": tilt}, patterns=3)
        with open_pool(cluster=cluster) as running:
            set_now = read_captures(folder)
            found = diagnose(
                set_now, Model(set_now.bench), few(catalogue([own]), own), running, thorough=False
            )
        best = next(r for r in found.ranking if r.effect.name == "row_tilt")
        assert float(best.model.present[0].values["tilt"]) == pytest.approx(tilt, abs=0.01)


def test_a_task_that_a_cluster_cannot_read_comes_back_as_an_error(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "only_here.py").write_text("def double(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    from only_here import double  # type: ignore[import-not-found]

    with pytest.raises(ModuleNotFoundError, match="only_here"), open_pool(cluster=cluster) as running:
        running.map(double, [(1,)])


def one_line_of_error(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    return err


def test_no_scheduler_is_one_sentence_and_soon(
    captures: CaptureSet, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    assert pool.ANSWER_S <= 5
    monkeypatch.setattr(pool, "ANSWER_S", 1.0)
    with socket.socket() as free, socket.socket() as silent:
        free.bind(("127.0.0.1", 0))  # taken, so that nobody else listens there
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        addresses = [f"tcp://127.0.0.1:{s.getsockname()[1]}" for s in (free, silent)]
        for address in [*addresses, "nonsense", "ftp://127.0.0.1:1"]:
            start = time.monotonic()
            assert main(["diagnose", str(captures.folder), "--cluster", address, "--json"]) == 2
            said = one_line_of_error(capsys)
            assert f"no Dask scheduler answers at '{address}'" in said
            assert address != addresses[0] or "nobody answers there: the connection was refused" in said
            assert time.monotonic() - start < 5


def test_a_scheduler_without_workers_is_one_sentence(captures: CaptureSet, capsys: Any) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=0, dashboard_address=":0", processes=False) as empty:
        assert main(["diagnose", str(captures.folder), "--cluster", empty.scheduler_address]) == 2
    assert "has no workers: start one" in one_line_of_error(capsys)
