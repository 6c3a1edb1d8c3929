"""The commands check, compare, diagnose, explain and export as functions.

Each takes a capture set or its folder, and a model or its file. They do what the commands of the same name do, and
return an object instead of printing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from runtime.program.progress import Progress
from trainer.captures.capture_origin import origin
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.check_set import check_captures, errors_unless_misread
from trainer.diagnosis.comparison import compare as compare_model
from trainer.diagnosis.diagnosis import diagnose as diagnose_model
from trainer.diagnosis.diagnosis import with_previews
from trainer.diagnosis.explanation import explain as explain_captures
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import Catalogue, catalogue
from trainer.fitting.pool import open_pool
from trainer.model import model_file
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model
from trainer.model.model_stages import ideal_irradiance
from trainer.notebook.results import CheckResult, ComparisonResult, DiagnosisResult, ExplanationResult

File = str | os.PathLike[str]


def check(captures: CaptureSet | File) -> CheckResult:
    """Look for everything that is wrong with a capture set.

    Parameters
    ----------
    captures : CaptureSet or path
        A set, or its folder. A folder that `read_captures` refuses can be checked too.

    Returns
    -------
    CheckResult
    """
    folder = captures.folder if isinstance(captures, CaptureSet) else Path(captures)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv")
    return CheckResult(folder, tuple(check_captures(folder, ideal_irradiance)))


def compare(
    captures: CaptureSet | File, model: Model | File | None = None, *, effects: Iterable[File] = ()
) -> ComparisonResult:
    """Say how far a model is from the captures that no fit saw.

    Parameters
    ----------
    captures : CaptureSet or path
    model : Model or path, optional
        The bench's ideal model where none is given.
    effects : paths
        Python files with effects of your own.

    Returns
    -------
    ComparisonResult

    Raises
    ------
    InputError
        Where a file cannot be read, or no picture can be used: all without light, or saturated.
    """
    taken, _, start = _inputs(captures, model, effects)
    return ComparisonResult(taken, compare_model(taken, start))


def diagnose(
    captures: CaptureSet | File,
    model: Model | File | None = None,
    *,
    effects: Iterable[File] = (),
    thresholds: Thresholds | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> DiagnosisResult:
    """Say what is missing from a model: which stage, which effect, how large.

    Parameters
    ----------
    captures : CaptureSet or path
    model : Model or path, optional
        The bench's ideal model where none is given.
    effects : paths
        Python files with effects of your own.
    thresholds : Thresholds, optional
        When an effect is worth adding, and when a model is complete.
    workers : int
        Processes that fit candidates at the same time. With more than one, a script must keep its own work
        under `if __name__ == "__main__":`; a notebook need not.
    progress : callable, optional
        Called with the share that is done (0 to 1) and what is going on.

    Returns
    -------
    DiagnosisResult

    Raises
    ------
    InputError
        Where a file cannot be read, or the captures are not what bench.toml says.
    """
    taken, known, start = _inputs(captures, model, effects)
    errors_unless_misread(taken.folder, ideal_irradiance)
    with open_pool(workers) as pool:
        found = diagnose_model(taken, start, known, pool, thresholds, progress)
    return DiagnosisResult(with_previews(taken, found))


def explain(
    captures: CaptureSet | File,
    model: Model | File | None = None,
    *,
    effects: Iterable[File] = (),
    thresholds: Thresholds | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> ExplanationResult:
    """Diagnose and add effects, again and again, until nothing more is worth adding.

    Parameters
    ----------
    captures : CaptureSet or path
    model : Model or path, optional
        Where to start; the bench's ideal model where none is given.
    effects : paths
        Python files with effects of your own.
    thresholds : Thresholds, optional
        When an effect is worth adding, and when a model is complete.
    workers : int
        Processes that fit candidates at the same time. With more than one, a script must keep its own work
        under `if __name__ == "__main__":`; a notebook need not.
    progress : callable, optional
        Called with the share that is done (0 to 1) and what is going on.

    Returns
    -------
    ExplanationResult

    Raises
    ------
    InputError
        Where a file cannot be read, or the captures are not what bench.toml says.
    """
    taken, known, start = _inputs(captures, model, effects)
    errors_unless_misread(taken.folder, ideal_irradiance)
    with open_pool(workers) as pool:
        found = explain_captures(taken, start, known, pool, thresholds, progress=progress)
    return ExplanationResult(taken, found)


def read_model(
    path: File, captures: CaptureSet | File | None = None, *, effects: Iterable[File] = ()
) -> Model:
    """Read a model file.

    Parameters
    ----------
    path : path
    captures : CaptureSet or path, optional
        The model must be of the same bench as these.
    effects : paths
        Python files with effects of your own that the model holds.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        Naming the key and what is allowed there, where anything in the file does not fit.
    """
    bench = None if captures is None else _captures(captures).bench
    return model_file.read_model(Path(path), catalogue(map(Path, effects)), bench)


def write_model(path: File, model: Model, captures: CaptureSet | File | None = None) -> None:
    """Write a model file, whole or not at all.

    Parameters
    ----------
    path : path
        A TOML file; one that is there is replaced.
    model : Model
    captures : CaptureSet or path, optional
        What the model was fitted to: its name and hash go into the file.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    model_file.write_model(Path(path), model, None if captures is None else origin(_captures(captures)))


def export(
    model: Model | File, captures: CaptureSet | File | None, folder: File, *, replace: bool = False
) -> dict[str, Any]:
    """Write a model as a bundle for the headset.

    Parameters
    ----------
    model : Model or path
    captures : CaptureSet or path, or None
        What the model was fitted to: its colours and planes go into the bundle. None: every colour of the bench,
        at the bench's own distance.
    folder : path
        The new bundle.
    replace : bool
        Whether a bundle that is there already may be replaced.

    Returns
    -------
    dict
        What `hololoop-trainer export --json` prints.

    Raises
    ------
    InputError
        Where the folder is not empty, or a plane cannot be computed.
    """
    taken = None if captures is None else _captures(captures)
    chosen = model if isinstance(model, Model) else read_model(model, taken)
    return dict(export_bundle(chosen, taken, Path(folder), replace_folder=replace))


def _captures(given: CaptureSet | File) -> CaptureSet:
    return given if isinstance(given, CaptureSet) else read_captures(Path(given))


def _inputs(
    captures: CaptureSet | File, model: Model | File | None, effects: Iterable[File]
) -> tuple[CaptureSet, Catalogue, Model]:
    taken, known = _captures(captures), catalogue(map(Path, effects))
    if model is None:
        return taken, known, Model(taken.bench)
    return (
        taken,
        known,
        model if isinstance(model, Model) else model_file.read_model(Path(model), known, taken.bench),
    )
