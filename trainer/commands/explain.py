"""`hololoop-trainer explain`: effect after effect until nothing more is worth adding."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from firmware_iface.errors import InputError
from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted, ctrl_c_waits
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
from trainer.commands.number_text import small_text
from trainer.commands.outputs import model_out, out_option, report_option
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
    from trainer.effects.effect_catalogue import Catalogue
    from trainer.fitting.pool import Pool
    from trainer.model.model import Model


def options(parser: ArgumentParser) -> None:
    """The options of `explain`."""
    captures_argument(parser)
    model_options(parser)
    out_option(
        parser,
        "NEW.toml",
        "where the model goes; it is written after every effect that is added, so that after Ctrl-C the work goes on "
        "with the same command and --model NEW.toml --overwrite",
    )
    report_option(parser)
    worker_options(parser)
    device_option(parser, ALONE)
    threshold_options(parser)
    parser.add_argument(
        "--learn",
        action="store_true",
        help="learn what nothing named explains, at the stages that the probes name, and keep it in the model",
    )


def run(args: Namespace, screen: Screen) -> Result:
    """Effect after effect until nothing more is worth adding.

    Raises
    ------
    Interrupted
        After Ctrl-C, with a sentence on the model that is left.
    """
    from trainer.fitting.pool import open_pool

    thresholds = thresholds_of(args)
    added: list[list[str]] = []
    try:
        # First: a cluster that does not answer is known at once, and processes begin while this one reads.
        with open_pool(workers_of(args), args.cluster) as pool:
            from trainer.device import computing_on  # now: it loads torch, while the processes begin

            with computing_on(args.device):
                return _explain_on(args, screen, pool, thresholds, added)
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(added, args)) from None


def _explain_on(
    args: Namespace, screen: Screen, pool: Pool, thresholds: Thresholds, added: list[list[str]]
) -> Result:
    """Each model that is written appends the names of its effects that were not there at the beginning to `added`."""
    captures, known, model = inputs_of(args)
    from trainer.captures.capture_origin import origin
    from trainer.diagnosis.explanation import explain
    from trainer.model.model_file import write_model

    source = origin(captures)
    replaced = _excess_there(args, known)

    def save(better: Model, is_last: bool = False) -> None:
        # The first one is the model that is started from, and another's may be better than the first of this.
        excess = better.history[-1].get("excess") if better.history else None
        worse = replaced is not None and isinstance(excess, float) and excess >= replaced
        if not is_last and (better.names == model.names or worse):
            return
        with ctrl_c_waits():
            write_model(args.out, better, source)
            added.append([name for name in better.names if name not in model.names])

    note_what_is_used(captures, screen)
    refuse_misread(args.captures, screen)
    with screen.progress("explaining") as progress:
        found = explain(captures, model, known, pool, thresholds, save, progress, args.learn)
    save(found.model, is_last=True)
    if args.report:
        from trainer.diagnosis.comparison import compare
        from trainer.diagnosis.diagnosis import with_previews
        from trainer.report import write_report

        write_report(
            args.report,
            f"Explanation: {captures.folder.name}",
            comparison=compare(captures, found.model),
            diagnosis=with_previews(captures, found.diagnosis),
            ladder=found.as_json(args.out),
            model=found.model,
        )
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


def _excess_there(args: Namespace, known: Catalogue) -> float | None:
    """Held-out excess of the model that is replaced, where it is not the one that is started from and can be read."""
    from trainer.model.model_file import read_model

    if not args.out.is_file() or (args.model and args.out.samefile(args.model)):
        return None
    try:
        history = read_model(args.out, known).history
    except InputError:
        return None
    excess = history[-1].get("excess") if history else None
    return excess if isinstance(excess, float) else None


def _interrupted(added: list[list[str]], args: Namespace) -> str:
    """What is left of an `explain` after Ctrl-C: `added` are the new effects of each model that was written."""
    out = args.out
    if not added:
        kept = f"{out} is as it was" if out.exists() else "nothing was written"
        return f"interrupted before anything was added; {kept}"
    begin = f"interrupted after adding {', '.join(added[-1])}" if added[-1] else "interrupted"
    line = command_line("explain", args.captures, "--out", out, "--overwrite", args=args, model=out)
    return f"{begin}; the model so far is in {out}; go on with: {line}"


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The ladder of effects, the verdict, and what comes next."""
    say_verdict(result, _explained(result), screen)
    rows = []
    first = args.model.name if args.model else "ideal model"
    for step in result["steps"]:
        what = ", ".join(part for part in (step["added"], _other_change(step)) if part) or first
        also = ", ".join(step["indistinguishable_from"]) or ""
        rows.append((what, step["nrmse"], step["excess"], also))
    screen.table(("added", "nrmse", "excess", "not told apart from"), rows)
    learned = result.get("learned")
    if learned:
        at = [(step["stage"], step["nrmse"], step["excess"]) for step in learned["steps"]]
        if at:
            screen.table(("learned at", "nrmse", "excess"), at)
        screen.say(f"\n{learned['sentence']}")
    screen.say(f"\nThe camera's noise alone: nrmse {result['noise_nrmse']:.4g}.")
    say_suggested(result, screen)
    screen.say(f"\nThe model is {args.out}." + (f" The report is {args.report}." if args.report else ""))
    if result["verdict"] == "complete" or (learned and learned["at_floor"]):
        then_export(args.out, args, screen)
    elif result["verdict"] == "outside_catalogue":
        then_propose(args.out, args, screen)
        then_write_or_learn(result.get("stage"), args.out, args, screen)
    else:
        screen.next(command_line("diagnose", args.captures, args=args, model=args.out))


def _other_change(step: Result) -> str:
    """What a step did besides adding an effect, in words; "" for nothing."""
    if step.get("removed"):
        return f"without {step['removed']}"
    return f"{step.get('form', 'map')} of {step['refined']}" if step.get("refined") else ""


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
    outputs=model_out,
    examples=("explain captures/ --out model.toml --report explanation.html",),
    after="Give the model to the headset: export --model model.toml --out bundle/",
)
