"""`hololoop-trainer fleet`: many headsets' capture sets in one run."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import effects_option
from trainer.commands.outputs import out_option, report_option
from trainer.commands.workers import worker_options, workers_of

if TYPE_CHECKING:
    from trainer.fleet.drift import Drift
    from trainer.fleet.set_result import SetResult

PAGE_MARK = 'content="hololoop-trainer fleet"'  # in the head of the page
MOST_SHOWN = 12  # rows of a table that a person sees


def options(parser: ArgumentParser) -> None:
    """The options of `fleet`."""
    parser.add_argument(
        "folders",
        metavar="FOLDER",
        type=Path,
        nargs="+",
        help="folders of capture sets, each with its bench.toml",
    )
    parser.add_argument(
        "--model",
        metavar="M.toml",
        type=Path,
        help="recalibrate: fit this model's effects again to each set, and look for no others; a file of that name in "
        "a set's folder comes first. Without it, each set is explained from the ideal model",
    )
    effects_option(parser)
    out_option(
        parser,
        "TABLE.parquet",
        "where the table goes; it is written after every set, and the same command goes on with it",
    )
    report_option(parser)
    worker_options(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """All sets that are not finished yet.

    Raises
    ------
    Interrupted
        After Ctrl-C, with a sentence on what is finished.
    InputError
        Where no set at all could be used.
    """
    from trainer.effects.effect_catalogue import catalogue
    from trainer.fleet.drift import OVER, drift_of
    from trainer.fleet.fleet_run import plan, results_there, run_fleet, settings_of
    from trainer.fleet.fleet_words import one_name

    known = catalogue(args.effects)  # what is wrong with a file of effects is wrong for every set
    settings = settings_of(args.model, args.effects)
    there = results_there(args.out, settings, begin_anew=args.overwrite)
    planned = plan(args.folders, args.out, settings, there, args.model, args.effects)
    try:
        with screen.progress("fleet") as progress:
            results = run_fleet(planned, workers_of(args), args.cluster, progress)
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(args, settings)) from None
    _note_failures(results, screen)
    if same := one_name(results):
        screen.note(f"warning: {same}")
    if all(r.failed for r in results):
        raise InputError(f"none of {len(results)} sets could be used; the first: {results[0].failed}")
    drifts = [drift_of(results, over, known) for over in OVER]
    if args.report:
        from trainer.fleet.fleet_page import write_page_of_fleet

        write_page_of_fleet(args.report, args.out.name, results, drifts, settings["task"])
    return _summary(results, drifts, planned.already, args)


def outputs(args: Namespace) -> list[Output]:
    """The table, and the page; both are gone on with where they are of the same run."""
    goes_on = False
    if not args.overwrite and args.out.is_file():
        from trainer.fleet.fleet_run import results_there, settings_of

        results_there(args.out, settings_of(args.model, args.effects))  # says what is wrong with another one
        goes_on = True
    written = [Output(args.out, goes_on=goes_on)]
    if args.report is not None:
        written.append(Output(args.report, "--report", goes_on=goes_on and _is_page(args.report)))
    return written


def _is_page(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return PAGE_MARK.encode() in stream.read(2000)
    except OSError:
        return False


def _interrupted(args: Namespace, settings: dict[str, Any]) -> str:
    from trainer.fleet.fleet_run import results_there

    if not args.out.is_file():
        return "interrupted before any set was finished; nothing was written"
    done = sum(r.failed is None for r in results_there(args.out, settings))
    again = "; go on with the same command" + (", without --overwrite" if args.overwrite else "")
    return f"interrupted; {done} finished set{'s' * (done != 1)} are in {args.out}{again}"


def _note_failures(results: Sequence[SetResult], screen: Screen) -> None:
    bad = [r for r in results if r.failed]
    for result in bad[:MOST_SHOWN]:
        screen.note(f"warning: {result.facts.folder} failed: {result.failed}")
    if len(bad) > MOST_SHOWN:
        screen.note(f"warning: {len(bad) - MOST_SHOWN} more failed; the table says why")


def _summary(results: Sequence[SetResult], drifts: Sequence[Drift], already: int, args: Namespace) -> Result:
    good = [r for r in results if r.failed is None]
    return {
        "sets": len(results),
        "finished": len(good),
        "taken_up": already,
        "failed": [{"folder": r.facts.folder, "why": r.failed} for r in results if r.failed],
        "headsets": len({r.facts.headset for r in good}),
        "verdicts": dict(Counter(r.verdict for r in good)),
        "effects": dict(Counter(e for r in good for e in r.effects).most_common()),
        "drift": {d.over: d.as_json() for d in drifts},
        "table": str(args.out),
        "report": str(args.report) if args.report else None,
    }


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """How many sets there are, their effects, and what drifts together."""
    from trainer.formatting import listed

    failed, headsets = len(result["failed"]), result["headsets"]
    verdicts = listed(f"{count} {name}" for name, count in result["verdicts"].items())
    screen.say(
        f"{result['finished']} of {result['sets']} sets of {headsets} headset{'s' * (headsets != 1)} are finished "
        f"({verdicts})" + (f"; {failed} failed." if failed else "."),
        style="bold yellow" if failed else "bold",
    )
    if result["taken_up"]:
        screen.say(f"{result['taken_up']} of them were in {args.out} already.")
    screen.table(("effect", "sets that have it"), list(result["effects"].items()))
    for over, found in result["drift"].items():
        _say_drift(over, found, screen)
    screen.say(f"\nThe table is {args.out}." + (f" The page is {args.report}." if args.report else ""))
    if failed:
        screen.next(command_line("check", result["failed"][0]["folder"]), "Look at a set that failed")
        screen.say("The same fleet command tries it again.")


def _say_drift(over: str, found: Result, screen: Screen) -> None:
    from trainer.formatting import plain

    screen.say()
    if found["count"] < found["needed"]:
        what = "headsets" if over == "headsets" else "sets beyond the first of each headset"
        screen.say(
            f"Over {over}: too few to say what drifts together ({found['count']} {what}; {found['needed']} do)."
        )
        return
    pairs = found["pairs"]
    together = [p for p in pairs if p["together"]]
    count = f"{len(together)} of {len(pairs)} pairs of effects drift together"
    screen.say(f"Over {over}: {count if pairs else 'no two effects vary by more than their errors'}.")
    screen.table(
        (
            "one",
            "other",
            "correlation",
            "95 % interval",
            "sets" if over == "time" else "headsets",
            "together",
        ),
        [
            (
                *(plain(f"{p[k]['effect']}: {p[k]['parameter']}") for k in ("first", "second")),
                p["correlation"],
                "{:.2f} to {:.2f}".format(*p["ci95"]),
                p["count"],
                p["together"],
            )
            for p in pairs[:MOST_SHOWN]
        ],
    )


COMMAND = Command(
    name="fleet",
    about="Explain or recalibrate many headsets' capture sets in one run; say which effects drift together.",
    description="""Explain or recalibrate many headsets' capture sets in one run; say which effects drift together.

A set that fails costs only itself: its row of the table says what failed. After Ctrl-C, after a failure and with
further folders, the same command goes on: it takes up what is finished and has not changed. A headset is told by the
name in bench.toml, so give each its own; several sets of one name are one headset at several times. The time of a set
is taken_at of its first row in captures.csv (such as 2026-03-01T14:30:00Z), otherwise that of its first picture's
file.""",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("fleet sets/* --model model.toml --out fleet.parquet --report fleet.html",),
    after="Read the table: python -c \"import pandas; print(pandas.read_parquet('fleet.parquet'))\"",
)
