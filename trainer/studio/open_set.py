"""What is open: one set of captures, the model file that explains it, and the predictions of its captures.

The model file is the state of the page; what is here besides is read or computed from it and from the captures.
"""

from __future__ import annotations

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
from trainer.effects.effect_catalogue import Catalogue
from trainer.model.model import Model
from trainer.model.model_file import read_model
from trainer.studio.jobs import sentence_of
from trainer.studio.learned_network import LearnedNetwork, network_of
from trainer.studio.model_steps import ModelSteps
from trainer.studio.picture_queue import PictureQueue

TABLES = ("bench.toml", "captures.csv")


class OpenSet:
    """One set of captures, and the model that explains it; nothing at first.

    Parameters
    ----------
    lock : RLock
        Of the project.
    pictures : PictureQueue
        Predicts the captures.

    Attributes
    ----------
    folder : Path or None
        Of the captures; None where nothing is open.
    captures : CaptureSet or None
        None where the folder cannot be read: `fault` says why.
    held_out : tuple of Capture
    problems : list of Problem or None
        What `check` finds; None until it has looked.
    steps : ModelSteps or None
        The model file and its earlier states.
    model, other : Model or None, (str, Model) or None
        The one that is shown, and a second one with its name, for comparison.
    network : LearnedNetwork or None
        Takes part in the predictions of `model`.
    """

    def __init__(self, lock: Any, pictures: PictureQueue) -> None:
        self._lock, self.pictures = lock, pictures
        self.folder: Path | None = None
        self.captures: CaptureSet | None = None
        self.held_out: tuple[Capture, ...] = ()
        self.problems: list[Problem] | None = None
        self.fault = ""
        self.steps: ModelSteps | None = None
        self.model: Model | None = None
        self.other: tuple[str, Model] | None = None
        self.network: LearnedNetwork | None = None

    # Captures

    def open(self, folder: Path, model_path: Path, known: Catalogue) -> str:
        """Open a capture set; returns a sentence where its model file cannot be read, and "" otherwise."""
        with self._lock:
            self.close()
            self.folder, self.steps = folder, ModelSteps(model_path)
            return self.read(known)

    def close(self) -> None:
        """Forget everything."""
        with self._lock:
            self.pictures.forget(None, None, ())
            self.folder = self.captures = self.steps = self.problems = self.model = self.other = None
            self.network = None
            self.held_out, self.fault = (), ""

    def read(self, known: Catalogue) -> str:
        """Read captures and model; keep what is wrong with the captures as `fault`, return what is with the model."""
        assert self.folder is not None
        with self._lock:
            self.captures, self.held_out, self.fault, self.problems = None, (), "", None
            try:
                captures = read_captures(self.folder)
                self.held_out = split(captures).held_out
                self.captures = captures
            except (InputError, OSError) as error:
                self.fault = sentence_of(error)
            self.pictures.forget(self.folder, self.captures, self.held_out)
            return self.read_model(known) if self.captures is not None else ""

    @property
    def misread(self) -> str:
        """Why nothing can be explained by these captures: they are not what bench.toml says; "" where they are."""
        wrong = [p for p in self.problems or () if p.severity == "error" and p.kind in MISREAD]
        return wrong[0].message if wrong else ""

    @property
    def errors(self) -> SetErrors | None:
        """Where the model fails on the held-out captures; None until all of them are predicted."""
        return self.pictures.errors

    def files(self) -> list[Path]:
        """What other programs may change: the model file and the tables of the captures."""
        paths = [] if self.steps is None else [self.steps.path]
        return paths if self.folder is None else [*paths, *(self.folder / name for name in TABLES)]

    # The model

    @property
    def model_path(self) -> Path | None:
        """Of the model file."""
        return None if self.steps is None else self.steps.path

    @property
    def model_now(self) -> Model:
        """The model with the gains that were fitted since it was read."""
        assert self.model is not None
        return self.pictures.model or self.model

    def read_model(self, known: Catalogue) -> str:
        """Show the model of the file, or the bench's ideal one where there is none; returns what is wrong with it."""
        assert self.captures is not None and self.steps is not None
        fault, model = "", Model(self.captures.bench)
        if self.steps.path.is_file():
            try:
                model = read_model(self.steps.path, known, self.captures.bench)
            except InputError as error:
                fault = str(error)
        self.show(model)
        return fault

    def show(self, model: Model) -> None:
        """Make a model the one that is shown."""
        self.model, self.network = model, None
        if self.steps is not None and self.captures is not None:
            self.network = network_of(self.steps.path, model, self.captures.folder.name)
        self.pictures.show(model, None if self.network is None else self.network.path)

    def write(self, model: Model) -> None:
        """Make a model the state: write its file, and show it.

        Raises
        ------
        InputError
            Where it cannot be written.
        """
        assert self.captures is not None and self.steps is not None
        self.steps.write(model, self.model_now, origin(self.captures))
        self.show(model)

    def notice_other_program(self, known: Catalogue) -> str:
        """Read a model file that another program has written, and keep it as a step; returns what is wrong with it."""
        assert self.captures is not None and self.steps is not None
        before = self.model_now if self.model is not None else None
        fault = self.read_model(known)
        if not fault and self.model is not None and self.steps.path.is_file():
            with suppress(InputError):
                self.steps.notice(self.model, before, origin(self.captures))
        return fault

    def can_undo(self) -> bool:
        """Whether there is a state before the present one."""
        return self.steps is not None and self.captures is not None and self.steps.can_undo()

    def can_redo(self) -> bool:
        """Whether there is an undone state after the present one."""
        return self.steps is not None and self.captures is not None and self.steps.can_redo()

    def step(self, by: int, known: Catalogue) -> None:
        """Go back (-1) or forward (1) by a step.

        Raises
        ------
        InputError
            Where there is no such step, or its file cannot be read or written.
        """
        if self.captures is not None and self.steps is not None:
            self.show(self.steps.step(by, known, origin(self.captures)))

    def earlier_models(self) -> dict[str, Path]:
        """Kept states of the model by what a person calls them."""
        if self.steps is None:
            return {}
        return {f"step {int(p.stem) - 1}": p for p in self.steps.files()}

    def compare_with(self, name: str, model: Model | None) -> None:
        """Predict by a second model next to the first; None: no longer."""
        with self._lock:
            self.pictures.show_other(model)
            self.other = None if model is None else (name, model)
