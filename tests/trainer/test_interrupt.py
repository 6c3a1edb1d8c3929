"""Ctrl-C in the middle of a real `explain`: what was found stays, nothing else does."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model
from trainer.model.model_file import read_model

psutil = pytest.importorskip("psutil")

ROOT = Path(__file__).resolve().parent.parent.parent
PATIENCE_S = 240  # for a machine that is busy with other tests


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set in which two things are hidden, so that there is work left when the first has been found."""
    folder = tmp_path_factory.mktemp("interrupted")
    defects = ('kind = "distance"', 'kind = "zero_order"')
    bench = bench_file(folder, *defects, width=80, height=64, distance_mm=8)
    acquire_from(str(bench), folder / "captures", patterns=6)
    return folder / "captures"


@dataclass
class Explaining:
    """An `explain` that runs in a session of its own, as in a terminal of its own."""

    process: subprocess.Popen[str]
    out: Path

    def model(self) -> Model | None:
        """The model so far; a file that is there must be whole."""
        try:
            return read_model(self.out, catalogue())
        except InputError:
            assert not self.out.exists(), self.out.read_text()
            return None

    def until(self, enough: Callable[[], bool]) -> None:
        """Wait, but not for ever, and not once the process has ended."""
        end = time.monotonic() + PATIENCE_S
        while not enough():
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < end
            time.sleep(0.02)

    def family(self) -> list[psutil.Process]:
        """Every process below it."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def ended(self) -> tuple[int, str, str, float]:
        """Exit code, stdout, stderr, and the seconds that it took."""
        start = time.monotonic()
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out, err, time.monotonic() - start


@pytest.fixture
def explain(captures: Path, tmp_path: Path) -> Iterator[Callable[[int], Explaining]]:
    """Starts `explain` with a number of workers; its temporary files go to a folder of the test's."""
    (tmp_path / "temporary").mkdir()
    (tmp_path / "models").mkdir()
    started: list[Explaining] = []

    def start(workers: int) -> Explaining:
        out = tmp_path / "models" / "model.toml"
        command = [
            sys.executable,
            "-m",
            "tests.trainer.few_effects",
            "explain",
            str(captures),
            "--out",
            str(out),
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path / "temporary")}
        process = subprocess.Popen(
            [*command, "--workers", str(workers), "--json", "--quiet"],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(Explaining(process, out))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            os.killpg(one.process.pid, signal.SIGKILL)
            one.process.wait()


def gone(family: list[psutil.Process], within_s: float = 20) -> bool:
    """Whether none of these processes is left."""
    _, alive = psutil.wait_procs(family, timeout=within_s)
    return not [p for p in alive if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


def assert_clean(explaining: Explaining, tmp_path: Path) -> None:
    """Nothing but the model is left on the disk."""
    model = explaining.out
    kept = {model.name, *re.findall(r'file = "(.+)"', model.read_text())} if model.exists() else set()
    assert {p.name for p in model.parent.iterdir()} == kept
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_ctrl_c_leaves_the_model_so_far_and_says_so(
    workers: int, explain: Callable[[int], Explaining], tmp_path: Path
) -> None:
    explaining = explain(workers)
    explaining.until(lambda: bool((model := explaining.model()) and model.names))
    family = explaining.family()
    assert len(family) >= (workers if workers > 1 else 0)
    os.killpg(explaining.process.pid, signal.SIGINT)  # as a terminal does: to every process of the command
    code, out, err, took = explaining.ended()
    model = explaining.model()
    assert model is not None
    assert (code, out) == (130, "")
    added = f"interrupted after adding {', '.join(model.names)}; the model so far is in {explaining.out}"
    assert err.startswith(f"hololoop-trainer: {added}; go on with: hololoop-trainer explain ")
    assert err.endswith(f" --out {explaining.out} --overwrite --model {explaining.out}\n")
    assert err.count("\n") == 1
    assert took < 10
    assert gone(family)
    assert_clean(explaining, tmp_path)


def test_ctrl_c_while_the_workers_start_is_one_line_too(
    explain: Callable[[int], Explaining], tmp_path: Path
) -> None:
    explaining = explain(2)
    explaining.until(lambda: len(explaining.family()) >= 2)
    time.sleep(0.4)  # they import by now, and have not been told yet what to do about signals
    family = explaining.family()
    os.killpg(explaining.process.pid, signal.SIGINT)
    code, out, err, took = explaining.ended()
    assert (code, out) == (130, "")
    assert err == "hololoop-trainer: interrupted before anything was added; nothing was written\n"
    assert explaining.model() is None
    assert took < 10
    assert gone(family)
    assert_clean(explaining, tmp_path)
