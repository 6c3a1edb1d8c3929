"""effects, new-effect, capture, export, demo: what there is to find, and what to make of it."""

from __future__ import annotations

import itertools
import shlex
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_iface.errors import InputError, nearest
from runtime.solving import whole
from trainer.commands.command import (
    Command,
    Result,
    comma_list,
    command_line,
    distances,
    effects_option,
    out_option,
    use_every_core,
    worker_options,
)
from trainer.commands.screen import Screen, plain

if TYPE_CHECKING:
    from trainer.effects.definition import Effect


def run_effects(args: Namespace, screen: Screen) -> Result:
    """The catalogue, or one effect of it."""
    from trainer.effects.effect_catalogue import catalogue, find_effect

    known = catalogue(args.effects)
    chosen = [find_effect(known, args.name)] if args.name else list(known.values())
    return {"effects": [_described(e) for e in chosen]}


def _described(effect: Effect) -> Result:
    from trainer.effects.effect_catalogue import BUILT_IN

    return {
        "name": effect.name,
        "stage": effect.stage,
        "acts_on": effect.acts_on,
        "about": effect.about,
        "orders": list(effect.orders),
        "source": "built in" if effect in BUILT_IN else effect.source,
        "parameters": [
            {
                "name": p.name,
                "key": p.key,
                "unit": p.unit,
                "low": p.low,
                "high": p.high,
                "about": p.about,
                "per_channel": p.per_channel,
                "terms": [p.count(o) if callable(p.count) else p.count for o in effect.orders],
            }
            for p in effect.parameters
        ],
    }


def show_effects(result: Result, args: Namespace, screen: Screen) -> None:
    """A table of all, or everything about one."""
    if not args.name:
        screen.table(
            ("effect", "stage", "told to", "what it is"),
            [(e["name"], e["stage"], e["acts_on"], e["about"]) for e in result["effects"]],
        )
        screen.next(command_line("effects", "zero_order"), "More on one of them")
        return
    one = result["effects"][0]
    screen.say(f"{one['name']}: {one['about']}", style="bold")
    screen.say(f"Stage {one['stage']}, told to the {one['acts_on']}, {one['source']}.")
    rows = []
    for p in one["parameters"]:
        low, high = plain(p["low"]), plain(p["high"])
        terms = " or ".join(str(t) for t in dict.fromkeys(p["terms"])) if any(p["terms"]) else "1"
        rows.append(
            (p["name"], p["unit"], low, high, terms + (" a channel" if p["per_channel"] else ""), p["about"])
        )
    screen.table(("parameter", "unit", "lowest", "highest", "numbers", "what it is"), rows)
    screen.next(command_line("add", one["name"], "captures/", "--out", f"with_{one['name']}.toml", args=args))


def run_new_effect(args: Namespace, screen: Screen) -> Result:
    """A file with an effect to edit, and its test."""
    from trainer.effects.effect_catalogue import catalogue
    from trainer.effects.new_effect import write_new_effect

    paths = write_new_effect(args.name, args.stage, args.out, catalogue(args.effects))
    return {"effect": str(paths[0]), "test": str(paths[1]), "stage": args.stage}


def show_new_effect(result: Result, args: Namespace, screen: Screen) -> None:
    """The files, and how to use them."""
    screen.say(
        f"{result['effect']} holds an effect that works as it is; edit it. {result['test']} tests it.",
        style="bold",
    )
    screen.next(f"pytest {result['test']}", "Test it")
    screen.next(
        command_line("diagnose", "captures/", "--effects", result["effect"]), "Look for it in captures"
    )


def run_capture(args: Namespace, screen: Screen) -> Result:
    """Patterns shown on a bench and captured."""
    from trainer.captures.acquire import acquire_from

    with screen.progress("capturing") as told:
        taken = acquire_from(
            args.bench, args.out, args.patterns, args.planes, args.channels, args.seed, told, args.known
        )
    return taken.as_json()


def show_capture(result: Result, args: Namespace, screen: Screen) -> None:
    """What was taken."""
    exposures = ", ".join(f"{name} {ms:g} ms" for name, ms in result["exposure_ms"].items())
    screen.say(
        f"{result['captures']} captures in {result['folder']}; exposure {exposures}; "
        f"{100 * result['saturated_share']:.2g} % of the pixels saturated.",
        style="bold",
    )
    screen.next(command_line("check", args.out))


def run_export(args: Namespace, screen: Screen) -> Result:
    """A model as a bundle for the headset."""
    if args.out.exists() and not args.out.is_dir():
        raise InputError(f"--out {args.out} is a file: give the name of a folder")
    from trainer.captures.capture_set import read_captures
    from trainer.effects.effect_catalogue import catalogue
    from trainer.model.export import export_bundle
    from trainer.model.model_file import read_model

    captures = read_captures(args.captures) if args.captures else None
    model = read_model(args.model, catalogue(args.effects), captures.bench if captures else None)
    use_every_core()
    return dict(export_bundle(model, captures, args.out, network=args.network))


def show_export(result: Result, args: Namespace, screen: Screen) -> None:
    """What is in the bundle."""
    screen.say(f"The bundle is {args.out}.", style="bold")
    _facts(result, screen)
    screen.next(
        shlex.join(["hololoop-runtime", "solve", str(args.out), "picture.png", "--out", "phase.png"]),
        "On the headset",
    )


def run_demo(args: Namespace, screen: Screen) -> Result:
    """The whole way on a virtual bench."""
    from trainer.cycle.demo_run import run_demo as demo

    folder = args.out or first_free(Path("hololoop-demo"))
    with screen.progress("demo") as told:
        return dict(demo(folder, quick=args.quick, workers=args.workers, progress=told))


def first_free(folder: Path) -> Path:
    """The folder, or the first of FOLDER-2, FOLDER-3 ... that is not there yet."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{k}") for k in itertools.count(2)))
    return next(name for name in names if not name.exists())


def show_demo(result: Result, args: Namespace, screen: Screen) -> None:
    """What came out."""
    screen.say(str(result["sentence"]), style="bold")
    _facts({k: v for k, v in result.items() if k != "sentence"}, screen)


def _facts(result: Result, screen: Screen) -> None:
    rows = [(k.replace("_", " "), v) for k, v in result.items() if isinstance(v, str | int | float)]
    screen.table(("", ""), rows)


def _effects_options(parser: ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", nargs="?", help="one effect: show its parameters")
    effects_option(parser)


def _new_effect_options(parser: ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="lower-case letters, digits and underscores")
    parser.add_argument(
        "--stage", metavar="S", required=True, type=_stage, help="drive, panel, pupil or sensor"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path(), help="where the two files go (default: here)"
    )
    effects_option(parser)


def _stage(text: str) -> str:
    from argparse import ArgumentTypeError

    stages = ("drive", "panel", "pupil", "sensor")
    if text not in stages:
        raise ArgumentTypeError(f"'{text}' is not a stage; {nearest(text, stages)}")
    return text


def _capture_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--bench",
        metavar="BENCH",
        required=True,
        help="virtual:NAME, such as virtual:demo, the TOML file of a virtual bench, or a headset's configuration "
        "(hololoop-runtime serve --help)",
    )
    parser.add_argument(
        "--known",
        metavar="BENCH.toml",
        type=Path,
        help="with a headset's configuration: the bench.toml that says what is known of its bench",
    )
    out_option(parser, "CAPTURES", "folder of the new capture set")
    parser.add_argument(
        "--patterns",
        metavar="N",
        type=whole(1, 10000),
        default=None,
        help="patterns for each channel and plane (default: 12 for one channel, 7 for several)",
    )
    parser.add_argument(
        "--planes",
        metavar="MM,MM",
        type=distances,
        default=None,
        help="distances from the panel, mm (default: the bench's own)",
    )
    parser.add_argument(
        "--channels", metavar="NAME,NAME", type=comma_list, default=None, help="(default: all)"
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=whole(0, 2**31 - 1),
        default=0,
        help="fixes the patterns, and a virtual bench's noise (default 0)",
    )


def _export_options(parser: ArgumentParser) -> None:
    parser.add_argument("--model", metavar="M.toml", type=Path, required=True, help="the model")
    out_option(parser, "BUNDLE", "folder of the new bundle")
    parser.add_argument(
        "--captures",
        metavar="CAPTURES",
        type=Path,
        help="the capture set that the model explains: its hash and the held-out errors go into the bundle",
    )
    parser.add_argument(
        "--network",
        metavar="FILE",
        type=Path,
        help="a trained approximator, RUN/network.safetensors, to go in as ONNX",
    )
    effects_option(parser)


def _demo_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="where the demo's files go (default: hololoop-demo, or if that is taken hololoop-demo-2 and so on)",
    )
    parser.add_argument("--quick", action="store_true", help="a smaller panel and fewer captures")
    worker_options(parser, cluster=False)


def commands() -> list[Command]:
    """The commands of this file."""
    return [
        Command(
            "effects",
            "List the effects that can be found, or show one.",
            "effects zero_order",
            "Look for them in captures: diagnose captures/",
            _effects_options,
            run_effects,
            show_effects,
        ),
        Command(
            "new-effect",
            "Write a file with a working effect to edit, and its test.",
            "new-effect drive_ripple --stage drive",
            "Test it with pytest, then look for it: diagnose captures/ --effects drive_ripple.py",
            _new_effect_options,
            run_new_effect,
            show_new_effect,
        ),
        Command(
            "capture",
            "Show patterns on a bench and capture them.",
            "capture --bench virtual:demo --out captures/",
            "See that the set is sound: check captures/",
            _capture_options,
            run_capture,
            show_capture,
        ),
        Command(
            "export",
            "Make a bundle for the headset of a model.",
            "export --model model.toml --out bundle/",
            "On the headset: hololoop-runtime solve bundle/ picture.png --out phase.png",
            _export_options,
            run_export,
            show_export,
        ),
        Command(
            "demo",
            "Go the whole way on a virtual bench: capture, explain, export, show.",
            "demo --quick",
            "Do the same with your own captures: check captures/",
            _demo_options,
            run_demo,
            show_demo,
        ),
    ]
