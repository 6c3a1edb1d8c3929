"""Many capture sets in one run, which goes on after a failure and after an interruption."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from runtime.program.interrupt import ctrl_c_waits
from runtime.program.progress import Progress
from runtime.program.version import installed_version
from trainer.fleet.fleet_table import arrow, read_table, write_table
from trainer.fleet.outcomes import outcomes
from trainer.fleet.set_facts import set_facts
from trainer.fleet.set_result import SetResult
from trainer.fleet.set_task import SetTask, failed, finished


@dataclass(frozen=True)
class FleetRun:
    """A run over many sets, planned before any work.

    Attributes
    ----------
    table : Path
    settings : dict
        What makes two runs the same, apart from their folders.
    tasks : tuple of SetTask
        Sets to work on.
    taken_up : tuple of SetResult
        From the table that is there: finished sets that have not changed, and sets that are not named this time.
    named : tuple of str
        All folders that were named, absolute.
    """

    table: Path
    settings: dict[str, Any]
    tasks: tuple[SetTask, ...]
    taken_up: tuple[SetResult, ...]
    named: tuple[str, ...]

    @property
    def already(self) -> int:
        """How many of the named sets are finished already."""
        return len(self.named) - len(self.tasks)


def settings_of(model: Path | None, effects: Sequence[Path]) -> dict[str, Any]:
    """What makes two runs the same, apart from their folders.

    Raises
    ------
    InputError
        Where a file of effects cannot be read.
    """
    files = []
    for path in effects:
        try:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(
                f"--effects {path} cannot be read ({error.strerror}): give the path of a Python file"
            ) from None
        files.append([str(path.absolute()), digest])
    return {
        "task": "explain" if model is None else "recalibrate",
        "model": None if model is None else str(model),
        "effects": files,
        "hololoop": installed_version(),
    }


def results_there(table: Path, settings: dict[str, Any], begin_anew: bool = False) -> list[SetResult]:
    """What an earlier run with the same settings left in its table; nothing where there is none.

    Parameters
    ----------
    begin_anew : bool
        Whatever is there is passed over.

    Raises
    ------
    InputError
        Where the table is something else's, or of a run with other settings, or pyarrow is not installed.
    """
    arrow()  # before any work, and not after the first set
    if begin_anew or not table.exists():
        return []
    found, before = read_table(table)
    for key, value in settings.items():
        if before.get(key) != value:
            raise InputError(
                f"--out {table} is of a run with another {key} ({_short(before.get(key))}, now {_short(value)}): "
                "give another name, or --overwrite to begin anew"
            )
    return found


def plan(
    folders: Sequence[Path],
    table: Path,
    settings: dict[str, Any],
    there: Sequence[SetResult],
    model: Path | None = None,
    effects: Sequence[Path] = (),
) -> FleetRun:
    """What is left to do, given what is there.

    Parameters
    ----------
    model : Path or None
        A model to fit again; a file of that name inside a set's folder comes first, for that set.

    Raises
    ------
    InputError
        Where there is no such model for any set.
    """
    before = {r.facts.folder: r for r in there}
    named: dict[str, SetTask] = {}
    for folder in folders:
        own = _own_model(folder, model)
        facts = set_facts(folder, own)
        named.setdefault(facts.folder, SetTask(facts, own, tuple(p.absolute() for p in effects)))
    if model is not None and not any(task.model and task.model.is_file() for task in named.values()):
        raise InputError(
            f"--model {model} is not there, and in no set's folder either: give the path of a model"
        )
    done = {
        name
        for name, task in named.items()
        if (found := before.get(name)) and found.failed is None and found.facts.stamp == task.facts.stamp
    }
    tasks = tuple(task for name, task in named.items() if name not in done)
    again = {task.facts.folder for task in tasks}
    taken_up = tuple(r for name, r in before.items() if name not in again)
    return FleetRun(table, settings, tasks, taken_up, tuple(named))


def run_fleet(planned: FleetRun, workers: int, cluster: str | None, progress: Progress) -> list[SetResult]:
    """Work on all sets that are planned; the table is written after each.

    Parameters
    ----------
    workers : int
        Processes of this machine.
    cluster : str or None
        Address of a Dask scheduler to use instead.

    Returns
    -------
    list of SetResult
        All that are in the table, in the order in which they were named.
    """
    results = {r.facts.folder: r for r in planned.taken_up}
    # Those that are not named this time come first.
    order = [*(name for name in results if name not in planned.named), *planned.named]
    total, broken = len(planned.named), 0

    def told() -> list[SetResult]:
        return [results[name] for name in order if name in results]

    tasks = [(task,) for task in planned.tasks]
    with closing(outcomes(finished, tasks, workers, cluster)) as ending:
        for done, (k, outcome) in enumerate(ending, planned.already + 1):
            task = planned.tasks[k]
            result = failed(task, outcome) if isinstance(outcome, Exception) else outcome
            results[task.facts.folder] = result
            broken += result.failed is not None
            with ctrl_c_waits():
                write_table(planned.table, told(), planned.settings)
            also = f", {broken} failed" if broken else ""
            progress(done / total, f"{done} of {total} sets{also}; last: {Path(task.facts.folder).name}")
    return told()


def _own_model(folder: Path, model: Path | None) -> Path | None:
    if model is None:
        return None
    inside = folder.absolute() / model
    return inside if not model.is_absolute() and inside.is_file() else model.absolute()


def _short(value: Any) -> str:
    text = str(value) if value else "none"
    return text if len(text) < 80 else text[:77] + "..."
