"""`hololoop-trainer explain`: effect after effect until nothing more is worth adding."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted, ctrl_c_waits
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import captures_argument, inputs_of, model_options, origin, refuse_misread
from trainer.commands.number_text import small_text
from trainer.commands.outputs import out_option, refuse_folder, report_option
from trainer.commands.thresholds import threshold_options, thresholds_of
from trainer.commands.verdict_page import say_suggested, say_verdict, then_export, then_write_or_learn
from trainer.commands.workers import worker_options, workers_of

if TYPE_CHECKING:
    from trainer.model.model import Model


def options(parser: ArgumentParser) -> None:
    """The options of `explain`."""
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "NEW.toml", "where the model goes; it is written after every effect that is added")
    report_option(parser)
    worker_options(parser)
    threshold_options(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """Effect after effect until nothing more is worth adding.

    Raises
    ------
    Interrupted
        After Ctrl-C, with a sentence on the model that is left.
    """
    refuse_folder(args.out, "--out")
    refuse_folder(args.report, "--report")
    thresholds = thresholds_of(args)
    captures, known, model = inputs_of(args)
    refuse_misread(args.captures, screen)
    from trainer.diagnosis.explanation import explain
    from trainer.fitting.pool import open_pool
    from trainer.model.model_file import write_model

    source = origin(captures)
    saved: list[tuple[str, ...]] = []

    def save(better: Model) -> None:
        with ctrl_c_waits():
            write_model(args.out, better, source)
            saved.append(better.names)

    try:
        with screen.progress("explaining") as progress, open_pool(workers_of(args), args.cluster) as pool:
            found = explain(captures, model, known, pool, thresholds, save, progress)
        save(found.model)
        if args.report:
            from trainer.diagnosis.comparison import compare
            from trainer.report import write_report

            write_report(
                args.report,
                f"Explanation: {captures.folder.name}",
                comparison=compare(captures, found.model),
                diagnosis=found.diagnosis,
                ladder=found.as_json(args.out),
                model=found.model,
            )
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(saved, model.names, args.out)) from None
    return {**found.as_json(args.out), "effects": _sizes(found.model)}


def _sizes(model: Model) -> list[Result]:
    """The effects of a model, each with its size in words and its parameters."""
    from trainer.model.parameters import describe, json_values

    return [
        {
            "effect": p.effect.name,
            "stage": p.effect.stage,
            "size": describe(p, model.bench),
            "parameters": json_values(p, model.bench),
        }
        for p in model.present
    ]


def _interrupted(saved: list[tuple[str, ...]], before: tuple[str, ...], out: Path) -> str:
    """What is left of an `explain` after Ctrl-C: `saved` are the effects of each model that was written."""
    added = [name for name in saved[-1] if name not in before] if saved else []
    if added:
        return f"interrupted after adding {', '.join(added)}; the model so far is in {out}"
    if saved:
        return f"interrupted before anything was added; the model as it was is in {out}"
    return "interrupted before anything was added; nothing was written"


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The ladder of effects, the verdict, and what comes next."""
    say_verdict(result["verdict"], _explained(result), screen)
    rows = []
    first = args.model.name if args.model else "ideal model"
    for step in result["steps"]:
        what = step["added"] or (f"without {step['removed']}" if step.get("removed") else first)
        also = ", ".join(step["indistinguishable_from"]) or ""
        rows.append((what, step["nrmse"], step["excess"], also))
    screen.table(("added", "nrmse", "excess", "not told apart from"), rows)
    screen.say(f"\nThe camera's noise alone: nrmse {result['noise_nrmse']:.4g}.")
    say_suggested(result, screen)
    screen.say(f"\nThe model is {args.out}." + (f" The report is {args.report}." if args.report else ""))
    if result["verdict"] == "complete":
        then_export(args.out, args, screen)
    elif result["verdict"] == "outside_catalogue":
        then_write_or_learn(result.get("stage"), args.out, args, screen)
    else:
        screen.next(command_line("diagnose", args.captures, args=args, model=args.out))


def _explained(result: Result) -> str:
    """What was added and what it gained, then the verdict's sentence."""
    from trainer.formatting import listed

    steps = result["steps"]
    added = [s["added"] for s in steps if s["added"]]
    removed = [s["removed"] for s in steps if s.get("removed")]
    sizes = {e["effect"]: f" ({e['size']})" for e in result.get("effects") or []}
    kept = [name + sizes.get(name, "") for name in added if name not in removed]
    first, last = small_text(steps[0]["excess"]), small_text(steps[-1]["excess"])
    gain = f"{listed(kept)} took the excess from {first} to {last}. " if kept else ""
    return gain + str(result.get("sentence", ""))


COMMAND = Command(
    name="explain",
    about="Diagnose and add, again and again, until nothing more is worth adding.",
    options=options,
    run=run,
    show=show,
    examples=("explain captures/ --out model.toml --report explanation.html",),
    after="Give the model to the headset: export --model model.toml --out bundle/",
)
