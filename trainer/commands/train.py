"""`hololoop-trainer train`: a network for what the model does not explain."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted
from runtime.program.options import number, seed_option, whole
from runtime.program.outputs import Output, emptied
from runtime.program.progress import part_of
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.device_option import device_option
from trainer.commands.inputs import captures_argument, inputs_of, model_options
from trainer.commands.network_options import judge_options, size_options
from trainer.commands.number_text import LIKENESS
from trainer.commands.outputs import RUN, UNFINISHED_RUN, out_option
from trainer.commands.workers import use_every_core

if TYPE_CHECKING:
    from trainer.training.recipe import Recipe


def options(parser: ArgumentParser) -> None:
    """The options of `train`."""
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "RUN", "folder of the run; the same command again goes on where it stopped")
    parser.add_argument(
        "--ideal",
        action="store_true",
        help="the network sees the ideal model's prediction, as Chakravarthula et al. 2020's does",
    )
    parser.add_argument(
        "--network",
        metavar="NAME",
        default="compact",
        help="compact (the headset's, default), published, unet, pix2pix or pix2pixhd",
    )
    size_options(parser, "pictures to learn from (default 40000)", 40000, "channels of the first layer")
    weight = number(0, 1e6)
    parser.add_argument(
        "--l1", metavar="W", type=weight, help="weight of the l1 loss (published network: 100)"
    )
    parser.add_argument("--perceptual", metavar="W", type=weight, help="... of the perceptual loss (10)")
    parser.add_argument("--adversarial", metavar="W", type=weight, help="... of the adversarial loss (1)")
    parser.add_argument(
        "--unconditional", action="store_true", help="the discriminator does not see the network's input"
    )
    judge_options(parser)
    parser.add_argument(
        "--distill", metavar="NETWORK", type=Path, help="learn a trained network's results, not the captures"
    )
    parser.add_argument(
        "--every",
        metavar="N",
        type=whole(1, 10**8),
        default=500,
        help="steps between checkpoints (default 500)",
    )
    device_option(
        parser,
        "what computes the light path and trains: cpu, or cuda, a GPU (default: cpu, and training on a GPU where torch "
        "finds one)",
        default=None,
    )
    seed_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """A network trained on a capture set, beyond what the model explains.

    Raises
    ------
    Interrupted
        After Ctrl-C, with a sentence on what is in the folder of the run.
    """
    from contextlib import nullcontext

    from trainer.training.run_lock import only_run

    args.out.mkdir(parents=True, exist_ok=True)
    first = not int(os.environ.get("RANK", "0"))  # of several processes, the first one writes
    steps_done = 0

    def stepped(step: int) -> None:
        nonlocal steps_done
        steps_done = step

    try:
        with only_run(args.out) if first else nullcontext():
            result = _train(args, screen, first, stepped)
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(args.out, steps_done // args.every * args.every)) from None
    if not first:
        raise SystemExit(0)  # the first one reports
    return result


def outputs(args: Namespace) -> list[Output]:
    """The folder of the run; an unfinished run of the same settings is continued."""
    return [Output(args.out, contents=RUN, resumed_by=UNFINISHED_RUN, makes_folders=True)]


def _interrupted(folder: Path, saved: int) -> str:
    """What is left of a training after Ctrl-C; `saved` is the step of the last checkpoint, 0 where none is known."""
    from trainer.training.checkpoint import CHECKPOINT

    if not (folder / CHECKPOINT).is_file():
        return f"interrupted before the first checkpoint; there is no network in {folder} yet"
    where = f" at step {saved}" if saved else ""
    return f"interrupted; the checkpoint{where} is {folder / CHECKPOINT}, and the same command goes on from there"


def _train(args: Namespace, screen: Screen, first: bool, stepped: Callable[[int], None]) -> Result:
    """Train, and compare with what the camera saw; the later processes of several return nothing."""
    from dataclasses import asdict

    from trainer.device import computing_on
    from trainer.networks.approximator import read_approximator
    from trainer.training.checkpoint import refuse_other_run
    from trainer.training.image_metrics import noise_floor, prediction_metrics
    from trainer.training.pretrained_networks import left_out, read_pretrained
    from trainer.training.run_lock import RUNNING
    from trainer.training.training_run import NETWORK, refuse_without_loss, train
    from trainer.training.training_sets import training_sets

    recipe = _recipe(args)
    judges = read_pretrained(args.vgg, args.lpips)
    refuse_without_loss(recipe, judges)
    if not args.overwrite:
        refuse_other_run(args.out, {"recipe": asdict(recipe), "seed": args.seed})
    captures, _, model = inputs_of(args)
    use_every_core()
    with computing_on(args.device or "cpu"), screen.progress("predicting") as progress:
        sets = training_sets(
            captures, model, args.ideal, part_of(progress, 0, 1, "predicting what the model says")
        )
    teacher = read_approximator(args.distill)[0] if args.distill else None
    if args.overwrite and first:
        emptied(args.out, keep=RUNNING)
    with screen.progress("training") as progress:

        def say(step: int, loss: float) -> None:
            stepped(step)
            progress(step / args.steps, f"step {step} of {args.steps}, loss {loss:.3g}")

        network = train(
            sets.fitted, recipe, args.steps, args.out, sets.held_out, judges, teacher=teacher, seed=args.seed,
            every=args.every, about=sets.about, device=args.device, progress=say,
        )  # fmt: skip
    if not first:
        return {}
    return {
        "network": str(args.out / NETWORK),
        "recipe": asdict(recipe),
        "steps": args.steps,
        "left_out": left_out(recipe, judges),
        "heldout": {
            "before": prediction_metrics(sets.held_out, None, judges.lpips).as_json(),
            "after": prediction_metrics(sets.held_out, network, judges.lpips).as_json(),
            "noise_floor": noise_floor(sets.held_out, judges.lpips).as_json(),
        },
    }


def _recipe(args: Namespace) -> Recipe:
    """The recipe that the options ask for."""
    from dataclasses import replace

    from trainer.training.recipe import recipe_named

    given = {
        "filters": args.filters,
        "l1": args.l1,
        "perceptual": args.perceptual,
        "adversarial": args.adversarial,
        "conditional": False if args.unconditional else None,
    }
    return replace(recipe_named(args.network), **{k: v for k, v in given.items() if v is not None})


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained on pictures that were held out."""
    held = result["heldout"]
    screen.say(
        f"On held-out captures the prediction goes from {held['before']['psnr_db']:.2f} to "
        f"{held['after']['psnr_db']:.2f} dB; the camera's noise alone would allow "
        f"{held['noise_floor']['psnr_db']:.2f} dB.",
        style="bold",
    )
    screen.table(
        ("", *LIKENESS), [(which.replace("_", " "), *(held[which][n] for n in LIKENESS)) for which in held]
    )
    for sentence in result["left_out"]:
        screen.say(f"\nLeft out: {sentence}.", style="yellow")
    screen.say(f"\nThe network is {result['network']}; its curves: tensorboard --logdir {args.out}")
    network = ["--network", result["network"]]
    screen.next(
        command_line("compare", args.captures, *network, args=args, model=args.model), "Where it helps"
    )


COMMAND = Command(
    name="train",
    about="Train a network on what the model does not explain.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("train captures/ --model model.toml --out run/",),
    after="See where it helps: compare captures/ --model model.toml --network run/network.safetensors",
)
