"""The state of one studio: captures, model file, effect files, work under way and its results.

Every browser watches the same project. The model file is the state; what is here besides is computed from it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from trainer.captures.capture_origin import origin
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import Capture
from trainer.captures.held_out import split
from trainer.captures.problems import MISREAD, Problem
from trainer.diagnosis.capture_errors import SetErrors
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.ranking import RankedEffect
from trainer.effects.effect_catalogue import Catalogue, catalogue, forget_effect_files
from trainer.model.model import Model
from trainer.model.model_file import read_model
from trainer.studio import gain_tasks, job_tasks
from trainer.studio.job_tasks import CandidatePreview
from trainer.studio.jobs import sentence_of
from trainer.studio.model_steps import ModelSteps
from trainer.studio.picture_queue import PictureQueue
from trainer.studio.running_work import RunningWork, Work
from trainer.studio.watched_files import WatchedFiles

TOPICS = ("set", "model", "picture", "errors", "job", "diagnosis", "notice", "effects", "other", "gain")
TABLES = ("bench.toml", "captures.csv")

Watcher = Callable[[str], None]


class Project:
    """One set of captures and one model file, and the work on them.

    Parameters
    ----------
    home : Path
        Folder in which new files are made.
    effects : iterable of Path
        Files of the user's own effects; they are watched.
    """

    def __init__(self, home: Path, effects: Iterable[Path] = ()) -> None:
        self.home = home
        self.lock = threading.RLock()
        self.effect_files: tuple[Path, ...] = tuple(p.absolute() for p in effects)
        self.effects_fault = ""
        self.known: Catalogue = {}
        self.folder: Path | None = None
        self.captures: CaptureSet | None = None
        self.held_out: tuple[Capture, ...] = ()
        self.problems: list[Problem] | None = None
        self.set_fault = ""
        self.steps: ModelSteps | None = None
        self.model: Model | None = None
        self.other: tuple[str, Model] | None = None
        self.diagnosis: Diagnosis | None = None
        self.ranking: tuple[RankedEffect, ...] = ()
        self.previews: dict[str, CandidatePreview] = {}
        self.notice: tuple[str, str] = ("", "")
        self.verdict = ""
        self.gain: Any = None
        self.network: tuple[Path, float, float] | None = None
        self._watchers: dict[int, Watcher] = {}
        self.pictures = PictureQueue(self.lock, self.tell, self._checked, self._unpredictable)
        self._jobs = RunningWork(job_tasks.__name__, self.tell, self.say, self._news)
        self._files = WatchedFiles(self.lock, self._watched, self._changed_outside)
        self._read_effects()

    # Watching

    def watch(self, watcher: Watcher) -> int:
        """Have a function called, in any thread, with the topic of each change; returns a number for `unwatch`."""
        with self.lock:
            number = max(self._watchers, default=0) + 1
            self._watchers[number] = watcher
            return number

    def unwatch(self, number: int) -> None:
        """Call a watcher no longer."""
        with self.lock:
            self._watchers.pop(number, None)

    def tell(self, *topics: str) -> None:
        """Say that something has changed."""
        with self.lock:
            watchers = list(self._watchers.values())
        for topic in topics:
            for watcher in watchers:
                with suppress(Exception):  # a browser that has just left
                    watcher(topic)

    def say(self, sentence: str, severity: str = "note") -> None:
        """Show a sentence in every browser; severity is "note" or "error"."""
        self.notice = (severity, sentence)
        self.tell("notice")

    def close(self) -> None:
        """End all processes."""
        self._files.close()
        self.pictures.close()
        self._jobs.close()

    @property
    def work(self) -> Work | None:
        """What is under way; None where nothing is."""
        return self._jobs.work

    # Captures

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
            self._forget_results()
            self.folder, self.captures, self.held_out = folder, None, ()
            self.problems, self.set_fault = None, ""
            path = model_path or self.home / f"{folder.name}-model.toml"
            self.steps = ModelSteps(path.absolute())
            self._read_set()
            self._files.seen()
        self.tell("set", "model", "notice")
        self.pictures.work()

    def close_set(self) -> None:
        """Back to the start page."""
        with self.lock:
            if self.work is not None:
                raise InputError("work is under way on these captures: wait for it, or cancel it")
            self._forget_results()
            self.folder = self.captures = self.model = self.steps = None
            self.problems, self.set_fault = None, ""
        self.tell("set", "model", "notice")

    def _forget_results(self) -> None:
        self.pictures.forget(None, None, ())
        self.model, self.other, self.diagnosis, self.ranking, self.previews = None, None, None, (), {}
        self.verdict, self.notice, self.gain, self.network = "", ("", ""), None, None

    def _checked(self, problems: list[Problem]) -> None:
        self.problems = problems
        self.tell("set")

    def _unpredictable(self, sentence: str) -> None:
        self.say(sentence, "error")

    def _read_set(self) -> None:
        assert self.folder is not None and self.steps is not None
        self.captures, self.held_out, self.set_fault = None, (), ""
        try:
            captures = read_captures(self.folder)
            self.held_out = split(captures).held_out
            self.captures = captures
        except (InputError, OSError) as error:
            self.set_fault = sentence_of(error)
        self.pictures.forget(self.folder, self.captures, self.held_out)
        if self.captures is not None:
            self._read_model()

    @property
    def misread(self) -> str:
        """Why nothing can be explained by these captures: they are not what bench.toml says; "" where they are."""
        wrong = [p for p in self.problems or () if p.severity == "error" and p.kind in MISREAD]
        return wrong[0].message if wrong else ""

    # The model

    @property
    def model_path(self) -> Path | None:
        """Of the model file."""
        return None if self.steps is None else self.steps.path

    def _read_model(self) -> None:
        """The model of the file, or the bench's ideal one where there is no file."""
        assert self.captures is not None and self.steps is not None
        model = Model(self.captures.bench)
        if self.steps.path.is_file():
            try:
                model = read_model(self.steps.path, self.known, self.captures.bench)
            except InputError as error:
                self.notice = ("error", str(error))
        self._take(model)

    def _take(self, model: Model) -> None:
        """Make a model the one that is shown."""
        self.model = model
        self.diagnosis, self.ranking, self.previews = None, (), {}
        self.verdict = ""
        self.pictures.show(model)

    def _write(self, model: Model) -> None:
        """Make a model the state: write its file, and show it.

        Raises
        ------
        InputError
            Where it cannot be written.
        """
        assert self.captures is not None and self.steps is not None and self.model is not None
        self.steps.write(model, self._model_now(), origin(self.captures))
        self._take(model)
        self._files.seen()

    def can_undo(self) -> bool:
        """Whether there is a state before the present one."""
        return (
            self.work is None
            and self.steps is not None
            and self.captures is not None
            and self.steps.can_undo()
        )

    def can_redo(self) -> bool:
        """Whether there is an undone state after the present one."""
        return (
            self.work is None
            and self.steps is not None
            and self.captures is not None
            and self.steps.can_redo()
        )

    def undo(self) -> None:
        """Go back by a step."""
        self._step(-1)

    def redo(self) -> None:
        """Go forward by a step."""
        self._step(1)

    def _step(self, by: int) -> None:
        with self.lock:
            if self.captures is None or self.steps is None:
                return
            try:
                model = self.steps.step(by, self.known, origin(self.captures))
            except (InputError, OSError) as error:
                self.say(sentence_of(error), "error")
                return
            self._take(model)
            self._files.seen()
            self.notice = ("", "")
        self.tell("model", "diagnosis", "notice")
        self.pictures.work()

    def compare_with(self, name: str, model: Model | None) -> None:
        """Show a second model next to the first; None: no longer."""
        with self.lock:
            self.pictures.show_other(model)
            self.other = None if model is None else (name, model)
        self.tell("other", "picture", "errors")
        self.pictures.work()

    def earlier_models(self) -> dict[str, Path]:
        """Kept states of the model by what a person calls them."""
        if self.steps is None:
            return {}
        return {f"step {int(p.stem) - 1}": p for p in self.steps.files()}

    @property
    def errors(self) -> SetErrors | None:
        """Where the model fails on the held-out captures; None until all of them are predicted."""
        return self.pictures.errors

    # Work

    def diagnose(self) -> None:
        """Look for what is missing."""
        if self._ready():
            arguments = (self.folder, self._model_now(), self.effect_files)
            self._begin("Diagnose", job_tasks.find_missing, arguments, self._diagnosed)

    def add(self, name: str) -> None:
        """Put an effect in, and fit everything again."""
        if self._ready():
            arguments = (self.folder, self._model_now(), name, self.effect_files)
            self._begin(f"Add {name}", job_tasks.add_effect, arguments, self._added)

    def explain(self) -> None:
        """Diagnose and add, again and again."""
        if self._ready():
            arguments = (self.folder, self._model_now(), self.effect_files)
            self._begin("Explain", job_tasks.explain_all, arguments, self._explained)

    def learn_field(self) -> None:
        """Learn the wave at the panel, without a name."""
        if self._ready():
            arguments = (self.folder, self._model_now())
            self._begin("Learn the field", job_tasks.learn_panel_field, arguments, self._learned)

    def train_network(self, steps: int) -> None:
        """Train a network on what the model leaves."""
        if self._ready() and self.steps is not None:
            folder = self.steps.path.with_name(f"{self.steps.path.stem}-network")
            arguments = (self.folder, self._model_now(), steps, folder)
            self._begin("Train a network", job_tasks.train_network, arguments, self._trained)

    def export(self, folder: Path) -> None:
        """Write the bundle for the headset."""
        if self._ready():
            arguments = (self.folder, self._model_now(), folder)
            self._begin("Export", gain_tasks.export_model, arguments, self._exported)

    def show_gain(self, found: Any) -> None:
        """Show a displayed picture in every browser."""
        self.gain = found
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
            self.say("Other work is under way: wait for it, or cancel it.", "error")
            return
        self._begin(name, task, arguments, done)

    def _ready(self) -> bool:
        if self.captures is None or self.model is None:
            return False
        if self.work is not None:
            self.say("Other work is under way: wait for it, or cancel it.", "error")
            return False
        if self.misread:
            self.say(f"Correct the captures first: {self.misread}", "error")
            return False
        return True

    def _model_now(self) -> Model:
        assert self.model is not None
        return self.pictures.model or self.model

    def _begin(
        self, name: str, task: Callable[..., Any], arguments: tuple[Any, ...], done: Callable[[Any], None]
    ) -> None:
        self.notice = ("", "")
        self.tell("notice")
        self._jobs.begin(name, task, arguments, done)

    def _news(self, kind: str, value: Any) -> None:
        if kind == "model":
            try:
                with self.lock:
                    self._write(value)
            except (InputError, OSError) as error:
                self.cancel()
                self.say(sentence_of(error), "error")
                return
            self.tell("model", "diagnosis")
            self.pictures.work()
        elif kind == "picture":
            self.gain = value
            self.tell("gain")

    def _diagnosed(self, value: tuple[Diagnosis, list[CandidatePreview]]) -> None:
        with self.lock:
            self._show(value[0])
            self.previews = {p.effect: p for p in value[1]}
        self.tell("diagnosis")

    def _show(self, found: Diagnosis) -> None:
        self.diagnosis, self.ranking, self.verdict = found, found.ranking, found.sentence

    def _added(self, value: tuple[Model, Diagnosis | None]) -> None:
        model, found = value
        before = self.model.history[-1].get("excess") if self.model and self.model.history else None
        with self.lock:
            self._write(model)
            if found is not None:
                self._show(found)
            else:
                after = model.history[-1]
                gained = "" if before is None else f" from {before:.2g}"
                self.verdict = (
                    f"{after['added']} is in the model: the excess is {after['excess']:.2g}{gained}. "
                    "Diagnose says what is left."
                )
        self.tell("model", "diagnosis")
        self.pictures.work()

    def _explained(self, found: Diagnosis) -> None:
        with self.lock:
            self._show(found)
        self.tell("diagnosis")

    def _learned(self, value: tuple[Model, float, float]) -> None:
        model, before, after = value
        if after >= before:
            self.say(f"A learned field would be no gain: the excess stays at {before:.2g}. It was left out.")
            return
        with self.lock:
            self._write(model)
            self.verdict = f"With a field learned at the panel the excess is {after:.2g}, from {before:.2g}."
        self.tell("model", "diagnosis")
        self.pictures.work()

    def _trained(self, value: tuple[Path, float, float]) -> None:
        path, before, after = value
        self.network = (path, before, after) if after > before else None
        if after > before:
            self.say(
                f"The network {path} takes the prediction from {before:.1f} to {after:.1f} dB on held-out captures."
            )
        else:
            self.say(
                f"The network is no gain: {before:.1f} dB without it, {after:.1f} dB with it. Leave it out."
            )
        self.tell("model")

    def _exported(self, value: dict[str, Any]) -> None:
        self.say(
            f"The bundle is {value['bundle']}: {', '.join(value['effects']) or 'no effects'}, {value['megabytes']} MB."
        )

    # Files

    def add_effect_file(self, path: Path) -> None:
        """Watch one more file of effects."""
        with self.lock:
            if path.absolute() not in self.effect_files:
                self.effect_files = (*self.effect_files, path.absolute())
        self._effects_changed()

    def _read_effects(self) -> None:
        forget_effect_files()
        self.pictures.effects_version += 1
        try:
            self.known, self.effects_fault = catalogue(self.effect_files), ""
        except InputError as error:
            self.effects_fault = str(error)
            if not self.known:
                self.known = catalogue()

    def _effects_changed(self) -> None:
        """Read the files of effects again, and try the user's own at once where nothing else is under way."""
        with self.lock:
            self._read_effects()
            self._files.seen()
        self.tell("effects")
        if self.effects_fault or self.captures is None or self.work is not None or self.misread:
            return
        present = self.model.names if self.model else ()
        own = [e.name for e in self.known.values() if e.source in {str(p) for p in self.effect_files}]
        own = [name for name in own if name not in present]
        if own:
            arguments = (self.folder, self._model_now(), own, self.effect_files)
            self._begin(f"Try {', '.join(own)}", job_tasks.try_own, arguments, self._tried)

    def _tried(self, value: tuple[list[RankedEffect], list[CandidatePreview]]) -> None:
        ranking, previews = value
        own = {r.effect.name for r in ranking}
        with self.lock:
            rest = [r for r in self.ranking if r.effect.name not in own]
            self.ranking = tuple(sorted([*ranking, *rest], key=lambda r: r.held_out.excess))
            self.previews.update({p.effect: p for p in previews})
        self.tell("diagnosis")

    def _watched(self) -> list[Path]:
        paths = list(self.effect_files)
        if self.steps is not None:
            paths.append(self.steps.path)
        if self.folder is not None:
            paths += [self.folder / name for name in TABLES]
        return paths

    def _changed_outside(self, changed: list[Path]) -> None:
        """Act on what other programs have written."""
        if any(p.name in TABLES for p in changed):
            self.read_again()
        elif self.steps is not None and self.steps.path in changed and self.captures is not None:
            self._model_changed()
        if any(p in self.effect_files for p in changed):
            self._effects_changed()

    def read_again(self) -> None:
        """Read the capture set again, after its tables have changed."""
        with self.lock:
            self.problems = None
            self._read_set()
            self._files.seen()
        self.tell("set", "model", "diagnosis", "picture")
        self.pictures.work()

    def _model_changed(self) -> None:
        assert self.steps is not None and self.captures is not None
        with self.lock:
            before = self._model_now() if self.model is not None else None
            self.notice = ("", "")
            self._read_model()
            if self.steps.path.is_file() and self.model is not None and self.notice[0] != "error":
                with suppress(InputError):
                    self.steps.notice(self.model, before, origin(self.captures))
                self.notice = (
                    "note",
                    f"{self.steps.path.name} was changed by another program; this is what it says now.",
                )
        self.tell("model", "diagnosis", "notice")
        self.pictures.work()
