"""`hololoop-runtime solve`: pictures to patterns in files."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.commands.inputs import bundle_argument
from runtime.program.command import Command, Result
from runtime.program.options import millimetres, milliseconds, whole
from runtime.program.outputs import Output, check_outputs
from runtime.program.progress import Progress
from runtime.program.screen import Screen

DESCRIPTION = """Compute the panel pattern for each picture, through the light path of a bundle.

TARGET is a PNG, JPEG or TIFF file (taken as sRGB), an EXR or an NPY file (taken as linear light), of the panel's
size, or of any size with --fit. Without one, hololoop's own test picture is shown, fitted to the panel. The
pattern is an 8-bit gray PNG, to be sent to the panel as it is. With several channels in the bundle, each gets a
pattern of its own: NAME-red.png, NAME-green.png, NAME-blue.png; a gray picture is the same in all of them. With
--channel, only that one is computed, under the name given.

With --frames N, N patterns are computed together for each picture, to be shown in quick turn by a fast panel: their
irradiances add in the eye, and the PSNR is of their mean. The files are NAME-1.png to NAME-N.png (NAME-red-1.png ...).
Where the bundle's panel has few levels (64 a turn or fewer), they are in the loop, so that the patterns make up for
one another's rounding; that takes more iterations, 60 or so.

Amplitude PSNR is of what the calibrated model says that the pattern shows, zero-padded and on a grid twice as fine
as the panel's, whatever the solver computed on; more iterations or time never make it worse, and 20 iterations are
usually within a few dB of what can be reached. A solve that took longer than --deadline-ms says so."""

IN_PYTHON = """in Python:
  from runtime.bundle.bundle_folder import read_bundle
  from runtime.bundle.light_path_arrays import load_light_path
  from runtime.solver import Solver
  from runtime.solver.targets import read_target

  path = load_light_path(read_bundle("bundle/"), "green")
  solver = Solver(path)                                           # once
  target = read_target("picture.png", path.grid.shape, fit=True)  # for each picture
  gray = solver.solve(target, deadline_ms=50).gray                # for each; for video: solver.frame"""

SOLVERS = ("bfgs", "double_phase", "gerchberg_saxton", "adam")
PENALTIES = ("amplitude", "irradiance", "l1")
USUAL_ITERATIONS = 20
PATIENT_ITERATIONS = 25  # from more than these on, seeing through the approximator gets further


def options(parser: ArgumentParser) -> None:
    """The options of `solve`."""
    bundle_argument(parser)
    parser.add_argument(
        "targets", metavar="TARGET", type=Path, nargs="*", help="pictures to show (default: a test picture)"
    )
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
        help=f"steps a pattern (default {USUAL_ITERATIONS}, or as many as the deadline allows; 0: double phase alone)",
    )
    parser.add_argument(
        "--deadline-ms",
        metavar="T",
        type=milliseconds,
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
    parser.add_argument(
        "--frames",
        metavar="N",
        type=whole(1, 32),
        default=1,
        help="patterns a picture and colour, for a panel that shows them in quick turn (1 to 32, default 1)",
    )
    parser.add_argument("--channel", metavar="C", help="compute this channel only (default: all)")
    parser.add_argument(
        "--plane",
        metavar="MM",
        type=millimetres,
        help="image plane, mm from the panel (default: the bench's)",
    )
    parser.add_argument(
        "--beside-zero-order",
        action="store_true",
        help="for a bench whose iris is moved off the axis, so that undiffracted light does not reach the picture",
    )
    parser.add_argument("--fit", action="store_true", help="crop and resize pictures of another size")


def _solver_name(text: str) -> str:
    """A solver's name; "default" is an older spelling of "bfgs"."""
    return "bfgs" if text == "default" else text


def run(args: Namespace, screen: Screen) -> Result:
    """Compute and write the patterns, picture by picture."""
    import numpy as np

    from runtime.bundle.bundle_folder import INITIALISER, read_bundle
    from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, plane_of
    from runtime.networks.onnx_approximator import approximator_of
    from runtime.solver import Solver, beside_zero_order
    from runtime.solver.pattern_files import pattern_files, write_pattern
    from runtime.solver.solver_input import check_frames
    from runtime.solver.targets import TEST_PICTURE, channel_targets

    check_frames(args.frames, args.solver)
    targets: list[Path] = args.targets or [TEST_PICTURE]
    fit = args.fit or not args.targets
    bundle = read_bundle(args.bundle)
    every = bundle_channels(bundle)
    channels = every if args.channel is None else [args.channel]
    paths = {c: load_light_path(bundle, c, args.plane) for c in channels}
    if args.beside_zero_order:
        paths = {c: beside_zero_order(path) for c, path in paths.items()}
    files = pattern_files(targets, channels, args.out, args.frames)
    check_outputs([Output(file.out, makes_folders=True) for file in files], args)
    shape = next(iter(paths.values())).grid.shape
    approximator = approximator_of(bundle, (len(every), *shape))
    if approximator is not None and len(channels) < len(every):
        raise InputError("the bundle's approximator sees all channels together: leave --channel out")
    # A colour is solved on its own, unless an approximator sees them all.
    groups = [channels] if approximator is not None else [[c] for c in channels]
    iterations = args.iterations
    if iterations is None and args.deadline_ms is None:
        iterations = USUAL_ITERATIONS
    grid = args.grid or (None if args.deadline_ms is None else "panel")
    # Pre-distorting the target gets further at first, seeing through the approximator in the end (for twice the time).
    patient = iterations is not None and iterations > PATIENT_ITERATIONS
    through = "gradient" if patient and approximator and approximator.has_gradient else "predistorted"
    solvers = [
        Solver(
            [paths[c] for c in group], method=args.solver, penalty=args.penalty, grid=grid,
            approximator=approximator, through=through, initialiser=bundle.networks.get(INITIALISER),
            frames=args.frames,
        )
        for group in groups
    ]  # fmt: skip
    out: dict[tuple[Path, str], list[Path]] = {}
    for file in files:
        out.setdefault((file.target, file.channel), []).append(file.out)
    patterns = []
    with screen.progress("solving") as progress:
        for number, target in enumerate(targets):
            pictures = channel_targets(target, shape, channels, fit=fit, colour=len(every) > 1)
            for part, (solver, group) in enumerate(zip(solvers, groups, strict=True)):
                names = [out[target, c] for c in group]
                solves = (number * len(groups) + part, len(targets) * len(groups))
                solution = solver.solve(
                    np.stack([pictures[c] for c in group]) if len(group) > 1 else pictures[group[0]],
                    iterations,
                    deadline_ms=args.deadline_ms,
                    progress=_iterations_of(progress, *solves, iterations, names[0][0].name),
                )
                grays = solution.gray.reshape(len(group), args.frames, *shape)
                solved = zip(group, names, grays, solution.qualities, solution.given, strict=True)
                for channel, name, gray, quality, given in solved:
                    for frame, one in enumerate(name):
                        write_pattern(one, gray[frame], given)
                        patterns.append(
                            {
                                "target": str(target),
                                "channel": channel,
                                "frame": frame + 1,
                                "plane_mm": plane_of(bundle, channel, args.plane),
                                "phase": str(one),
                                "psnr_db": round(quality.psnr_db, 4),
                                "expected_psnr_db": round(solution.expected_psnr_db, 4),
                                "nrmse": round(quality.nrmse, 6),
                                "scale": quality.scale,
                                "iterations": solution.iterations,
                                "seconds": round(solution.milliseconds / 1e3, 4),
                                "deadline_missed": args.deadline_ms is not None
                                and solution.milliseconds > args.deadline_ms,
                            }
                        )
    return {"bundle": str(args.bundle), "test_picture": not args.targets, "patterns": patterns}


def _iterations_of(
    progress: Progress, number: int, solves: int, iterations: int | None, name: str
) -> Callable[[int, float], None]:
    """What the solver calls after each iteration: that solve's share of all, by a deadline only at its end."""

    def iterated(done: int, psnr_db: float) -> None:
        share = 0.0 if iterations is None else done / (iterations + 1)
        progress((number + share) / solves, f"{name}  {psnr_db:.1f} dB")

    return iterated


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """One line a pattern, or, of several frames, one for all of a colour's."""
    if result["test_picture"]:
        screen.say("No picture is given: the patterns show hololoop's own test picture.")
    for p in result["patterns"]:
        if p["frame"] < args.frames:
            continue
        frames = f" (the mean of {args.frames} frames)" if args.frames > 1 else ""
        missed = f"; the deadline of {args.deadline_ms:g} ms was missed" if p["deadline_missed"] else ""
        screen.say(
            f"{p['phase']}: {p['channel']}, {p['plane_mm']:g} mm, amplitude PSNR {p['psnr_db']:.1f} dB"
            f"{frames} after {p['iterations']} iterations, {p['seconds']:.1f} s{missed}"
        )


COMMAND = Command(
    name="solve",
    about="Compute the pattern for each picture.",
    options=options,
    run=run,
    show=show,
    examples=(
        "solve bundle/ --out pattern.png",
        "solve bundle/ picture.png --out pattern.png",
        "solve bundle/ a.png b.png --out patterns/ --iterations 40",
        "solve bundle/ photo.png --fit --channel green --plane 30 --out pattern.png",
        "solve bundle/ picture.png --frames 4 --iterations 60 --out patterns/",
        "solve bundle/ frame.png --deadline-ms 50 --out pattern.png --json",
    ),
    after="Show it on the headset: show pattern.png --headset headset.toml --out seen/",
    description=DESCRIPTION,
    more=IN_PYTHON,
)
