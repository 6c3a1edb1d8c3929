"""Long work that is under way: one piece at a time, with how far it is and how long it still takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from firmware_iface.errors import InputError
from trainer.studio.jobs import Say, WorkerProcess, sentence_of


@dataclass
class Work:
    """Long work that is under way.

    Attributes
    ----------
    name : str
        What a person asked for: "Diagnose", "Add zero_order" and so on.
    share : float
        That is done.
    what : str
        Is done now.
    started : float, s
        Of the monotonic clock.
    """

    name: str
    share: float = 0.0
    what: str = "starting"
    started: float = field(default_factory=time.monotonic)

    @property
    def seconds_left(self) -> float | None:
        """An estimate; None while there is nothing to estimate from."""
        spent = time.monotonic() - self.started
        if self.share < 0.04 or spent < 1.0:
            return None
        return spent * (1 - self.share) / self.share


class RunningWork:
    """The process of long work, and what is under way in it.

    Parameters
    ----------
    prepared : str
        A module that the process imports before the first task comes.
    tell : callable
        Called with the topic "job" at each change.
    say : callable
        Called with a sentence and a severity when work has ended without a result.
    news : callable
        Called with what a task says before its end.
    """

    def __init__(
        self, prepared: str, tell: Callable[..., None], say: Callable[[str, str], None], news: Say
    ) -> None:
        self.work: Work | None = None
        self._tell, self._say, self._news = tell, say, news
        self._worker = WorkerProcess("hololoop studio: work", prepared)

    def begin(
        self, name: str, task: Callable[..., Any], arguments: tuple[Any, ...], done: Callable[[Any], None]
    ) -> None:
        """Begin a task; `done` is called with its result, and may raise InputError or OSError."""

        def heard(kind: str, value: Any) -> None:
            if kind == "progress":
                if self.work is not None:
                    self.work.share, self.work.what = value
                self._tell("job")
            elif kind == "done":
                self.work = None
                try:
                    done(value)
                except (InputError, OSError) as error:
                    self._say(sentence_of(error), "error")
                    self._tell("model", "diagnosis")
                self._tell("job")
            elif kind in ("failed", "cancelled"):
                self._finish()
                self._say(str(value), "error" if kind == "failed" else "note")
            else:
                self._news(kind, value)

        self.work = Work(name)
        self._tell("job")
        try:
            self._worker.submit(task, arguments, heard)
        except InputError as error:
            self._finish()
            self._say(str(error), "error")

    def prepare(self) -> None:
        """Start the process, so that the first task finds it ready."""
        self._worker.start()

    def cancel(self) -> None:
        """End the work that is under way."""
        if not self._worker.cancel():
            self._finish()

    def close(self) -> None:
        """End the process."""
        self._worker.close()

    def _finish(self) -> None:
        self.work = None
        self._tell("job")
