"""Work in processes: what a task says, what goes wrong, and how it is ended."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from firmware_iface.errors import InputError
from tests.waiting import until
from trainer.studio import jobs
from trainer.studio.jobs import CANCELLED, ENDED, WorkerProcess, sentence_of


def _echo(say: Any, word: str) -> str:
    say("progress", (0.5, "half"))
    return word


def _sleep(say: Any) -> None:
    say("pid", os.getpid())
    time.sleep(60)


def _fails(say: Any, kind: str) -> None:
    if kind == "input":
        raise InputError("this is wrong: change that")
    if kind == "full":
        raise OSError(28, "No space left on device")
    if kind == "memory":
        raise MemoryError
    raise ValueError("surprise")


class Heard:
    """What a worker has said."""

    def __init__(self) -> None:
        self.words: list[tuple[str, Any]] = []
        self.ended = threading.Event()

    def __call__(self, kind: str, value: Any) -> None:
        self.words.append((kind, value))
        if kind in ("done", "failed", "cancelled"):
            self.ended.set()


@pytest.fixture(scope="module")
def worker() -> Iterator[WorkerProcess]:
    one = WorkerProcess("test")
    one.start()
    yield one
    one.close()


def test_a_worker_does_tasks_and_says_how_far_it_is(worker: WorkerProcess) -> None:
    heard = Heard()
    worker.submit(_echo, ("word",), heard)
    assert heard.ended.wait(60)
    assert heard.words == [("progress", (0.5, "half")), ("done", "word")]


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("input", "change that"),
        ("full", "disk is full"),
        ("memory", "not enough memory"),
        ("", "did not work"),
    ],
)
def test_what_goes_wrong_is_one_sentence(worker: WorkerProcess, kind: str, said: str) -> None:
    heard = Heard()
    worker.submit(_fails, (kind,), heard)
    assert heard.ended.wait(60)
    ((how, sentence),) = heard.words
    assert how == "failed" and said in sentence and "Traceback" not in sentence and "\n" not in sentence


def test_a_task_is_cancelled_and_a_killed_worker_is_replaced(worker: WorkerProcess) -> None:
    heard = Heard()
    worker.submit(_sleep, (), heard)
    until(lambda: heard.words, 60)
    assert worker.busy
    with pytest.raises(InputError, match="under way"):
        worker.submit(_echo, ("no",), Heard())
    assert worker.cancel()
    assert heard.words[-1] == ("cancelled", CANCELLED)
    assert not worker.cancel()
    heard = Heard()
    worker.submit(_sleep, (), heard)
    pid = until(lambda: next((v for k, v in heard.words if k == "pid"), None), 60)
    os.kill(pid, signal.SIGKILL)
    assert heard.ended.wait(30)
    assert heard.words[-1] == ("failed", ENDED)
    heard = Heard()
    worker.submit(_echo, ("again",), heard)
    assert heard.ended.wait(60) and heard.words[-1] == ("done", "again")


def test_errors_of_files_name_the_file() -> None:
    assert "x.png cannot be used" in sentence_of(FileNotFoundError(2, "No such file", "x.png"))
    assert jobs.sentence_of(OSError(28, "No space left")).startswith("The disk is full")
