"""loop, evaluate: the cycle of captures and better patterns, and every method side by side."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_iface.errors import InputError
from runtime.solving import whole
from trainer.commands.command import (
    Command,
    Result,
    comma_list,
    command_line,
    distances,
    effects_option,
    model_options,
    number,
    out_option,
    workers_of,
)
from trainer.commands.screen import Screen
from trainer.commands.training import judge_options, seed_option

if TYPE_CHECKING:
    import numpy as np

    from trainer.captures.bench_file import Bench
    from trainer.cycle.cycle_settings import CycleSettings


def run_loop(args: Namespace, screen: Screen) -> Result:
    """The hardware-in-the-loop cycle on a bench, or with recorded captures."""
    from contextlib import ExitStack

    from trainer.captures.capture_set import read_captures
    from trainer.captures.open_bench import open_bench
    from trainer.cycle.hardware_in_the_loop import run_cycle
    from trainer.cycle.phase_retrieval import beside_zero_order
    from trainer.cycle.show_on_bench import BenchDisplay, headset_beside_zero_order
    from trainer.cycle.target_pictures import LEARNED, in_depth, photographs, volumes_of
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.model import Model
    from trainer.model.model_file import read_model
    from trainer.training.pretrained_networks import left_out

    recorded = [read_captures(folder) for folder in args.recorded]
    if args.bench is None and not recorded:
        raise InputError("there is nothing to learn from: give --bench BENCH, or --recorded CAPTURES")
    if args.out.exists() and (not args.out.is_dir() or any(args.out.iterdir())):
        raise InputError(f"--out {args.out} is there already and is not empty: give another folder")
    settings = _settings(args)
    known = recorded[0].bench if recorded else None
    model = read_model(args.model, catalogue(args.effects), known) if args.model else None
    workers_of(args)
    with ExitStack() as stack:
        headset, bench = None, known
        if args.bench is not None:
            opened = stack.enter_context(open_bench(args.bench, args.seed, model.bench if model else known))
            headset, bench = opened.headset, opened.bench
        assert bench is not None  # of the bench, or of the recorded captures
        model = model or Model(bench)
        if args.method == "wirtinger_no_zero_order":
            model = beside_zero_order(model)
            headset = None if headset is None else headset_beside_zero_order(headset)
        wanted = volumes_of(args.pictures, bench) if args.pictures else photographs(LEARNED, bench)
        if args.planes:
            depths = _depths(args, bench, len(wanted))
            wanted = [in_depth(one, args.planes, depth) for one, depth in zip(wanted, depths, strict=True)]
        stage = None if headset is None else BenchDisplay(headset, bench, Model(bench))
        told = stack.enter_context(screen.progress("the cycle"))
        cycle = run_cycle(model, wanted, settings, args.out, stage, recorded, progress=told)
    rounds = [{name: found.as_json() for name, found in one.items()} for one in cycle.history]
    return {
        "folder": str(args.out),
        "pictures": [one.name for one in wanted],
        "rounds": [{"round": k, "pictures": one, "mean": _mean(one)} for k, one in enumerate(rounds)],
        "good_enough": sorted(cycle.done),
        "left_out": left_out(settings.recipe, settings.pretrained),
    }


def _depths(args: Namespace, bench: Bench, count: int) -> list[np.ndarray | None]:
    """Depth of each picture, [H, W]; None where no map is given."""
    from runtime.solver.targets import encode_srgb, read_target

    if not args.depth:
        return [None] * count
    if len(args.depth) != count:
        raise InputError(
            f"--depth names {len(args.depth)} maps for {count} pictures: give one a picture, in order"
        )
    return [
        encode_srgb(read_target(path, bench.panel.shape, fit=True)) for path in args.depth
    ]  # as gray as they look


def _settings(args: Namespace) -> CycleSettings:
    from dataclasses import replace

    from trainer.cycle.cycle_settings import CycleSettings
    from trainer.training.pretrained_networks import read_pretrained
    from trainer.training.recipe import recipe_named

    recipe = recipe_named(args.network)
    if args.filters is not None:
        recipe = replace(recipe, filters=args.filters)
    judges = read_pretrained(args.vgg, args.lpips)
    return CycleSettings(
        args.rounds,
        recipe,
        args.steps,
        args.iterations,
        args.method,
        args.good,
        args.online,
        args.seed,
        judges,
    )


def _mean(found: dict[str, Result]) -> Result:
    names = ("psnr_db", "ssim", "one_minus_lpips")
    columns = {name: [one[name] for one in found.values()] for name in names}
    return {name: None if None in column else sum(column) / len(column) for name, column in columns.items()}


def show_loop(result: Result, args: Namespace, screen: Screen) -> None:
    """What the camera saw, round by round."""
    rounds = result["rounds"]
    if rounds:
        first, last = rounds[0]["mean"], rounds[-1]["mean"]
        screen.say(
            f"What the camera sees goes from {first['psnr_db']:.2f} to {last['psnr_db']:.2f} dB (amplitude PSNR, mean "
            f"of {len(result['pictures'])} pictures).",
            style="bold",
        )
        names = ("psnr_db", "ssim", "one_minus_lpips")
        screen.table(("round", *names), [(one["round"], *(one["mean"][n] for n in names)) for one in rounds])
    else:
        screen.say("Learned from recorded captures; nothing was shown.", style="bold")
    for sentence in result["left_out"]:
        screen.say(f"\nLeft out: {sentence}.", style="yellow")
    screen.say(f"\nPatterns, captures and networks of each round are in {result['folder']}.")
    network = args.out / f"round-{max(0, args.rounds - 1)}" / "network.safetensors"
    if args.model and network.is_file():
        words = ("export", "--network", network, "--out", "bundle")
        screen.next(command_line(*words, args=args, model=args.model), "Give it to the headset")


def run_evaluate(args: Namespace, screen: Screen) -> Result:
    """Every method on one bench."""
    from dataclasses import replace

    from trainer.cycle.evaluation import METHODS, run_evaluation
    from trainer.cycle.evaluation_bench import EvaluationSizes
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
    with screen.progress("comparing methods") as told:
        found = run_evaluation(
            args.bench, args.methods or METHODS, sizes, judges, model, args.seed, workers_of(args), told
        )
    return {**found, "sizes": vars(sizes)}


def show_evaluate(result: Result, args: Namespace, screen: Screen) -> None:
    """The tables."""
    names = ("psnr_db", "ssim", "one_minus_lpips")
    ends = {"prediction": ("camera's noise", "noise_floor"), "display": ("oracle", "oracle"), "stack": None}
    titles = {
        "prediction": "predicting the capture",
        "display": "the displayed picture, as the camera sees it",
        "stack": "a stack of planes that no network was trained on",
    }
    for part, end in ends.items():
        rows = [(row["method"], *(row[n] for n in names)) for row in result[part]]
        if end is not None:
            rows.append((end[0], *(result[end[1]][n] for n in names)))
        screen.table(("method", *names), rows, titles[part])
    sizes = result["sizes"]
    screen.say(
        f"\nMeans over two held-out photographs; networks of {sizes['filters'] or 'the published number of'} filters, "
        f"{sizes['steps']} steps each, {sizes['iterations']} iterations of phase retrieval."
    )


def _network_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--filters", metavar="N", type=whole(2, 1024), help="channels of the networks' first layers"
    )
    parser.add_argument("--steps", metavar="N", type=whole(0, 10**8), help="steps of each training")


def _loop_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--bench", metavar="BENCH", help="virtual:NAME, a virtual bench's TOML file, or a headset's"
    )
    parser.add_argument(
        "--rounds", metavar="K", type=whole(0, 1000), default=1, help="how often to learn (default 1)"
    )
    out_option(parser, "DIR", "folder for patterns, captures and networks, one folder a round")
    model_options(parser)
    parser.add_argument(
        "--pictures",
        metavar="FILE",
        type=Path,
        nargs="+",
        help="pictures to show (default: some photographs)",
    )
    parser.add_argument(
        "--planes",
        metavar="MM,MM",
        type=distances,
        help="show pictures in depth, on these planes (default: one plane)",
    )
    parser.add_argument(
        "--depth",
        metavar="FILE",
        type=Path,
        nargs="+",
        help="a depth map a picture: black is on the first plane, white on the last (default: from left to right)",
    )
    parser.add_argument(
        "--recorded",
        metavar="CAPTURES",
        type=Path,
        action="append",
        default=[],
        help="learn from this capture set in place of a round's captures; may be given several times",
    )
    parser.add_argument("--online", action="store_true", help="refine a network of its own for each picture")
    parser.add_argument(
        "--method",
        metavar="NAME",
        default="wirtinger",
        help="phase retrieval before anything is learned: double_phase, gerchberg_saxton, wirtinger (default), "
        "wirtinger_no_zero_order (ramp and iris) or hardware_in_the_loop",
    )
    parser.add_argument("--iterations", metavar="N", type=whole(0, 10**6), default=100, help="(default 100)")
    parser.add_argument("--network", metavar="NAME", default="compact", help="as for train (default compact)")
    _network_options(parser)
    parser.set_defaults(steps=2000)
    judge_options(parser)
    parser.add_argument(
        "--good",
        metavar="S",
        type=number(0, 2),
        help="leave a picture alone above this 1 - LPIPS (default 0.5), or without its weights SSIM (default 0.95)",
    )
    seed_option(parser)
    parser.set_defaults(workers=1)


def _evaluate_options(parser: ArgumentParser) -> None:
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
    _network_options(parser)
    parser.add_argument("--iterations", metavar="N", type=whole(0, 10**6), help="of each phase retrieval")
    judge_options(parser)
    parser.add_argument(
        "--workers", metavar="N", type=whole(1, 4096), help="processes for explain (default: one a core)"
    )
    seed_option(parser)


def commands() -> list[Command]:
    """The commands of this file."""
    return [
        Command(
            "loop",
            "Show, capture, learn, and show better, again and again.",
            "loop --bench virtual:demo --rounds 2 --model model.toml --out loop/",
            "Give it to the headset: export --model model.toml --network loop/round-1/network.safetensors --out b/",
            _loop_options,
            run_loop,
            show_loop,
        ),
        Command(
            "evaluate",
            "Compare every method on a virtual bench: what it predicts, and what it shows.",
            "evaluate --bench virtual:mixed --methods physics,physics_compact,physics_network",
            "Use the best of them on your bench: loop --bench BENCH --rounds 2 --out loop/",
            _evaluate_options,
            run_evaluate,
            show_evaluate,
        ),
    ]
