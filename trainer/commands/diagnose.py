"""`hololoop-trainer diagnose`: what is missing from a model."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from typing import TYPE_CHECKING

from runtime.program.command import Command, Result
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.device_option import ALONE, device_option
from trainer.commands.inputs import (
    captures_argument,
    inputs_of,
    model_options,
    note_what_is_used,
    refuse_misread,
)
from trainer.commands.number_text import sizes_text, small_text
from trainer.commands.outputs import report_option, report_out
from trainer.commands.thresholds import threshold_options, thresholds_of
from trainer.commands.verdict_page import (
    say_suggested,
    say_verdict,
    then_export,
    then_propose,
    then_write_or_learn,
)
from trainer.commands.workers import worker_options, workers_of

if TYPE_CHECKING:
    from trainer.diagnosis.verdict import Thresholds
    from trainer.fitting.pool import Pool

MOST_ROWS = 12


def options(parser: ArgumentParser) -> None:
    """The options of `diagnose`."""
    captures_argument(parser)
    model_options(parser)
    report_option(parser)
    worker_options(parser)
    device_option(parser, ALONE)
    threshold_options(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """What is missing from a model."""
    thresholds = thresholds_of(args)
    from trainer.fitting.pool import open_pool

    # First: a cluster that does not answer is known at once, and processes begin while this one reads.
    with open_pool(workers_of(args), args.cluster) as pool:
        from trainer.device import computing_on

        with computing_on(args.device):
            return _diagnose_on(args, screen, pool, thresholds)


def _diagnose_on(args: Namespace, screen: Screen, pool: Pool, thresholds: Thresholds) -> Result:
    captures, known, model = inputs_of(args)
    from trainer.diagnosis.diagnosis import diagnose

    note_what_is_used(captures, screen)
    refuse_misread(args.captures, screen)
    with screen.progress("diagnosing") as progress:
        found = diagnose(captures, model, known, pool, thresholds, progress)
    if args.report:
        from trainer.diagnosis.comparison import compare
        from trainer.diagnosis.diagnosis import with_previews
        from trainer.report import write_report

        write_report(
            args.report,
            f"Diagnosis: {captures.folder.name}",
            comparison=compare(captures, found.model),
            diagnosis=with_previews(captures, found),
        )
    return found.as_json()


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The verdict, the stages, the ranking, and the command that does something about it."""
    say_verdict(result, str(result.get("sentence", "")), screen)
    stages = sorted(result.get("stages") or [], key=lambda s: -s["excess_removed"])
    screen.table(
        ("stage", "excess its free-form probe removes"), [(s["stage"], s["excess_removed"]) for s in stages]
    )
    ranking = result.get("ranking") or []
    screen.table(
        ("effect", "stage", "excess removed", "95 % interval", "excess after", "size"),
        [
            (
                r["effect"],
                r["stage"],
                r["excess_removed"],
                "{:.2g} to {:.2g}".format(*r["ci95"]),
                r["excess_after"],
                sizes_text(r["parameters"], 3),
            )
            for r in ranking[:MOST_ROWS]
        ],
    )
    say_suggested(result, screen)
    _thresholds(result, screen)
    if args.report:
        screen.say(f"\nThe report, with pictures of what each stage lacks, is {args.report}.")
    if result["verdict"] == "missing" and ranking:
        name = ranking[0]["effect"]
        out = f"with_{name}.toml"
        screen.next(command_line("add", name, args.captures, "--out", out, args=args, model=args.model))
    elif result["verdict"] == "complete":
        then_export(args.model, args, screen)
    else:
        then_propose(args.model, args, screen)
        then_write_or_learn(result.get("stage"), args.model, args, screen)


def _thresholds(result: Result, screen: Screen) -> None:
    used = result.get("thresholds")
    if isinstance(used, Mapping):
        ideal = result.get("ideal_excess")
        screen.say(
            "\nThresholds: "
            + ", ".join(f"{name} {value:g}" for name, value in used.items())
            + (f"; the ideal model's excess is {small_text(ideal)}." if ideal is not None else "."),
            style="dim",
        )


COMMAND = Command(
    name="diagnose",
    about="Say what is missing from a model: which stage, which effect, how large.",
    options=options,
    run=run,
    show=show,
    outputs=report_out,
    examples=("diagnose captures/ --model model.toml --report diagnosis.html",),
    after="Put in what is missing: add zero_order captures/ --out better.toml; or let explain do it.",
)
