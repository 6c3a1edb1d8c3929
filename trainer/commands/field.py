"""`hololoop-trainer field`: a complex map of the wave at the panel, learned without a name."""

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
from trainer.commands.outputs import model_out, out_option
from trainer.commands.workers import use_every_core


def options(parser: ArgumentParser) -> None:
    """The options of `field`."""
    captures_argument(parser)
    model_options(parser)
    device_option(parser)
    out_option(parser, "NEW.toml", "where the model with the field goes")


def run(args: Namespace, screen: Screen) -> Result:
    """A field learned at the panel, in a model."""
    captures, _, model = inputs_of(args)
    note_what_is_used(captures, screen)
    from trainer.captures.capture_origin import origin
    from trainer.device import computing_on
    from trainer.fitting.learned_field import learn_field
    from trainer.model.model_file import write_model

    use_every_core()
    with computing_on(args.device), screen.progress("learning the field at the panel") as progress:
        found = learn_field(captures, model, progress)
    write_model(args.out, found.model, origin(captures))
    return {"model": str(args.out), **found.as_json()}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained on captures that were held out, and how far the maps go."""
    before, after = result["before"]["excess"], result["after"]["excess"]
    worse = after >= before
    gained = "which is no gain: leave it out" if worse else f"from {before:.2g}"
    screen.say(
        f"With a learned field at the panel the excess on {judged_on(result)} is {after:.2g}, {gained}.",
        style="yellow" if worse else "bold",
    )
    screen.table(
        ("map", "lowest", "highest"),
        [(name, m["lowest"], m["highest"]) for name, m in result["maps"].items()],
    )
    screen.say(f"\nThe model is {args.out}.")
    model = args.model if worse else args.out
    screen.next(command_line("train", args.captures, "--out", "run", args=args, model=model), "What is left")


COMMAND = Command(
    name="field",
    about="Learn a complex map of the wave at the panel: stripes, dust, what no effect names there.",
    options=options,
    run=run,
    show=show,
    outputs=model_out,
    examples=("field captures/ --model model.toml --out learned.toml",),
    after="Learn what is left: train captures/ --model learned.toml --out run/; or export --model learned.toml",
)
