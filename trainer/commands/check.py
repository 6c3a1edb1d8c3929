"""`hololoop-trainer check`: everything that is wrong with a capture set."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.program.command import Command, Result
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import captures_argument
from trainer.commands.workers import use_every_core

MOST_SHOWN = 100  # problems in the table, the errors first


def run(args: Namespace, screen: Screen) -> Result:
    """Everything that is wrong with a capture set."""
    from trainer.captures.brackets import one_capture_each
    from trainer.captures.capture_set import read_bench, scan_rows
    from trainer.captures.check_set import check_captures
    from trainer.model.model_stages import ideal_irradiance

    folder: Path = args.captures
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv")
    use_every_core()
    with screen.progress("checking the captures") as progress:
        problems = check_captures(folder, ideal_irradiance, progress)
    try:
        rows, _ = scan_rows(folder, read_bench(folder / "bench.toml"))
    except InputError:
        rows = []
    return {"captures": len(one_capture_each(rows)), "problems": [dict(vars(p)) for p in problems]}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """Problems, errors first."""
    problems = sorted(result["problems"], key=lambda p: p["severity"] != "error")
    errors = sum(p["severity"] == "error" for p in problems)
    count = result["captures"]
    if not problems:
        screen.say(f"{count} captures, and nothing is wrong with them.", style="green")
    else:
        screen.say(
            f"{count} captures, {_plural(errors, 'error')} and {_plural(len(problems) - errors, 'warning')}.",
            style="red" if errors else "yellow",
        )
        screen.table(
            ("", "kind", "capture", "what to change"),
            [(p["severity"], p["kind"], p["capture"], p["message"]) for p in problems[:MOST_SHOWN]],
        )
        if len(problems) > MOST_SHOWN:
            screen.say(f"... and {len(problems) - MOST_SHOWN} more: --json lists all.")
    if errors:
        screen.next(command_line("check", args.captures), "Correct the errors, and check again")
    else:
        screen.next(command_line("compare", args.captures))


def _plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"


COMMAND = Command(
    name="check",
    about="Look for everything that is wrong with a capture set.",
    options=captures_argument,
    run=run,
    show=show,
    problems=lambda result: any(p["severity"] == "error" for p in result.get("problems", ())),
    examples=("check captures/",),
    after="Correct what it names, then see how far the ideal model is off: compare captures/",
)
