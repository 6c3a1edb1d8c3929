"""`hololoop-trainer add`: one effect more."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from runtime.program.command import Command, Result
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.device_option import device_option
from trainer.commands.inputs import (
    captures_argument,
    inputs_of,
    judged_on,
    model_options,
    note_what_is_used,
)
from trainer.commands.number_text import sizes_text, small_text
from trainer.commands.outputs import model_out, out_option
from trainer.commands.workers import use_every_core


def options(parser: ArgumentParser) -> None:
    """The options of `add`."""
    parser.add_argument(
        "effect", metavar="EFFECT", help="name of an effect; 'hololoop-trainer effects' lists them"
    )
    captures_argument(parser)
    model_options(parser)
    device_option(parser)
    out_option(parser, "NEW.toml", "where the new model goes")


def run(args: Namespace, screen: Screen) -> Result:
    """One effect more."""
    from trainer.effects.effect_catalogue import catalogue, find_effect

    effect = find_effect(catalogue(args.effects), args.effect)
    captures, _, model = inputs_of(args)
    note_what_is_used(captures, screen)
    from trainer.captures.capture_origin import origin
    from trainer.device import computing_on
    from trainer.diagnosis.addition import add
    from trainer.model.model_file import write_model

    use_every_core()
    with computing_on(args.device), screen.progress(f"adding {effect.name}") as progress:
        found = add(captures, model, effect, progress)
    write_model(args.out, found.model, origin(captures))
    return found.as_json()


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained, and the effect's size."""
    before, after = result["before"], result["after"]
    size = sizes_text(result["parameters"])
    worse = (
        after["excess"] is not None and before["excess"] is not None and after["excess"] >= before["excess"]
    )
    gained = "which is no gain: leave it out" if worse else f"from {small_text(before['excess'])}"
    screen.say(
        f"With {args.effect} ({size}), "
        f"the excess on {judged_on(result)} is {small_text(after['excess'])}, {gained}.",
        style="yellow" if worse else "bold",
    )
    screen.table(
        ("", "nrmse", "noise_nrmse", "excess"),
        [
            (when, e["nrmse"], e["noise_nrmse"], e["excess"])
            for when, e in (("before", before), ("after", after))
        ],
    )
    screen.say(f"\nThe model is {args.out}.")
    screen.next(command_line("diagnose", args.captures, args=args, model=args.model if worse else args.out))


COMMAND = Command(
    name="add",
    about="Add one effect to a model, fit it, and say what is gained on captures the fit did not see.",
    options=options,
    run=run,
    show=show,
    outputs=model_out,
    examples=("add zero_order captures/ --out better.toml",),
    after="See what is still missing: diagnose captures/ --model better.toml",
)
