"""The demo: all steps on a virtual bench, from captures to a better picture.

A headset with three hidden effects is captured and explained. Pictures are then shown with patterns for the ideal
model, for the explained model, and by an oracle that knows the true bench, which gives the upper bound. They are shown
through the drivers of a real headset, on emulated hardware: the panel over USB (pyusb), the lasers over I2C (smbus2,
with safety controller and heartbeat), the camera over its link (depthai). In full colour the panel shows the patterns
of red, green and blue in turn, each lit by its own laser alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.virtual import VirtualHeadset, open_headset
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path
from runtime.bundle.whole_files import whole_file
from runtime.headset.open_devices import emulated
from runtime.program.progress import Progress, no_progress, part_of
from runtime.solver import Quality, quality, solve
from runtime.solver.pattern_files import write_pattern
from trainer.captures.bench_file import Bench
from trainer.captures.open_bench import nominal_bench
from trainer.cycle.demo_pictures import CameraPicture, seen_by_camera, target_of, write_picture
from trainer.effects.effect_catalogue import catalogue
from trainer.formatting import listed
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model
from trainer.report.display_section import DisplayedPicture, with_display

PICTURES = ("astronaut", "coffee")  # not among those that are captured
ITERATIONS, ORACLE_ITERATIONS = 100, 60
TRIES = 12  # to show a pattern


@dataclass(frozen=True)
class Demonstrated:
    """The bench of a demo, the patterns of each colour that are captured on it, and the pictures that are shown."""

    bench: str
    patterns: int | None = None
    pictures: tuple[str, ...] = PICTURES[:1]


USUAL = Demonstrated("virtual:demo", pictures=PICTURES)
QUICK = Demonstrated("virtual:small_demo", patterns=9)
COLOUR = Demonstrated("virtual:colour_demo", pictures=PICTURES)
QUICK_COLOUR = Demonstrated("virtual:small_colour_demo", patterns=6)
FULL_SIZE = Demonstrated("virtual:full_size", patterns=4)


def run_demo(
    folder: Path,
    what: Demonstrated = USUAL,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run all steps and leave every file in `folder`.

    Parameters
    ----------
    folder : path
        A new or empty one.
    what : Demonstrated
        One of USUAL, QUICK, COLOUR, QUICK_COLOUR and FULL_SIZE. Several colours are shown in turn.
    workers : int or None
        Processes; None: one for each core.
    progress : callable or None
        Called with the share done and what is being done.

    Returns
    -------
    dict
        Keys `sentence`, `found`, `verdict`, `steps`, `noise_nrmse`, `display`, `pictures`, `captures`, `model`,
        `bundle` and `report` of `demo --json`; in colour `channels`, too.

    Raises
    ------
    InputError
        Where the folder is not empty or cannot be made.
    DeviceError
        Where the machine is too busy for the emulated hardware, time after time.
    """
    from trainer.captures.acquire import acquire_captures
    from trainer.captures.capture_set import read_captures
    from trainer.diagnosis.comparison import compare
    from trainer.diagnosis.explanation import explain
    from trainer.fitting.pool import open_pool
    from trainer.model.model_file import write_model
    from trainer.report import write_report

    say = progress or no_progress
    _make_empty(folder)
    headset = open_headset(what.bench, seed=1)
    bench = nominal_bench(headset)
    captures_folder, model_path, report_path = (folder / n for n in ("captures", "model.toml", "report.html"))
    acquire_captures(
        headset, bench, captures_folder, patterns=what.patterns,
        progress=part_of(say, 0.0, 0.1, "capturing"),
    )  # fmt: skip
    captures = read_captures(captures_folder)

    def keep(model: Model) -> None:
        write_model(model_path, model)

    with open_pool(workers) as pool:
        found = explain(
            captures, Model(captures.bench), catalogue(), pool, save=keep,
            progress=part_of(say, 0.1, 0.6, "explaining"),
        )  # fmt: skip
    keep(found.model)

    say(0.6, "exporting")
    bundles = {"before": folder / "bundle-ideal", "after": folder / "bundle"}
    export_bundle(Model(captures.bench), captures, bundles["before"])
    export_bundle(found.model, captures, bundles["after"])
    patterns = folder / "patterns"
    solved = _patterns(headset, captures.bench, bundles, what.pictures, patterns, part_of(say, 0.62, 0.87))
    say(0.88, "showing")
    shown = on_hardware(what.bench, captures.bench, solved, patterns)

    say(0.94, "writing the report")
    display = {name: _mean([p.qualities[name] for p in shown]) for name in ("before", "after", "oracle")}
    channels = _by_channel([p.channels for p in shown])
    in_turn = f", with {listed(list(channels))} in turn," if channels else ""
    sentence = (
        f"Explained by {listed(found.model.names) or 'nothing'}: the picture shown{in_turn} goes from "
        f"{display['before']['psnr_db']:.1f} to {display['after']['psnr_db']:.1f} dB (amplitude PSNR, seen "
        "by the camera); with the true bench known it is "
        f"{display['oracle']['psnr_db']:.1f} dB."
    )
    ladder = found.as_json(model_path)
    write_report(
        report_path, "hololoop demo", comparison=compare(captures, found.model), diagnosis=found.diagnosis,
        ladder=ladder, model=found.model,
    )  # fmt: skip
    html = with_display(report_path.read_text(encoding="utf-8"), shown, sentence)
    with whole_file(report_path, "w") as stream:
        stream.write(html)
    say(1.0, "done")
    return {
        "sentence": sentence,
        "found": list(found.model.names),
        "verdict": found.diagnosis.verdict,
        "steps": ladder["steps"],
        "noise_nrmse": ladder["noise_nrmse"],
        "display": display,
        **({"channels": channels} if channels else {}),
        "pictures": [_picture_numbers(p) for p in shown],
        "captures": str(captures_folder),
        "model": str(model_path),
        "bundle": str(bundles["after"]),
        "report": str(report_path),
    }


class Solved(NamedTuple):
    """A picture's patterns, or one colour's: gray levels, and the irradiance that a target of 1 should get."""

    gray: np.ndarray
    given: np.ndarray


def _make_empty(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder} is there already and is not an empty folder: give another --out or remove it"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): give another --out") from None


def _patterns(
    headset: VirtualHeadset,
    bench: Bench,
    bundles: dict[str, Path],
    pictures: Sequence[str],
    folder: Path,
    say: Progress,
) -> list[tuple[str, np.ndarray, dict[str, Solved]]]:
    """(name, target [C, H, W], patterns of all colours by source) of every picture.

    Sources are the bundles, and the oracle on `headset`.
    """
    channels = [c.name for c in bench.channels]
    folder.mkdir()
    found = []
    for number, name in enumerate(pictures):
        target = target_of(name, channels, bench.panel.shape)
        write_picture(folder / f"{name}-target.png", target)
        solved = []
        for c, channel in enumerate(channels):
            begin, part = number + c / len(channels), 1 / len(channels)
            what = name if len(channels) == 1 else f"{name}, {channel}"
            some = part_of(say, begin / len(pictures), (begin + part) / len(pictures), what)
            solved.append(_solved(headset, bundles, channel, target[c], some))
            for which, one in solved[-1].items():
                colour = "" if len(channels) == 1 else f"-{channel}"
                write_pattern(folder / f"{name}-{which}{colour}.png", one.gray)
        together = {
            which: Solved(*map(np.stack, zip(*(colour[which] for colour in solved), strict=True)))
            for which in solved[0]
        }
        found.append((name, target, together))
    return found


def _solved(
    headset: VirtualHeadset, bundles: dict[str, Path], channel: str, target: np.ndarray, say: Progress
) -> dict[str, Solved]:
    """Pattern [H, W] by source, for one colour's target [H, W]."""
    solved = {}
    for k, (which, bundle) in enumerate(bundles.items()):
        say(0.1 * k, f"solving, {which}")
        found = solve(load_light_path(read_bundle(bundle), channel), target, ITERATIONS)
        solved[which] = Solved(found.gray, np.array(found.given[0]))
    asking = part_of(say, 0.2, 1.0, "asking the oracle")
    gray = _oracle(headset, target, channel, solved["after"].gray, asking)
    solved["oracle"] = Solved(gray, headset.true_irradiance(gray, channel).mean() / target.mean())
    return solved


def on_hardware(
    spec: str, bench: Bench, solved: Sequence[tuple[str, np.ndarray, dict[str, Solved]]], folder: Path
) -> list[DisplayedPicture]:
    """Pictures with each of their patterns, as the camera of emulated hardware measures them.

    The lasers go dark where their heartbeat is late. A machine that does other work, or a large panel's optics, can
    bring that about; the hardware is then opened again, and what was seen by then stays.

    Parameters
    ----------
    spec : str
        The simulated bench, as `emulated` takes it.
    solved : sequence of (str, array [C, H, W], dict of str to Solved)
        Name, target and patterns of every picture.
    folder : path
        Where the camera's pictures are written: NAME-PATTERN-seen.png.

    Raises
    ------
    DeviceError
        Where the same pattern fails `TRIES` times.
    """
    waiting = [(name, target, which, one) for name, target, these in solved for which, one in these.items()]
    seen: dict[str, dict[str, CameraPicture]] = {name: {} for name, *_ in solved}
    failed = 0
    while waiting:
        try:
            with emulated(spec, seed=2, fields=len(bench.channels)) as devices:
                while waiting:
                    name, target, which, one = waiting[0]
                    seen[name][which] = seen_by_camera(devices, bench, one.gray, one.given, target)
                    del waiting[0]
                    failed = 0
        except DeviceError as error:
            failed += 1
            if failed == TRIES:
                raise DeviceError(
                    f"{error} So ended {TRIES} attempts to show '{waiting[0][0]}': this machine is too busy for the "
                    f"emulated hardware. Run the demo again with less beside it; its files are in {folder.parent}"
                ) from error
    for name, pictures in seen.items():
        for which, picture in pictures.items():
            write_picture(folder / f"{name}-{which}-seen.png", picture.light)
    return [
        DisplayedPicture(
            name,
            target,
            {which: picture.light for which, picture in seen[name].items()},
            {which: picture.quality for which, picture in seen[name].items()},
            {which: picture.by_channel for which, picture in seen[name].items() if picture.by_channel},
        )
        for name, target, _ in solved
    ]


def _oracle(
    headset: VirtualHeadset,
    target: np.ndarray,
    channel: str,
    start: np.ndarray,
    progress: Progress,
) -> np.ndarray:
    """The better of a start and of the oracle's pattern from it, by the quality on the true bench."""
    wanted = target.astype(np.float64)
    better = headset.oracle_pattern(
        wanted,
        channel,
        iterations=ORACLE_ITERATIONS,
        start=start,
        progress=lambda i, loss: progress(i / ORACLE_ITERATIONS),
    )
    return max(
        (start, better), key=lambda gray: quality(headset.true_irradiance(gray, channel), target).psnr_db
    )


def _picture_numbers(p: DisplayedPicture) -> dict[str, Any]:
    """A picture's entry in the JSON."""
    channels = _by_channel([p.channels])
    numbers = {k: _numbers(q) for k, q in p.qualities.items()}
    return {"picture": p.name, **numbers, **({"channels": channels} if channels else {})}


def _by_channel(
    pictures: Sequence[Mapping[str, Mapping[str, Quality]]],
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean quality over pictures by channel and source; empty for one colour."""
    first = next(iter(pictures[0].values()), {})
    return {
        channel: {which: _mean([p[which][channel] for p in pictures]) for which in pictures[0]}
        for channel in first
    }


def _numbers(q: Quality) -> dict[str, float]:
    return {"psnr_db": round(q.psnr_db, 3), "nrmse": round(q.nrmse, 5)}


def _mean(qualities: list[Quality]) -> dict[str, float]:
    psnr = float(np.mean([q.psnr_db for q in qualities]))
    return {"psnr_db": round(psnr, 3), "nrmse": round(float(np.mean([q.nrmse for q in qualities])), 5)}
