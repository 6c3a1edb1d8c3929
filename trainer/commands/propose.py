"""`hololoop-trainer propose`: effect files for what the catalogue does not name."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from tempfile import TemporaryDirectory

from runtime.program.command import Command, Result
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import (
    captures_argument,
    inputs_of,
    model_options,
    note_what_is_used,
    refuse_misread,
)
from trainer.commands.outputs import PROPOSALS, out_option
from trainer.commands.thresholds import threshold_options, thresholds_of
from trainer.commands.verdict_page import say_verdict, then_export, then_write_or_learn
from trainer.commands.workers import worker_options, workers_of


def options(parser: ArgumentParser) -> None:
    """The options of `propose`."""
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "FOLDER", "folder for the effects' files, one file an effect")
    worker_options(parser)
    threshold_options(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """Effect files for what the catalogue does not name."""
    thresholds = thresholds_of(args)
    captures, known, model = inputs_of(args)
    from runtime.bundle.whole_files import whole_folder
    from trainer.diagnosis.proposals.proposing import propose
    from trainer.fitting.pool import open_pool

    # First: a cluster that does not answer is known at once, before the pictures are looked at.
    with open_pool(workers_of(args), args.cluster) as pool:
        note_what_is_used(captures, screen)
        refuse_misread(args.captures, screen)
        # Drafts lie beside the folder, where a cluster's workers see them if they see the folder.
        beside = Path(args.out).resolve().parent
        with (
            whole_folder(args.out, replace=args.overwrite) as new,
            TemporaryDirectory(prefix=".drafts-", dir=beside) as drafts,
        ):
            with screen.progress("proposing") as progress:
                found = propose(captures, model, known, pool, Path(drafts), thresholds, progress)
            for one in found.proposals:
                one.write(new)
    return found.as_json()


def outputs(args: Namespace) -> list[Output]:
    """The folder of effect files."""
    return [Output(args.out, contents=PROPOSALS)]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The proposals, and how to use those that are worth adding."""
    say_verdict(result, result["sentence"], screen)
    proposals = result["proposals"]
    screen.table(
        ("file", "worth adding", "excess removed", "95 % interval", "excess after"),
        [
            (
                p["file"],
                "yes" if p["worth_adding"] else "no",
                p["excess_removed"],
                "{:.2g} to {:.2g}".format(*p["ci95"]),
                p["excess_after"],
            )
            for p in proposals
        ],
    )
    for p in proposals:
        screen.say(f"  {p['file']}: {p['what']}.")
    accepted = [args.out / p["file"] for p in proposals if p["worth_adding"]]
    if accepted:
        words: list[str | Path] = [word for path in accepted for word in ("--effects", path)]
        line = command_line(
            "explain", args.captures, *words, "--out", "model.toml", args=args, model=args.model
        )
        screen.next(line, "Read the files, then put the effects in a model")
    elif result["verdict"] == "missing":
        screen.next(
            command_line("explain", args.captures, "--out", "model.toml", args=args, model=args.model)
        )
    elif result["verdict"] == "complete":
        then_export(args.model, args, screen)
    else:
        then_write_or_learn(None, args.model, args, screen)


COMMAND = Command(
    name="propose",
    about="Write effect files for what the catalogue does not name, as the probes show it.",
    description="""Write effect files for what the catalogue does not name, as the probes show it.

It diagnoses the model first. Where the model is complete, or an effect of the catalogue is missing, it says so and
proposes nothing. Where something is missing that the catalogue does not name, it works in rounds:

  1. it looks at the stages' fitted free-form probes for shapes: fringes with period, direction, chirp and bend; what
     each column or row has of its own, or what repeats every 2, 3 or 4; specks with places and sizes; functions of
     the distance from a centre; smooth surfaces; functions of the gray level; and products of two: a shape times
     another, times the gray level, or times a function of the captures' order or time;
  2. it writes each shape as an effect's file, fits it like any effect, and judges it on held-out captures;
  3. it accepts the best one if it is worth adding, fits the probes again on what is left, and begins again.

So accepted proposals belong together: excess_after of each is with those before it in the list. Files with
worth_adding false fitted too, but a better one was accepted before them; they are there to be read and edited.""",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("propose captures/ --model model.toml --out proposals/",),
    after="Read the files, edit them as you like, and use them: explain captures/ --effects proposals/NAME.py "
    "--out model.toml",
)
