"""`hololoop-runtime solve`: pictures to patterns in files."""

from __future__ import annotations

import math
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError

ABOUT = """Compute the panel pattern for each picture, through the light path of a bundle.

TARGET is a PNG (taken as sRGB), an EXR or an NPY file (taken as linear light) of the panel's size, or of any
size with --fit. The pattern is an 8-bit gray PNG, to be sent to the panel as it is. With several channels in
the bundle, each gets a pattern of its own: NAME-red.png, NAME-green.png, NAME-blue.png; a gray picture is the
same in all of them. With --channel, only that one is computed, under the name given.

examples:
  hololoop-runtime solve bundle/ picture.png --out pattern.png
  hololoop-runtime solve bundle/ a.png b.png --out patterns/ --iterations 40
  hololoop-runtime solve bundle/ photo.png --fit --channel green --plane 30 --out pattern.png
  hololoop-runtime solve bundle/ frame.png --deadline-ms 50 --out pattern.png --json

in Python:
  from runtime.solver import Solver
  solver = Solver(load_light_path(read_bundle("bundle/"), "green"))   # once
  panel.show(solver.solve(target, deadline_ms=50).gray)               # each picture; or solver.frame(...)

amplitude PSNR is of what the calibrated model says that the pattern shows, zero-padded and on a grid twice as fine
as the panel's, whatever the solver computed on; more iterations or time never make it worse, and 20 iterations are
usually within a few dB of what can be reached."""

SOLVERS = ("bfgs", "double_phase", "gerchberg_saxton", "adam")
PATIENT = 25  # iterations
PENALTIES = ("amplitude", "irradiance", "l1")


@dataclass(frozen=True)
class Job:
    """One pattern to compute: which picture, which colour of it, and the file that it goes to."""

    target: Path
    channel: str
    out: Path


def arguments(parser: ArgumentParser) -> None:
    """The options of `solve`."""
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="folder that hololoop-trainer exported")
    parser.add_argument("targets", metavar="TARGET", type=Path, nargs="+", help="pictures to show")
    parser.add_argument(
        "--out",
        metavar="PHASE.png|DIR",
        type=Path,
        required=True,
        help="a .png for one picture, or a folder (made if it is not there)",
    )
    parser.add_argument(
        "--iterations",
        metavar="N",
        type=whole(0, 100000),
        help="steps a pattern (default 20, or as many as the deadline allows; 0: double phase alone)",
    )
    parser.add_argument(
        "--deadline-ms",
        metavar="T",
        type=_milliseconds,
        help="from picture to pattern; the best pattern so far is given (this machine is measured first)",
    )
    parser.add_argument(
        "--solver",
        type=_solver_name,
        choices=SOLVERS,
        default="bfgs",
        help="how (default: bfgs, memoryless BFGS)",
    )
    parser.add_argument(
        "--penalty", choices=PENALTIES, default="amplitude", help="of what error (default: squared amplitude)"
    )
    parser.add_argument(
        "--grid",
        choices=("panel", "fine"),
        help="irradiance computed once a pixel, or twice an axis: four times the work, for irises that pass more "
        "than three quarters of the panel's band (default: by that, and panel with a deadline)",
    )
    parser.add_argument("--channel", metavar="C", help="compute this channel only (default: all)")
    parser.add_argument(
        "--plane",
        metavar="MM",
        type=_millimetres,
        help="image plane, mm from the panel (default: the bench's)",
    )
    parser.add_argument(
        "--beside-zero-order",
        action="store_true",
        help="for a bench whose iris is moved off the axis, so that undiffracted light does not reach the picture",
    )
    parser.add_argument("--fit", action="store_true", help="crop and resize pictures of another size")


def whole(low: int, high: int) -> Callable[[str], int]:
    """An option's whole number within a range."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")
        return value

    return read


def _solver_name(text: str) -> str:
    """A solver's name; "default" is an older spelling of "bfgs"."""
    return "bfgs" if text == "default" else text


def _milliseconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise ArgumentTypeError(f"{text!r} is not a time in ms")
    return value


def _millimetres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ArgumentTypeError(f"{text!r} is not a distance in mm")
    return value


def run(args: Namespace) -> dict[str, Any]:
    """Compute and write the patterns, picture by picture; returns what `--json` prints."""
    from runtime.bundle.bundle_folder import INITIALISER, read_bundle
    from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, plane_of
    from runtime.networks.onnx_approximator import approximator_of
    from runtime.solver import Solver, beside_zero_order

    bundle = read_bundle(args.bundle)
    every = bundle_channels(bundle)
    channels = every if args.channel is None else [args.channel]
    paths = {c: load_light_path(bundle, c, args.plane) for c in channels}
    if args.beside_zero_order:
        paths = {c: beside_zero_order(path) for c, path in paths.items()}
    planned = jobs(args.targets, channels, args.out)
    shape = next(iter(paths.values())).grid.shape
    d = approximator_of(bundle, (len(every), *shape))
    if d is not None and len(channels) < len(every):
        raise InputError("the bundle's approximator sees all channels together: leave --channel out")
    # A colour is solved on its own, unless an approximator sees them all.
    groups = [channels] if d is not None else [[c] for c in channels]
    iterations = 20 if args.iterations is None and args.deadline_ms is None else args.iterations
    grid = args.grid or (None if args.deadline_ms is None else "panel")
    # Pre-distorting the target gets further at first, seeing through the approximator in the end (for twice the time).
    patient = d is not None and d.has_gradient and iterations is not None and iterations > PATIENT
    solvers = [
        Solver(
            [paths[c] for c in group], method=args.solver, penalty=args.penalty, grid=grid,
            approximator=d, through="gradient" if patient else "predistorted",
            initialiser=bundle.networks.get(INITIALISER),
        )
        for group in groups
    ]  # fmt: skip
    out = {(job.target, job.channel): job.out for job in planned}
    patterns = []
    with _progress(
        None if iterations is None else (iterations + 1) * len(args.targets) * len(groups)
    ) as tick:
        for target in args.targets:
            pictures = target_planes(target, shape, channels, args.fit, len(every) > 1)
            for solver, group in zip(solvers, groups, strict=True):
                names = [out[target, c] for c in group]
                solution = solver.solve(
                    np.stack([pictures[c] for c in group]) if len(group) > 1 else pictures[group[0]],
                    iterations,
                    deadline_ms=args.deadline_ms,
                    progress=partial(tick, names[0].name),
                )
                grays = solution.gray if len(group) > 1 else solution.gray[None]
                for channel, name, gray, quality in zip(group, names, grays, solution.qualities, strict=True):
                    write_gray(name, gray)
                    patterns.append(
                        {
                            "target": str(target),
                            "channel": channel,
                            "plane_mm": plane_of(bundle, channel, args.plane),
                            "phase": str(name),
                            "psnr_db": round(quality.psnr_db, 4),
                            "expected_psnr_db": round(solution.expected_psnr_db, 4),
                            "nrmse": round(quality.nrmse, 6),
                            "scale": quality.scale,
                            "iterations": solution.iterations,
                            "seconds": round(solution.milliseconds / 1e3, 4),
                        }
                    )
    return {"bundle": str(args.bundle), "patterns": patterns}


def show(result: dict[str, Any]) -> None:
    """One line a pattern."""
    for p in result["patterns"]:
        print(
            f"{p['phase']}: {p['channel']}, {p['plane_mm']:g} mm, amplitude PSNR {p['psnr_db']:.1f} dB "
            f"after {p['iterations']} iterations, {p['seconds']:.1f} s"
        )


def jobs(targets: Sequence[Path], channels: Sequence[str], out: Path) -> list[Job]:
    """Which file each colour of each picture goes to; makes the folder. Raises InputError where two meet."""
    single = out.suffix.lower() == ".png" and not out.is_dir()
    if single and len(targets) > 1:
        raise InputError(f"--out {out} is one file and there are {len(targets)} pictures: give a folder")
    if not single and out.suffix and not out.is_dir():
        raise InputError(f"--out {out}: patterns are PNG; give a name that ends in .png, or a folder")
    planned = []
    for target in targets:
        base = out if single else out / f"{target.stem}.png"
        for channel in channels:
            name = base if len(channels) == 1 else base.with_name(f"{base.stem}-{channel}{base.suffix}")
            planned.append(Job(target, channel, name))
    taken: dict[Path, Path] = {}
    for job in planned:
        if job.out in taken:
            raise InputError(
                f"{taken[job.out]} and {job.target} would both be written to {job.out}: rename one"
            )
        if job.out.resolve() == job.target.resolve():
            raise InputError(f"{job.target} would be overwritten by its own pattern: give another --out")
        taken[job.out] = job.target
    if not single:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out} cannot be made ({error.strerror}): give another folder") from None
    elif not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.absolute().parent}; make it first")
    return planned


def target_planes(
    path: Path, shape: tuple[int, int], channels: Sequence[str], fit: bool, colour: bool
) -> dict[str, Any]:
    """A picture's irradiance for each channel, [H, W].

    colour: the bundle has several channels, and each shows its own part; else luminance is shown.
    """
    from runtime.solver.targets import CHANNELS, read_target

    if colour and all(c in CHANNELS for c in channels):
        return dict(zip(channels, read_target(path, shape, channels, fit=fit), strict=True))
    gray = read_target(path, shape, fit=fit)
    return dict.fromkeys(channels, gray)


def write_gray(path: Path, gray: Any) -> None:
    """Gray levels, uint8 [H, W], as an 8-bit PNG that appears whole or not at all."""
    from PIL import Image

    from runtime.bundle.whole_files import whole_file

    with whole_file(path) as file:
        Image.fromarray(gray).save(file, format="PNG")


@contextmanager
def _progress(steps: int | None) -> Iterator[Callable[[str, int, float], None]]:
    """A callback (pattern, steps done, dB) for each step; a moving bar on stderr if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda name, done, psnr: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(30), TimeRemainingColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("solving", total=steps)
        yield lambda name, done, psnr: bar.update(task, advance=1, description=f"{name}  {psnr:.1f} dB")
