"""What a command is, and the options that several of them share."""

from __future__ import annotations

import math
import shlex
import signal
import threading
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.solving import whole
from trainer.commands.screen import Screen

if TYPE_CHECKING:
    from trainer.captures.capture_set import CaptureSet
    from trainer.diagnosis.verdict import Thresholds
    from trainer.effects.effect_catalogue import Catalogue
    from trainer.model.model import Model

PROGRAM = "hololoop-trainer"
Result = dict[str, Any]


@dataclass(frozen=True)
class Command:
    """One command.

    about : its purpose in one line; example : a command line that works; after : what comes next
    run : does the work and returns the object that `--json` prints
    show : shows that object to a person
    """

    name: str
    about: str
    example: str
    after: str
    options: Callable[[ArgumentParser], None]
    run: Callable[[Namespace, Screen], Result]
    show: Callable[[Result, Namespace, Screen], None]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, with a sentence on what is left of the work."""


@contextmanager
def ctrl_c_waits() -> Iterator[None]:
    """Ctrl-C within the block takes effect at its end: what is done there is done whole, and known to be done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt


def captures_argument(parser: ArgumentParser) -> None:
    """The capture set."""
    parser.add_argument(
        "captures", metavar="CAPTURES", type=Path, help="folder of a capture set, with its bench.toml"
    )


def model_options(parser: ArgumentParser) -> None:
    """--model and --effects."""
    parser.add_argument(
        "--model",
        metavar="M.toml",
        type=Path,
        help="start from this model; without it, from the bench's ideal one",
    )
    effects_option(parser)


def effects_option(parser: ArgumentParser) -> None:
    """--effects."""
    parser.add_argument(
        "--effects",
        metavar="FILE.py",
        type=Path,
        action="append",
        default=[],
        help="a Python file that defines effects of your own; may be given several times",
    )


def out_option(parser: ArgumentParser, metavar: str, what: str, required: bool = True) -> None:
    """--out."""
    parser.add_argument("--out", metavar=metavar, type=Path, required=required, help=what)


def report_option(parser: ArgumentParser) -> None:
    """--report."""
    parser.add_argument(
        "--report", metavar="FILE.html", type=Path, help="write a report with pictures, one HTML file"
    )


def worker_options(parser: ArgumentParser, cluster: bool = True) -> None:
    """--workers and --cluster."""
    parser.add_argument(
        "--workers",
        metavar="N",
        type=whole(1, 4096),
        default=None,
        help="processes that fit candidates at the same time (default: one a core; 1: this process alone)",
    )
    if cluster:
        parser.add_argument(
            "--cluster", metavar="ADDRESS", help="fit on a Dask cluster instead, such as tcp://10.0.0.5:8786"
        )


def threshold_options(parser: ArgumentParser) -> None:
    """When an effect is worth adding, and when a model is complete."""
    group = parser.add_argument_group(
        "what counts",
        "Shares are of the ideal model's excess: the mean squared error above the camera's noise, over "
        "the variance of the measured signal.",
    )
    share = number(0, 1)
    group.add_argument(
        "--level",
        metavar="P",
        type=number(1e-9, 0.5),
        default=None,
        help="chance that any effect is found where there is none (default 0.05)",
    )
    group.add_argument(
        "--share",
        metavar="S",
        type=share,
        default=None,
        help="an effect must remove more than this share (default 0.02) ...",
    )
    group.add_argument(
        "--min-excess",
        metavar="E",
        type=share,
        default=None,
        help="... and more than this excess (default 0.0001) to be worth adding",
    )
    group.add_argument(
        "--complete-share",
        metavar="S",
        type=share,
        default=None,
        help="a model is complete below this share (default 0.02) ...",
    )
    group.add_argument(
        "--complete-excess",
        metavar="E",
        type=share,
        default=None,
        help="... or below this excess (default 0.0003), whichever is larger",
    )


def thresholds_of(args: Namespace) -> Thresholds:
    """The thresholds that the options ask for."""
    from trainer.diagnosis.verdict import Thresholds

    named = {
        "level": args.level,
        "share": args.share,
        "excess": args.min_excess,
        "complete_share": args.complete_share,
        "complete_excess": args.complete_excess,
    }
    return Thresholds(**{name: value for name, value in named.items() if value is not None})


def inputs_of(args: Namespace) -> tuple[CaptureSet, Catalogue, Model]:
    """The capture set, the effects that are known, and the model to start from. Raises InputError."""
    from trainer.captures.capture_set import read_captures
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.model import Model
    from trainer.model.model_file import read_model

    captures = read_captures(args.captures)
    known = catalogue(args.effects)
    model = read_model(args.model, known, captures.bench) if args.model else Model(captures.bench)
    return captures, known, model


def use_every_core() -> None:
    """Let torch use all of this process's processors: for work that is done in this process."""
    import torch

    from trainer.fitting.pool import cores

    torch.set_num_threads(cores())


def workers_of(args: Namespace) -> int:
    """How many processes to use; with one, this process takes every core."""
    from trainer.fitting.pool import cores

    workers = int(args.workers or cores())
    if workers == 1:
        use_every_core()
    return workers


def release() -> str:
    """The version of hololoop that runs."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hololoop")
    except PackageNotFoundError:  # run from its sources
        return "(not installed)"


def origin(captures: CaptureSet) -> dict[str, Any]:
    """Where a model comes from, for its file."""
    return {
        "written_by": f"hololoop {release()}",
        "captures": captures.folder.name,
        "captures_sha256": captures.content_hash(),
    }


def command_line(*words: str | Path, args: Namespace | None = None, model: Path | None = None) -> str:
    """A command to type next, with the same effect files and the model that is to be used."""
    line = [PROGRAM, *map(str, words)]
    if model is not None:
        line += ["--model", str(model)]
    for path in getattr(args, "effects", []) or []:
        line += ["--effects", str(path)]
    return shlex.join(line)


def refuse_folder(path: Path | None, option: str) -> None:
    """Says early that an output cannot be written, before the work is done. Raises InputError."""
    from firmware_iface.errors import InputError

    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{option} {path} is a folder: give the name of a file")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.absolute().parent}; make it first")


def number(low: float, high: float) -> Callable[[str], float]:
    """An option's number within a range."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return read


def comma_list(text: str) -> list[str]:
    """Words between commas."""
    words = [word.strip() for word in text.split(",")]
    if not all(words):
        raise ArgumentTypeError(f"{text!r} is not a list of words with commas between them")
    return words


def distances(text: str) -> list[float]:
    """Millimetres between commas."""
    return [number(-2000, 2000)(word) for word in comma_list(text)]
