"""Undo and redo: every state of a model file, kept in a folder next to it, and found again by what it says.

The folder of `model.toml` is `model.history`, with `0001.toml` and so on. Which of them is the present state is not
written down: it is the one that says the same as the model file. So a change from the command line is a step like any
other.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from trainer.effects.effect_catalogue import Catalogue
from trainer.model.model import Model
from trainer.model.model_file import read_model, write_model

NOT_COMPARED = ("about", "arrays", "schema")


class ModelSteps:
    """The states of one model file.

    Parameters
    ----------
    path : Path
        Of the model file, which need not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder = path.with_name(f"{path.stem}.history")

    def files(self) -> list[Path]:
        """The states, the first one first."""
        return sorted(self.folder.glob("[0-9][0-9][0-9][0-9].toml"))

    def position(self) -> int | None:
        """Place of the present state among `files`; None where the model file is not there or is none of them."""
        if not self.path.is_file():
            return None
        present = _said_by(self.path)
        files = self.files()
        return next((k for k in reversed(range(len(files))) if _said_by(files[k]) == present), None)

    def can_undo(self) -> bool:
        """Whether there is a state before the present one."""
        place = self.position()
        return place is not None and place > 0

    def can_redo(self) -> bool:
        """Whether there is a state after the present one."""
        place = self.position()
        return place is not None and place + 1 < len(self.files())

    def write(self, model: Model, before: Model, about: Mapping[str, Any]) -> None:
        """Make a model the present state; states that were undone are forgotten.

        Parameters
        ----------
        before : Model
            The state until now, which is kept where the folder does not have it yet.

        Raises
        ------
        InputError
            Where a file cannot be written; the model file is then as it was.
        """
        place = self.position()
        files = self.files()
        self._make_folder()
        if place is None:
            files.append(self._add(len(files), before, about))
            place = len(files) - 1
        for undone in files[place + 1 :]:
            _remove(undone)
        self._add(place + 1, model, about)
        try:
            write_model(self.path, model, about)
        except InputError:
            _remove(self.folder / f"{place + 2:04d}.toml")
            raise

    def notice(self, model: Model, before: Model | None, about: Mapping[str, Any]) -> None:
        """Keep a state that another program has written to the model file, as one more step."""
        if self.position() is not None:
            return
        files = self.files()
        self._make_folder()
        if not files and before is not None:
            files.append(self._add(0, before, about))
        self._add(len(files), model, about)

    def step(self, by: int, known: Catalogue, about: Mapping[str, Any]) -> Model:
        """Go to a state before or after the present one, and return it.

        Parameters
        ----------
        by : int
            -1 to undo, 1 to redo.

        Raises
        ------
        InputError
            Where there is no such state, or a file cannot be read or written.
        """
        place, files = self.position(), self.files()
        if place is None or not 0 <= place + by < len(files):
            raise InputError("there is nothing to undo" if by < 0 else "there is nothing to redo")
        model = read_model(files[place + by], known)
        write_model(self.path, model, about)
        return model

    def _add(self, place: int, model: Model, about: Mapping[str, Any]) -> Path:
        path = self.folder / f"{place + 1:04d}.toml"
        write_model(path, model, about)
        return path

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be made ({error.strerror}): make room, or choose another --model"
            ) from None


def _said_by(path: Path) -> dict[str, Any] | None:
    """What a model file says, without where it comes from; arrays by the hash of their file."""
    try:
        tables = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except (OSError, ValueError):
        return None
    digest = tables.get("arrays", {}).get("sha256") if isinstance(tables.get("arrays"), dict) else None
    return {**{k: v for k, v in tables.items() if k not in NOT_COMPARED}, "sha256": digest}


def _remove(path: Path) -> None:
    for one in (path, *path.parent.glob(f"{path.stem}*.safetensors")):
        with suppress(OSError):
            one.unlink()
