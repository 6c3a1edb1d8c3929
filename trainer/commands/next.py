"""`hololoop-trainer next`: the captures that say most of what is in doubt."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from firmware_iface.errors import DeviceError
from runtime.program.command import Command, Result
from runtime.program.interrupt import Interrupted
from runtime.program.options import distances, seed_option, whole
from runtime.program.outputs import Output
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import (
    captures_argument,
    inputs_of,
    model_options,
    note_what_is_used,
    refuse_misread,
)
from trainer.commands.outputs import CAPTURES, out_option
from trainer.commands.thresholds import threshold_options, thresholds_of
from trainer.commands.verdict_page import say_verdict
from trainer.commands.workers import worker_options, workers_of

if TYPE_CHECKING:
    from pathlib import Path

    from trainer.captures.capture_set import CaptureSet
    from trainer.diagnosis.capture_until_settled import NextRound
    from trainer.effects.effect_catalogue import Catalogue
    from trainer.fitting.pool import Pool
    from trainer.model.model import Model

PATTERNS = ("patterns.csv", "phase")
MORE = """With --bench, PATTERNS becomes a copy of the set with the further captures in it, a capture set for every
command; the set itself is not changed. What is new is taken two captures at a time and diagnosed again, until the
verdict is settled: something is missing or nothing is, no other effect does as well, and the errors of the
numbers change no picture by more than an effect must remove to be worth adding. Of a model that lacks nothing,
each effect is taken out and looked for again, so that others that do as well in its place are found.

The expected gain is in nats: half the logarithm of how much the information grows, on the model's numbers and on
the choice between an effect and its rival; what the captures before it say is taken into account."""


def options(parser: ArgumentParser) -> None:
    """The options of `next`."""
    captures_argument(parser)
    model_options(parser)
    parser.add_argument(
        "--bench",
        metavar="BENCH",
        help="show and capture them on this bench: virtual:NAME, the TOML file of a virtual bench, or a headset's "
        "configuration; without it, only the patterns are written",
    )
    parser.add_argument(
        "--count",
        metavar="N",
        type=whole(1, 200),
        required=True,
        help="how many captures (with --bench: at most)",
    )
    out_option(
        parser, "PATTERNS", "folder for the patterns, or with --bench for the set with further captures"
    )
    parser.add_argument(
        "--planes",
        metavar="MM,MM",
        type=distances,
        default=None,
        help="distances from the panel to choose from, mm (default: those of the set, those that the bench names, and "
        "0.6 and 1.6 times the first)",
    )
    seed_option(parser, "fixes the patterns, and a virtual bench's noise")
    worker_options(parser)
    threshold_options(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """The captures that say most of what is in doubt.

    Raises
    ------
    Interrupted, DeviceError
        After Ctrl-C or where a device fails, with a sentence on the captures that were taken before and are kept.
    """
    thresholds_of(args)
    captures, known, model = inputs_of(args)
    from runtime.bundle.whole_files import whole_folder
    from trainer.fitting.pool import open_pool

    with open_pool(workers_of(args), args.cluster) as pool:
        note_what_is_used(captures, screen)
        refuse_misread(args.captures, screen)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        with whole_folder(args.out, replace=args.overwrite) as folder:
            work = _write if args.bench is None else _capture
            result, stopped = {}, None
            try:
                result = work(args, folder, captures, model, known, pool, screen)
            except (KeyboardInterrupt, DeviceError) as error:
                taken = _taken(folder, captures)
                if not taken:
                    raise
                stopped = error
    if stopped is not None:
        these = (
            "1 further capture was taken and is"
            if taken == 1
            else f"{taken} further captures were taken and are"
        )
        kept = f"{these} kept in {args.out}"
        if isinstance(stopped, DeviceError):
            raise DeviceError(f"{stopped} {kept}") from stopped
        raise Interrupted(kept) from stopped
    return {**result, "out": str(args.out)}


def _taken(folder: Path, captures: CaptureSet) -> int:
    """How many captures a copy of a set has beyond the set's own."""
    from trainer.captures.capture_set import read_captures

    return len(read_captures(folder)) - len(captures) if (folder / "captures.csv").is_file() else 0


def _write(
    args: Namespace,
    folder: Path,
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    screen: Screen,
) -> Result:
    """Choose captures and write their patterns."""
    from trainer.captures.further_captures import new_ids, write_patterns
    from trainer.diagnosis.capture_until_settled import choose_next

    with screen.progress("choosing captures") as progress:
        last = choose_next(
            captures,
            model,
            known,
            pool,
            args.count,
            args.planes or (),
            args.seed,
            thresholds_of(args),
            progress,
        )
    chosen = last.found.chosen
    rows = [
        one.as_json(name, f"phase/{name}.png")
        for name, one in zip(new_ids(captures, len(chosen)), chosen, strict=True)
    ]
    write_patterns(folder, zip(rows, (one.gray for one in chosen), strict=True))
    return _result(last, rows)


def _capture(
    args: Namespace,
    folder: Path,
    captures: CaptureSet,
    model: Model,
    known: Catalogue,
    pool: Pool,
    screen: Screen,
) -> Result:
    """Choose captures and take them until the verdict is settled."""
    from trainer.captures.further_captures import copy_captures
    from trainer.captures.open_bench import check_devices, open_bench
    from trainer.diagnosis.capture_until_settled import capture_until_settled, near_planes

    # Another seed than that of the captures that are there: their noise does not come twice.
    with (
        open_bench(args.bench, args.seed + len(captures), captures.bench) as opened,
        screen.progress("capturing") as progress,
    ):
        check_devices(opened.headset, captures.bench)
        last = capture_until_settled(
            opened.headset,
            copy_captures(captures, folder),
            model,
            known,
            pool,
            args.count,
            args.planes or (*near_planes(captures), *opened.planes_mm),
            args.seed,
            thresholds_of(args),
            progress,
        )
        simulated = opened.headset.simulated
    return {**_result(last, list(last.taken)), "simulated": simulated}


def _result(last: NextRound, rows: list[Result]) -> Result:
    diagnosis = last.doubts.diagnosis
    return {
        "captures": rows,
        "verdict": diagnosis.verdict,
        "stage": diagnosis.stage,
        "settled": last.settled,
        "explained_by": list(last.doubts.model.names),
        "in_doubt": [{"effect": r.of or None, "rival": r.name} for r in last.doubts.rivals],
        "parameter_excess": last.found.parameter_excess,
        "heldout": diagnosis.held_out.as_json(),
        "held_out": diagnosis.is_held_out,
        "sentence": diagnosis.sentence,
    }


def outputs(args: Namespace) -> list[Output]:
    """The patterns, or the set with further captures."""
    return [Output(args.out, contents=PATTERNS if args.bench is None else CAPTURES, makes_folders=True)]


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """What is in doubt, and the captures that say most of it."""
    say_verdict(result, result["sentence"], screen)
    doubts = [
        f"{d['effect']} or {d['rival']}" if d["effect"] else f"whether {d['rival']} is there"
        for d in result["in_doubt"]
    ]
    if result["settled"]:
        screen.say("The verdict is settled: no further capture is needed.", style="bold green")
    elif doubts:
        screen.say(f"In doubt: {'; '.join(doubts)}.", style="yellow")
    screen.table(
        ("capture", "channel", "plane_mm", "pattern", "exposure_ms", "expected gain", "why"),
        [
            (
                r["capture"],
                r["channel"],
                r["plane_mm"],
                r["kind"],
                r["exposure_ms"],
                r["expected_gain"],
                r["why"],
            )
            for r in result["captures"]
        ],
    )
    if args.bench is None:
        screen.say(f"\nThe patterns are in {args.out}, with their table {args.out / 'patterns.csv'}.")
        bench = command_line("next", args.captures, "--bench", "BENCH", "--count", str(args.count), args=args)
        line = f"{bench} --out {args.out}-taken"
        screen.next(line, "Show them, capture them and add the rows to captures.csv; or let a bench do so")
    else:
        screen.say(
            f"\n{len(result['captures'])} further captures are in {args.out}, with those that were there."
        )
        line = command_line("explain", args.out, "--out", "better.toml", args=args, model=args.model)
        screen.next(line, "Explain the set with them")


COMMAND = Command(
    name="next",
    about="Choose the captures that say most of what is in doubt, and take them where there is a bench.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("next captures/ --model model.toml --bench virtual:demo --count 8 --out more/",),
    more=MORE,
    after="Explain the set with the further captures: explain more/ --model model.toml --out better.toml",
)
