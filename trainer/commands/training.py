"""field, train: what no named effect explains, learned from what the camera saw."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runtime.solving import whole
from trainer.commands.command import (
    Command,
    Result,
    captures_argument,
    command_line,
    inputs_of,
    model_options,
    number,
    origin,
    out_option,
    refuse_folder,
    use_every_core,
)
from trainer.commands.screen import Screen

if TYPE_CHECKING:
    from trainer.training.recipe import Recipe


def run_field(args: Namespace, screen: Screen) -> Result:
    """A field learned at the panel, in a model."""
    refuse_folder(args.out, "--out")
    captures, _, model = inputs_of(args)
    from trainer.fitting.learned_field import learn_field
    from trainer.model.model_file import write_model

    use_every_core()
    with screen.progress("learning the field at the panel") as told:
        found = learn_field(captures, model, told)
    write_model(args.out, found.model, origin(captures))
    return {"model": str(args.out), **found.as_json()}


def show_field(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained on captures that were held out, and how far the maps go."""
    before, after = result["before"]["excess"], result["after"]["excess"]
    worse = after >= before
    gained = "which is no gain: leave it out" if worse else f"from {before:.2g}"
    screen.say(
        f"With a learned field at the panel the excess on held-out captures is {after:.2g}, {gained}.",
        style="yellow" if worse else "bold",
    )
    screen.table(
        ("map", "lowest", "highest"),
        [(name, m["lowest"], m["highest"]) for name, m in result["maps"].items()],
    )
    screen.say(f"\nThe model is {args.out}.")
    model = args.model if worse else args.out
    screen.next(command_line("train", args.captures, "--out", "run", args=args, model=model), "What is left")


def run_train(args: Namespace, screen: Screen) -> Result:
    """A network trained on a capture set, beyond what the model explains."""
    from dataclasses import asdict

    from trainer.networks.approximator import read_approximator
    from trainer.training.image_metrics import noise_floor, prediction_metrics
    from trainer.training.pretrained_networks import left_out, read_pretrained
    from trainer.training.training_run import NETWORK, train
    from trainer.training.training_sets import training_sets

    recipe = recipe_of(args)
    judges = read_pretrained(args.vgg, args.lpips)
    captures, _, model = inputs_of(args)
    use_every_core()
    args.out.mkdir(parents=True, exist_ok=True)
    with screen.progress("predicting") as told:
        sets = training_sets(
            captures, model, args.ideal, lambda done: told(done, "predicting what the model says")
        )
    teacher = read_approximator(args.distill)[0] if args.distill else None
    with screen.progress("training") as told:
        network = train(
            sets.fitted, recipe, args.steps, args.out, sets.held_out, judges, teacher=teacher, seed=args.seed,
            every=args.every, about=sets.about,
            progress=lambda step, loss: told(step / args.steps, f"step {step} of {args.steps}, loss {loss:.3g}"),
        )  # fmt: skip
    if int(os.environ.get("RANK", "0")):
        raise SystemExit(0)  # of several processes, the first one tells
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


def show_train(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained on pictures that were held out."""
    held = result["heldout"]
    screen.say(
        f"On held-out captures the prediction goes from {held['before']['psnr_db']:.2f} to "
        f"{held['after']['psnr_db']:.2f} dB; the camera's noise alone would allow "
        f"{held['noise_floor']['psnr_db']:.2f} dB.",
        style="bold",
    )
    names = ("psnr_db", "ssim", "one_minus_lpips")
    screen.table(
        ("", *names), [(which.replace("_", " "), *(held[which][n] for n in names)) for which in held]
    )
    for sentence in result["left_out"]:
        screen.say(f"\nLeft out: {sentence}.", style="yellow")
    screen.say(f"\nThe network is {result['network']}; its curves: tensorboard --logdir {args.out}")
    network = ["--network", result["network"]]
    screen.next(
        command_line("compare", args.captures, *network, args=args, model=args.model), "Where it helps"
    )


def recipe_of(args: Namespace) -> Recipe:
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


def judge_options(parser: ArgumentParser) -> None:
    """--vgg and --lpips."""
    parser.add_argument(
        "--vgg",
        metavar="FILE",
        type=Path,
        help="VGG-19's weights for the perceptual loss: .pth, .safetensors or MatConvNet's .mat (none: left out)",
    )
    parser.add_argument(
        "--lpips",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="weights of LPIPS: backbone (AlexNet or VGG-16) and heads, in one file or in two (none: no 1-LPIPS)",
    )


def seed_option(parser: ArgumentParser) -> None:
    """--seed."""
    parser.add_argument(
        "--seed",
        metavar="N",
        type=whole(0, 2**31 - 1),
        default=0,
        help="fixes every random choice (default 0)",
    )


def _field_options(parser: ArgumentParser) -> None:
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "NEW.toml", "where the model with the field goes")


def _train_options(parser: ArgumentParser) -> None:
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "RUN", "folder of the run; the same command again goes on where it stopped")
    parser.add_argument(
        "--ideal",
        action="store_true",
        help="the network sees the ideal model's prediction, as the seed's does",
    )
    parser.add_argument(
        "--network",
        metavar="NAME",
        default="compact",
        help="compact (the headset's, default), published, unet, pix2pix or pix2pixhd",
    )
    parser.add_argument("--filters", metavar="N", type=whole(2, 1024), help="channels of the first layer")
    parser.add_argument(
        "--steps",
        metavar="N",
        type=whole(0, 10**8),
        default=40000,
        help="pictures to learn from (default 40000)",
    )
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
    seed_option(parser)


def commands() -> list[Command]:
    """The commands of this file."""
    show: Any = show_train
    return [
        Command(
            "field",
            "Learn a complex map of the wave at the panel: stripes, dust, what no effect names there.",
            "field captures/ --model model.toml --out learned.toml",
            "Learn what is left: train captures/ --model learned.toml --out run/; or export --model learned.toml",
            _field_options,
            run_field,
            show_field,
        ),
        Command(
            "train",
            "Train a network on what the model does not explain.",
            "train captures/ --model model.toml --out run/",
            "See where it helps: compare captures/ --model model.toml --network run/network.safetensors",
            _train_options,
            run_train,
            show,
        ),
    ]
