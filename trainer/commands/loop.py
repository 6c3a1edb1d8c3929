"""`hololoop-trainer loop`: the cycle of captures and better patterns."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_iface.errors import InputError
from runtime.commands.inputs import say_simulated
from runtime.program.command import Command, Result
from runtime.program.options import distances, number, seed_option, whole
from runtime.program.outputs import Output, emptied
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import model_options
from trainer.commands.network_options import judge_options, size_options
from trainer.commands.number_text import LIKENESS
from trainer.commands.outputs import ROUNDS, out_option
from trainer.commands.workers import workers_of

if TYPE_CHECKING:
    import numpy as np

    from trainer.captures.bench_file import Bench
    from trainer.cycle.cycle_settings import CycleSettings


def options(parser: ArgumentParser) -> None:
    """The options of `loop`."""
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
    parser.add_argument(
        "--iterations",
        metavar="N",
        type=whole(0, 10**6),
        default=100,
        help="of each phase retrieval (default 100)",
    )
    parser.add_argument("--network", metavar="NAME", default="compact", help="as for train (default compact)")
    size_options(
        parser, "steps of each training (default 2000)", 2000, "channels of the networks' first layers"
    )
    judge_options(parser)
    parser.add_argument(
        "--good",
        metavar="S",
        type=number(0, 2),
        help="leave a picture alone above this 1 - LPIPS (default 0.5), or without its weights SSIM (default 0.95)",
    )
    seed_option(parser)
    parser.set_defaults(workers=1)


def run(args: Namespace, screen: Screen) -> Result:
    """The hardware-in-the-loop cycle on a bench, or with recorded captures."""
    from contextlib import ExitStack

    from runtime.headset.open_devices import is_simulated
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
        progress = stack.enter_context(screen.progress("the cycle"))
        emptied(args.out)
        cycle = run_cycle(model, wanted, settings, args.out, stage, recorded, progress=progress)
    rounds = [{name: found.as_json() for name, found in one.items()} for one in cycle.history]
    return {
        "folder": str(args.out),
        "pictures": [one.name for one in wanted],
        "rounds": [{"round": k, "pictures": one, "mean": _mean(one)} for k, one in enumerate(rounds)],
        "good_enough": sorted(cycle.done),
        "simulated": (args.bench is not None and is_simulated(args.bench))
        or any(one.extra.get("simulated") == "yes" for captures in recorded for one in captures.captures),
        "left_out": left_out(settings.recipe, settings.pretrained),
    }


def outputs(args: Namespace) -> list[Output]:
    """The folder of the rounds."""
    return [Output(args.out, contents=ROUNDS, makes_folders=True)]


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
    columns = {name: [one[name] for one in found.values()] for name in LIKENESS}
    return {name: None if None in column else sum(column) / len(column) for name, column in columns.items()}


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What the camera saw, round by round."""
    say_simulated(result, screen)
    rounds = result["rounds"]
    if rounds:
        first, last = rounds[0]["mean"], rounds[-1]["mean"]
        screen.say(
            f"What the camera sees goes from {first['psnr_db']:.2f} to {last['psnr_db']:.2f} dB (amplitude PSNR, mean "
            f"of {len(result['pictures'])} pictures).",
            style="bold",
        )
        screen.table(
            ("round", *LIKENESS), [(one["round"], *(one["mean"][n] for n in LIKENESS)) for one in rounds]
        )
    else:
        screen.say("Learned from recorded captures; nothing was shown.", style="bold")
    for sentence in result["left_out"]:
        screen.say(f"\nLeft out: {sentence}.", style="yellow")
    screen.say(f"\nPatterns, captures and networks of each round are in {result['folder']}.")
    network = args.out / f"round-{max(0, args.rounds - 1)}" / "network.safetensors"
    if args.model and network.is_file():
        words = ("export", "--network", network, "--out", "bundle")
        screen.next(command_line(*words, args=args, model=args.model), "Give it to the headset")


COMMAND = Command(
    name="loop",
    about="Show, capture, learn, and show better, again and again.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("loop --bench virtual:demo --rounds 2 --model model.toml --out loop/",),
    after="Give it to the headset: export --model model.toml --network loop/round-1/network.safetensors --out b/",
)
