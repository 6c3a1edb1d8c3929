"""One studio: what is open, the work on it and its results; every browser watches the same one."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from trainer.captures.problems import Problem
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.previews import CandidatePreview
from trainer.diagnosis.ranking import RankedEffect
from trainer.model.model import Model
from trainer.studio import gain_tasks, job_tasks
from trainer.studio.effect_files import EffectFiles
from trainer.studio.jobs import WorkerProcess, picture_worker, sentence_of
from trainer.studio.learned_network import network_folder
from trainer.studio.open_set import TABLES, OpenSet
from trainer.studio.picture_queue import PictureQueue
from trainer.studio.running_work import RunningWork, Work
from trainer.studio.watched_files import WatchedFiles
from trainer.studio.watchers import Watchers
from trainer.studio.work_results import Results

TOPICS = ("set", "model", "picture", "errors", "job", "diagnosis", "notice", "effects", "other", "gain")
BUSY = "Other work is under way: wait for it, or cancel it."


class Project:
    """What is open in one studio, and the work on it.

    Parameters
    ----------
    home : Path
        Folder in which new files are made.
    effects : iterable of Path
        Files of the user's own effects; they are watched.
    worker : WorkerProcess, optional
        Predicts pictures; one that has been started early is ready sooner.

    Attributes
    ----------
    set : OpenSet
        Captures and model.
    results : Results
        What work has brought back on the model.
    effects : EffectFiles
        The catalogue.
    notice : (str, str)
        Severity and sentence of what just happened.
    """

    def __init__(self, home: Path, effects: Iterable[Path] = (), worker: WorkerProcess | None = None) -> None:
        self.home = home
        self.lock = threading.RLock()
        self.notice: tuple[str, str] = ("", "")
        self._watchers = Watchers()
        self.watch, self.unwatch, self.tell = self._watchers.add, self._watchers.remove, self._watchers.tell
        self.effects = EffectFiles(effects)
        self.results = Results()
        worker = worker or picture_worker()
        pictures = PictureQueue(self.lock, self.tell, self._checked, self._unpredictable, worker)
        pictures.effects_version = self.effects.version
        self.set = OpenSet(self.lock, pictures)
        self._jobs = RunningWork(job_tasks.__name__, self.tell, self.say, self._news)
        self._files = WatchedFiles(
            self.lock, lambda: [*self.effects.paths, *self.set.files()], self._changed_outside
        )

    # What everybody hears

    def say(self, sentence: str, severity: str = "note") -> None:
        """Show a sentence in every browser; severity is "note" or "error"."""
        self.notice = (severity, sentence)
        self.tell("notice")

    def close(self) -> None:
        """End all processes."""
        self._files.close()
        self.set.pictures.close()
        self._jobs.close()

    @property
    def work(self) -> Work | None:
        """What is under way; None where nothing is."""
        return self._jobs.work

    # The set and its model

    def open_set(self, folder: Path, model_path: Path | None = None) -> None:
        """Open a capture set; what is wrong with it is kept as a sentence and as the check's findings.

        Raises
        ------
        InputError
            Where there is no such folder.
        """
        folder = folder.absolute()
        if not folder.is_dir():
            raise InputError(
                f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv"
            )
        with self.lock:
            if self.work is not None:
                raise InputError("work is under way on the present captures: wait for it, or cancel it")
            self._forget()
            path = model_path or self.home / f"{folder.name}-model.toml"
            self._complain(self.set.open(folder, path.absolute(), self.effects.known))
            self._files.seen()
        self._show("set", "model", "notice")

    def close_set(self) -> None:
        """Back to the start page."""
        with self.lock:
            if self.work is not None:
                raise InputError("work is under way on these captures: wait for it, or cancel it")
            self._forget()
            self.set.close()
        self.tell("set", "model", "notice")

    def read_again(self) -> None:
        """Read the capture set again, after its tables have changed."""
        with self.lock:
            self.results.forget()
            self._complain(self.set.read(self.effects.known))
            self._files.seen()
        self._show("set", "model", "diagnosis", "picture")

    def undo(self) -> None:
        """Go back by a step."""
        self._step(-1)

    def redo(self) -> None:
        """Go forward by a step."""
        self._step(1)

    def _step(self, by: int) -> None:
        with self.lock:
            try:
                self.set.step(by, self.effects.known)
            except (InputError, OSError) as error:
                self.say(sentence_of(error), "error")
                return
            self.results.forget()
            self._files.seen()
            self.notice = ("", "")
        self._show("model", "diagnosis", "notice")

    def compare_with(self, name: str, model: Model | None) -> None:
        """Show a second model next to the first; None: no longer."""
        self.set.compare_with(name, model)
        self._show("other", "picture", "errors")

    def _write(self, model: Model) -> None:
        """Make a model the state of the page."""
        self.set.write(model)
        self.results.forget()
        self._files.seen()

    def _forget(self) -> None:
        self.results.forget()
        self.results.gain, self.notice = None, ("", "")

    def _complain(self, fault: str) -> None:
        if fault:
            self.notice = ("error", fault)

    def _show(self, *topics: str) -> None:
        """Say what has changed, and go on with pictures."""
        self.tell(*topics)
        self.set.pictures.work()

    def _checked(self, problems: list[Problem]) -> None:
        self._jobs.prepare()  # not before the first picture is there
        self.set.problems = problems
        self.tell("set")

    def _unpredictable(self, sentence: str) -> None:
        self.say(sentence, "error")

    # Work

    def diagnose(self) -> None:
        """Look for what is missing."""
        if self._ready():
            arguments = (self.set.folder, self.set.model_now, self.effects.paths)
            self._begin("Diagnose", job_tasks.find_missing, arguments, self._diagnosed)

    def add(self, name: str) -> None:
        """Put an effect in, and fit everything again."""
        if self._ready():
            arguments = (self.set.folder, self.set.model_now, name, self.effects.paths)
            self._begin(f"Add {name}", job_tasks.add_effect, arguments, self._added)

    def explain(self) -> None:
        """Diagnose and add, again and again."""
        if self._ready():
            arguments = (self.set.folder, self.set.model_now, self.effects.paths)
            self._begin("Explain", job_tasks.explain_all, arguments, self._diagnosed)

    def learn_field(self) -> None:
        """Learn the wave at the panel, without a name."""
        if self._ready():
            arguments = (self.set.folder, self.set.model_now)
            self._begin("Learn the field", job_tasks.learn_panel_field, arguments, self._learned)

    def train_network(self, steps: int) -> None:
        """Train a network on what the model leaves."""
        if self._ready() and self.set.model_path is not None:
            out = network_folder(self.set.model_path)
            arguments = (self.set.folder, self.set.model_now, steps, out)
            self._begin("Train a network", job_tasks.train_network, arguments, self._trained)

    def export(self, folder: Path) -> None:
        """Write the bundle for the headset."""
        if self._ready():
            network = self.set.network
            learned = None if network is None else network.path
            arguments = (self.set.folder, self.set.model_now, learned, folder)
            self._begin("Export", gain_tasks.export_model, arguments, self._exported)

    def show_gain(self, found: Any) -> None:
        """Show a displayed picture in every browser."""
        self.results.gain = found
        self.tell("gain")

    def cancel(self) -> None:
        """End the work that is under way."""
        self._jobs.cancel()

    def run(
        self, name: str, task: Callable[..., Any], arguments: tuple[Any, ...], done: Callable[[Any], None]
    ) -> None:
        """Begin other work, such as captures of a simulated bench.

        Parameters
        ----------
        name : str
            For a person.
        task : callable
            Of `trainer.studio.job_tasks` or a module like it.
        done : callable
            Called with the result.
        """
        if self.work is not None:
            self.say(BUSY, "error")
            return
        self._begin(name, task, arguments, done)

    def _ready(self) -> bool:
        if self.set.captures is None or self.set.model is None:
            return False
        if self.work is not None:
            self.say(BUSY, "error")
            return False
        if self.set.misread:
            self.say(f"Correct the captures first: {self.set.misread}", "error")
            return False
        return True

    def _begin(
        self, name: str, task: Callable[..., Any], arguments: tuple[Any, ...], done: Callable[[Any], None]
    ) -> None:
        self.notice = ("", "")
        self.tell("notice")
        self._jobs.begin(name, task, arguments, done)

    # What work brings back

    def _news(self, kind: str, value: Any) -> None:
        if kind == "model":
            try:
                with self.lock:
                    self._write(value)
            except (InputError, OSError) as error:
                self.cancel()
                self.say(sentence_of(error), "error")
                return
            self._show("model", "diagnosis")
        elif kind == "picture":
            self.show_gain(value)

    def _diagnosed(self, found: Diagnosis) -> None:
        with self.lock:
            self.results.diagnosed(found)
        self.tell("diagnosis")

    def _added(self, value: tuple[Model, Diagnosis | None]) -> None:
        model, found = value
        history = self.set.model.history if self.set.model is not None else ()
        with self.lock:
            self._write(model)
            self.results.added(model, history[-1].get("excess") if history else None, found)
        self._show("model", "diagnosis")

    def _learned(self, value: tuple[Model, float, float]) -> None:
        model, before, after = value
        if after >= before:
            self.say(f"A learned field would be no gain: the excess stays at {before:.2g}. It was left out.")
            return
        with self.lock:
            self._write(model)
            self.results.verdict = (
                f"With a field learned at the panel the excess is {after:.2g}, from {before:.2g}."
            )
        self._show("model", "diagnosis")

    def _trained(self, value: tuple[Path, float, float]) -> None:
        path, before, after = value
        with self.lock:
            self.set.show(self.set.model_now)
        if self.set.network is not None:
            self.say(
                f"With the network {path} the excess is {after:.2g}, from {before:.2g}. It takes part in the pictures, "
                "and Export puts it into the bundle."
            )
        else:
            self.say(
                f"The network is no gain: excess {after:.2g} with it, {before:.2g} without it. It is left out."
            )
        self._show("model", "picture")

    def _exported(self, value: dict[str, Any]) -> None:
        parts = [*value["effects"], *(["the network"] if value["network"] else [])]
        self.say(
            f"The bundle is {value['bundle']}: {', '.join(parts) or 'no effects'}, {value['megabytes']} MB."
        )

    def _tried(self, value: tuple[list[RankedEffect], list[CandidatePreview]]) -> None:
        with self.lock:
            self.results.tried(*value)
        self.tell("diagnosis")

    # Files

    def add_effect_file(self, path: Path) -> None:
        """Watch one more file of effects."""
        with self.lock:
            self.effects.add(path)
        self._effects_changed()

    def _effects_changed(self) -> None:
        """Read the files of effects again, and try the user's own at once where nothing else is under way."""
        with self.lock:
            self.effects.read()
            self.set.pictures.effects_version = self.effects.version
            self._files.seen()
        self.tell("effects")
        if self.effects.fault or self.set.captures is None or self.work is not None or self.set.misread:
            return
        own = self.effects.absent_from(self.set.model)
        if own:
            arguments = (self.set.folder, self.set.model_now, own, self.effects.paths)
            self._begin(f"Try {', '.join(own)}", job_tasks.try_own, arguments, self._tried)

    def _changed_outside(self, changed: list[Path]) -> None:
        """Act on what other programs have written."""
        if any(p.name in TABLES for p in changed):
            self.read_again()
        elif self.set.model_path in changed and self.set.captures is not None:
            self._model_changed()
        if any(p in self.effects.paths for p in changed):
            self._effects_changed()

    def _model_changed(self) -> None:
        with self.lock:
            self.notice = ("", "")
            self._complain(self.set.notice_other_program(self.effects.known))
            self.results.forget()
            path = self.set.model_path
            if not self.notice[1] and path is not None and path.is_file():
                self.notice = (
                    "note",
                    f"{path.name} was changed by another program; this is what it says now.",
                )
        self._show("model", "diagnosis", "notice")
