"""`hololoop-trainer compare`: how far a model is from the captures, and where."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from runtime.program.command import Command, Result
from runtime.program.progress import part_of
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import (
    ONE_PATTERN,
    captures_argument,
    inputs_of,
    model_options,
    note_errors,
    note_what_is_used,
)
from trainer.commands.number_text import percent_text, small_text
from trainer.commands.outputs import report_option, report_out
from trainer.commands.workers import use_every_core

MOST_ROWS = 12
BUDGET_WORDS = {
    "named_physics": "named physics explains",
    "network": "what was learned explains beyond that",
    "noise": "the camera's noise",
    "unexplained": "unexplained",
}


def options(parser: ArgumentParser) -> None:
    """The options of `compare`."""
    captures_argument(parser)
    model_options(parser)
    parser.add_argument(
        "--network",
        metavar="FILE",
        type=Path,
        help="a network trained beyond the model: its part of the error too",
    )
    report_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """How far a model is from the captures."""
    captures, _, model = inputs_of(args)
    note_what_is_used(captures, screen)
    note_errors(args.captures, screen)
    from dataclasses import replace

    from trainer.diagnosis.comparison import compare
    from trainer.diagnosis.error_budget import error_budget
    from trainer.networks.approximator import read_approximator

    network = read_approximator(args.network)[0] if args.network else None
    use_every_core()
    with screen.progress("comparing") as progress:
        found = compare(captures, model, part_of(progress, 0, 0.6))
        if found.as_json()["heldout"]["excess"] is not None:
            budget = error_budget(captures, found.model, network, part_of(progress, 0.6, 1))
            found = replace(found, budget=budget)
    if args.report:
        from trainer.report import write_report

        write_report(args.report, f"Comparison: {captures.folder.name}", comparison=found, model=found.model)
    return found.as_json()


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The error in one sentence, then by channel and by capture."""
    held = result["heldout"]
    is_held_out = result.get("held_out", True)
    judged = "On captures that no fit saw" if is_held_out else "On the last capture"
    screen.say(
        f"{judged}, the model's error is {percent_text(held['nrmse'])} of the signal's "
        f"contrast; the camera's noise alone would be {percent_text(held['noise_nrmse'])}; "
        f"the excess is {small_text(held['excess'])}.",
        style="bold",
    )
    if not is_held_out:
        screen.say(ONE_PATTERN, style="yellow")
    if result.get("psnr_db") is not None:
        screen.say(f"Peak signal to noise: {result['psnr_db']:.1f} dB (peak: full scale; no free scale).")
    if result.get("budget"):
        _budget(result["budget"], screen)
    _numbers("channel", result.get("by_channel"), screen)
    rows = result.get("by_capture") or []
    rows = sorted(rows, key=lambda r: -(r.get("excess") or 0))
    shown = rows[:MOST_ROWS]
    title = (
        "worst captures first" if len(rows) <= MOST_ROWS else f"the worst {MOST_ROWS} of {len(rows)} captures"
    )
    keys = ("capture", "channel", "plane_mm", "nrmse", "noise_nrmse", "excess", "gain")
    screen.table(keys, [[r.get(k) for k in keys] for r in shown], title)
    if args.report:
        screen.say(f"\nThe report, with maps of where the error is, is {args.report}.")
    screen.next(command_line("diagnose", args.captures, args=args, model=args.model))


def _budget(budget: Mapping[str, float], screen: Screen) -> None:
    """The ideal model's error, and what explains each part of it."""
    total = sum(budget.values())
    rows = [
        (BUDGET_WORDS[name], value, f"{100 * value / total:.3g} %")
        for name, value in budget.items()
        if name != "network" or value  # nothing was learned: nothing to say
    ]
    screen.table(("the ideal model's error", "share of the signal's variance", "of the error"), rows)


def _numbers(label: str, table: Any, screen: Screen) -> None:
    """A table from {name: {key: number}}."""
    if not isinstance(table, Mapping) or len(table) < 2:
        return
    keys = list(dict.fromkeys(k for row in table.values() if isinstance(row, Mapping) for k in row))
    screen.table((label, *keys), [(name, *(row.get(k) for k in keys)) for name, row in table.items()])


COMMAND = Command(
    name="compare",
    about="Say how far a model is from the captures, and where.",
    options=options,
    run=run,
    show=show,
    outputs=report_out,
    examples=("compare captures/ --model model.toml --report compare.html",),
    after="Ask what is missing: diagnose captures/ --model model.toml",
)
