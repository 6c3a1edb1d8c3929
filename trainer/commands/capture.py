"""`hololoop-trainer capture`: patterns shown on a bench and captured."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.options import comma_list, distances, seed_option, whole
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.outputs import CAPTURES, out_option


def options(parser: ArgumentParser) -> None:
    """The options of `capture`."""
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
        "--bracket",
        metavar="N",
        type=whole(2, 5),
        default=1,
        help="take each pattern at N exposures, each 4 times the one before, which count as one capture: 3 are a "
        "quarter, one and four times a single picture's, for dark surroundings beside bright spots (default: one)",
    )
    seed_option(parser, "fixes the patterns, and a virtual bench's noise")


def run(args: Namespace, screen: Screen) -> Result:
    """Patterns shown on a bench and captured."""
    from runtime.bundle.whole_files import whole_folder
    from trainer.captures.acquire import acquire_from

    def capture(folder: Path) -> Result:
        taken = acquire_from(
            args.bench,
            folder,
            args.patterns,
            args.planes,
            args.channels,
            args.seed,
            progress,
            args.known,
            args.bracket,
        )
        return taken.as_json()

    with screen.progress("capturing") as progress:
        if not args.overwrite:
            return capture(args.out)
        with whole_folder(args.out, replace=True) as new:
            return {**capture(new), "folder": str(args.out)}


def outputs(args: Namespace) -> list[Output]:
    """The capture set."""
    return [Output(args.out, contents=CAPTURES, makes_folders=True)]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What was taken."""
    factors = result["bracket"]
    exposures = ", ".join(
        f"{name} {' and '.join(f'{ms * factor:.3g}' for factor in factors)} ms"
        for name, ms in result["exposure_ms"].items()
    )
    simulated = "simulated " if result["simulated"] else ""
    screen.say(
        f"{result['captures']} {simulated}captures in {result['folder']}; exposure {exposures}; "
        f"{100 * result['saturated_share']:.2g} % of the pixels saturated.",
        style="bold",
    )
    screen.next(command_line("check", args.out))


COMMAND = Command(
    name="capture",
    about="Show patterns on a bench and capture them.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("capture --bench virtual:demo --out captures/",),
    after="See that the set is sound: check captures/",
)
