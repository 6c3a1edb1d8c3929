"""The catalogue of effects, with those of the user's own files, which may change while the page is open."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from firmware_iface.errors import InputError
from trainer.effects.effect_catalogue import Catalogue, catalogue, forget_effect_files
from trainer.model.model import Model


class EffectFiles:
    """Files of the user's own effects, and the catalogue with them.

    Parameters
    ----------
    paths : iterable of Path

    Attributes
    ----------
    paths : tuple of Path
    known : Catalogue
        As of the last time that every file could be read.
    fault : str
        Why a file cannot be read now, with its line; "" where all can.
    version : int
        Counts how often the files were read.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        self.paths: tuple[Path, ...] = tuple(p.absolute() for p in paths)
        self.known: Catalogue = {}
        self.fault = ""
        self.version = 0
        self.read()

    def add(self, path: Path) -> None:
        """Take one more file; `read` reads it."""
        if path.absolute() not in self.paths:
            self.paths = (*self.paths, path.absolute())

    def read(self) -> None:
        """Read the files again."""
        forget_effect_files()
        self.version += 1
        try:
            self.known, self.fault = catalogue(self.paths), ""
        except InputError as error:
            self.fault = str(error)
            if not self.known:
                self.known = catalogue()

    def absent_from(self, model: Model | None) -> list[str]:
        """Names of the user's own effects that a model does not have."""
        present = model.names if model is not None else ()
        files = {str(p) for p in self.paths}
        return [e.name for e in self.known.values() if e.source in files and e.name not in present]
