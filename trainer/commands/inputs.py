"""What several commands are given: captures, a model, effects of one's own."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.program.command import Result
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line

if TYPE_CHECKING:
    from trainer.captures.capture_set import CaptureSet
    from trainer.captures.problems import Problem
    from trainer.effects.effect_catalogue import Catalogue
    from trainer.model.model import Model

ONE_PATTERN = (
    "Nothing is held out: these captures hold one pattern, so the error is of the very captures that were fitted. "
    "Capture more patterns."
)
MOST_NAMED = 6  # captures that a warning names


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


def inputs_of(args: Namespace) -> tuple[CaptureSet, Catalogue, Model]:
    """The capture set, the effects that are known, and the model to start from.

    Raises
    ------
    InputError
        Where one of the files cannot be used, or the model is of another bench.
    """
    from trainer.captures.capture_set import read_captures
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.model import Model
    from trainer.model.model_file import read_model

    captures = read_captures(args.captures)
    known = catalogue(args.effects)
    model = read_model(args.model, known, captures.bench) if args.model else Model(captures.bench)
    return captures, known, model


def judged_on(result: Result) -> str:
    """What an error is of, in words: the key `held_out` of a result says whether anything was held out."""
    return (
        "held-out captures" if result.get("held_out", True) else "the captured pattern, which was fitted too,"
    )


def note_what_is_used(captures: CaptureSet, screen: Screen) -> None:
    """Warn on stderr of captures that are used for nothing, and of camera numbers that were measured instead.

    Raises
    ------
    InputError
        Where that is so of every capture.
    """
    from trainer.captures.camera_numbers import numbers_text
    from trainer.captures.signal_present import with_signal

    _, left_out = with_signal(captures)
    for why in dict.fromkeys(left_out.values()):
        ids = [name for name, other in left_out.items() if other == why]
        more = f" and {len(ids) - MOST_NAMED} more" if len(ids) > MOST_NAMED else ""
        plural = "s" if len(ids) > 1 else ""
        screen.note(
            f"warning: left out capture{plural} {', '.join(ids[:MOST_NAMED])}{more} ({why}); "
            f"see: {command_line('check', captures.folder)}"
        )
    measured = numbers_text(captures.bench.camera, captures.noise_camera())
    if measured:
        screen.note(f"warning: {measured}")


def refuse_misread(folder: Path, screen: Screen) -> None:
    """Refuse captures that are not what bench.toml says, and warn on stderr of other errors of the set.

    Other errors may be what is to be explained.

    Raises
    ------
    InputError
        Where the captures are misread, so that every number would be wrong.
    """
    from trainer.captures.check_set import errors_unless_misread
    from trainer.model.model_stages import ideal_irradiance

    _note_errors(folder, errors_unless_misread(folder, ideal_irradiance), screen)


def note_errors(folder: Path, screen: Screen) -> None:
    """Warn on stderr of the errors of a set, also of those after which every number is wrong."""
    from trainer.captures.check_set import check_captures
    from trainer.model.model_stages import ideal_irradiance

    _note_errors(
        folder, [p for p in check_captures(folder, ideal_irradiance) if p.severity == "error"], screen
    )


def _note_errors(folder: Path, errors: Sequence[Problem], screen: Screen) -> None:
    """A warning of one line. Dark captures are those that `note_what_is_used` warns of."""
    errors = [p for p in errors if p.kind != "dark"]
    if errors:
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        screen.note(f"warning: {errors[0].message}{more}; see: {command_line('check', folder)}")
