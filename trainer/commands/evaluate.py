"""`hololoop-trainer evaluate`: every method on one virtual bench, side by side."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.options import comma_list, seed_option, whole
from runtime.program.screen import Screen
from trainer.commands.device_option import LIGHT_PATH, device_option
from trainer.commands.inputs import effects_option
from trainer.commands.network_options import judge_options, size_options
from trainer.commands.number_text import LIKENESS
from trainer.commands.workers import workers_of, workers_option


def options(parser: ArgumentParser) -> None:
    """The options of `evaluate`."""
    parser.add_argument(
        "--bench", metavar="BENCH", required=True, help="virtual:NAME, or a virtual bench's TOML file"
    )
    parser.add_argument(
        "--methods",
        metavar="NAME,NAME",
        type=comma_list,
        help="those to compare, between commas (default: all)",
    )
    parser.add_argument(
        "--model", metavar="M.toml", type=Path, help="the bench's physics (default: explain finds it)"
    )
    effects_option(parser)
    parser.add_argument(
        "--full", action="store_true", help="published widths and 40000 steps: for an accelerator"
    )
    size_options(parser, "steps of each training", None, "channels of the networks' first layers")
    parser.add_argument("--iterations", metavar="N", type=whole(0, 10**6), help="of each phase retrieval")
    judge_options(parser)
    workers_option(parser, "processes for explain (default: one a core)")
    device_option(
        parser, f"{LIGHT_PATH}, by this process alone; networks train on a GPU where torch finds one"
    )
    seed_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """Every method on one bench."""
    from dataclasses import replace

    from trainer.cycle.evaluation import METHODS, run_evaluation
    from trainer.cycle.evaluation_bench import EvaluationSizes
    from trainer.device import computing_on
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.model_file import read_model
    from trainer.training.pretrained_networks import read_pretrained

    sizes = EvaluationSizes.full() if args.full else EvaluationSizes()
    given = {"filters": args.filters, "steps": args.steps, "iterations": args.iterations}
    sizes = replace(sizes, **{name: value for name, value in given.items() if value is not None})
    model = None
    if args.model:
        model = read_model(args.model, catalogue(args.effects))
    judges = read_pretrained(args.vgg, args.lpips)
    with computing_on(args.device), screen.progress("comparing methods") as progress:
        found = run_evaluation(
            args.bench, args.methods or METHODS, sizes, judges, model, args.seed, workers_of(args), progress
        )
    return {**found, "sizes": vars(sizes)}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The tables."""
    ends = {"prediction": ("camera's noise", "noise_floor"), "display": ("oracle", "oracle"), "stack": None}
    titles = {
        "prediction": "predicting the capture",
        "display": "the displayed picture, as the camera sees it",
        "stack": "a stack of planes that no network was trained on",
    }
    for part, end in ends.items():
        rows = [(row["method"], *(row[n] for n in LIKENESS)) for row in result[part]]
        if end is not None:
            rows.append((end[0], *(result[end[1]][n] for n in LIKENESS)))
        screen.table(("method", *LIKENESS), rows, titles[part])
    sizes = result["sizes"]
    screen.say(
        f"\nMeans over two held-out photographs; networks of {sizes['filters'] or 'the published number of'} filters, "
        f"{sizes['steps']} steps each, {sizes['iterations']} iterations of phase retrieval."
    )


COMMAND = Command(
    name="evaluate",
    about="Compare every method on a virtual bench: what it predicts, and what it shows.",
    options=options,
    run=run,
    show=show,
    examples=("evaluate --bench virtual:mixed --methods physics,physics_compact,physics_network",),
    after="Use the best of them on your bench: loop --bench BENCH --rounds 2 --out loop/",
)
