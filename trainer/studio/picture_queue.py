"""Predictions of captures for the page, in a process of their own: what somebody looks at first, then what maps need.

A *revision* is one model: the shown ones count upwards, second models downwards, so that what belongs to an earlier
model is never shown.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Capture
from trainer.captures.problems import Problem
from trainer.diagnosis.capture_errors import CaptureErrors, SetErrors
from trainer.model.model import Model
from trainer.studio import job_tasks
from trainer.studio.job_tasks import CapturePrediction
from trainer.studio.jobs import WorkerProcess

KEPT_BYTES = 768 * 2**20  # of predicted captures

Key = tuple[int, str]  # revision, capture


class PictureQueue:
    """What is predicted of one capture set, and what still is to be.

    Parameters
    ----------
    lock : RLock
        Of the project.
    tell : callable
        Called with the topics that have changed: "picture", "errors".
    checked : callable
        Called with what the check of the set has found.
    failed : callable
        Called with a sentence where nothing can be predicted.
    worker : WorkerProcess
        Predicts.
    """

    def __init__(
        self,
        lock: Any,
        tell: Callable[..., None],
        checked: Callable[[list[Problem]], None],
        failed: Callable[[str], None],
        worker: WorkerProcess,
    ) -> None:
        self._lock, self._tell, self._checked, self._failed = lock, tell, checked, failed
        self._worker = worker
        self._closed = threading.Event()
        self._shown, self._other = 0, -1
        self.effects_version = 0
        self.forget(None, None, ())

    def close(self) -> None:
        """End the process."""
        self._closed.set()
        self._worker.close()

    def forget(self, folder: Path | None, captures: CaptureSet | None, held_out: Sequence[Capture]) -> None:
        """Begin with another set, or with the same one read again."""
        with self._lock:
            self._folder, self._captures, self._held_out = folder, captures, tuple(held_out)
            self._shown, self._other = self._shown + 1, self._other - 1
            self._models: dict[int, Model] = {}
            self._network: Path | None = None
            self._predictions: OrderedDict[Key, CapturePrediction] = OrderedDict()
            self._errors: dict[Key, CaptureErrors | None] = {}
            self._faults: dict[Key, str] = {}
            self._wanted: list[Key] = []
            self._is_checked = False

    def show(self, model: Model, network: Path | None = None) -> None:
        """Predict by another model from now on, with the network in a file where there is one."""
        with self._lock:
            self._drop(self._shown)
            self._shown += 1
            self._models[self._shown] = model
            self._network = network

    def show_other(self, model: Model | None) -> None:
        """Predict by a second model, too; None: no longer."""
        with self._lock:
            self._drop(self._other)
            self._other -= 1
            if model is not None:
                self._models[self._other] = model

    def _drop(self, revision: int) -> None:
        self._models.pop(revision, None)
        for kept in (self._predictions, self._errors, self._faults):
            for key in [k for k in kept if k[0] == revision]:
                del kept[key]
        self._wanted = [k for k in self._wanted if k[0] != revision]

    @property
    def model(self) -> Model | None:
        """The shown model, with the gains that it lacked as soon as they are fitted."""
        return self._models.get(self._shown)

    def prediction(self, capture: str, of_other: bool = False) -> CapturePrediction | None:
        """A capture, measured and predicted; None while it is computed, which "picture" tells the end of."""
        with self._lock:
            key = (self._other if of_other else self._shown, capture)
            if key in self._predictions:
                self._predictions.move_to_end(key)
                return self._predictions[key]
            if key[0] not in self._models or key in self._faults:
                return None
            if key in self._wanted:
                self._wanted.remove(key)
            self._wanted.insert(0, key)
        self.work()
        return None

    def fault(self, capture: str) -> str:
        """Why a capture cannot be predicted; "" where it can."""
        return self._faults.get((self._shown, capture), "")

    @property
    def errors(self) -> SetErrors | None:
        """Where the model fails on the held-out captures; None until all of them are predicted."""
        with self._lock:
            if not self._held_out or self._rest():
                return None
            found = [self._errors.get((self._shown, c.capture)) for c in self._held_out]
            return SetErrors.of([one for one in found if one is not None])

    def _rest(self) -> list[Key]:
        """What the maps of the set still need."""
        keys = [(self._shown, c.capture) for c in self._held_out]
        return [k for k in keys if k not in self._errors and k not in self._faults]

    def work(self) -> None:
        """Give the process its next task, where it has none."""
        with self._lock:
            if self._worker.busy or self._closed.is_set() or self._folder is None:
                return
            rest = self._rest() if self._shown in self._models else []
            first = len(rest) == len(self._held_out)  # one picture, then the check, then the other pictures
            if self._wanted:
                self._predict(self._folder, self._wanted[0])
            elif rest and (self._is_checked or first):
                self._predict(self._folder, rest[0])
            elif not self._is_checked:
                self._check(self._folder)

    def _check(self, folder: Path) -> None:
        def heard(kind: str, value: Any) -> None:
            if kind == "progress":
                return
            if folder == self._folder:
                self._checked(value if kind == "done" else [Problem("error", "unreadable", "", str(value))])
            self.work()

        self._is_checked = True
        self._worker.submit(job_tasks.check, (folder,), heard)

    def _predict(self, folder: Path, key: Key) -> None:
        model = self._models[key[0]]
        assert self._captures is not None
        if set(self._captures.channels) - set(model.gain):
            self._worker.submit(job_tasks.fit_gains, (folder, model), lambda k, v: self._gained(key[0], k, v))
        else:
            network = self._network if key[0] == self._shown else None
            arguments = (folder, model, key[1], network, self.effects_version)
            self._worker.submit(job_tasks.predict, arguments, lambda k, v: self._predicted(key, k, v))

    def _gained(self, revision: int, kind: str, value: Any) -> None:
        with self._lock:
            if revision in self._models and kind == "done":
                self._models[revision] = value
            elif revision in self._models and kind == "failed":
                names = [c.capture for c in self._captures.captures] if self._captures is not None else []
                self._faults.update({(revision, name): str(value) for name in names})
                self._wanted = [k for k in self._wanted if k[0] != revision]
                self._failed(str(value))
        if kind == "failed":
            self._tell("picture", "errors")
        self.work()

    def _predicted(self, key: Key, kind: str, value: Any) -> None:
        with self._lock:
            if key in self._wanted:
                self._wanted.remove(key)
            if key[0] in self._models and kind == "done":
                self._predictions[key] = value
                self._errors[key] = value.errors
                self._drop_old()
            elif key[0] in self._models and kind == "failed":
                self._faults[key] = str(value)
            complete = not self._rest()
        self._tell("picture")
        if complete and key[0] == self._shown:
            self._tell("errors")
        self.work()

    def _drop_old(self) -> None:
        """Forget pictures that nobody has looked at for long; where the model fails on them is kept."""
        sizes = {k: p.measured.nbytes + p.predicted.nbytes for k, p in self._predictions.items()}
        size = sum(sizes.values())
        for key in list(self._predictions)[:-1]:
            if size <= KEPT_BYTES:
                return
            del self._predictions[key]
            size -= sizes[key]
