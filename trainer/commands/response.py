"""`hololoop-trainer response`: a panel's phase response from a power meter's sweep of gratings."""

from __future__ import annotations

import csv
from argparse import ArgumentParser, Namespace
from pathlib import Path

from runtime.program.command import Command, Result
from runtime.program.outputs import Output, files_written
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.outputs import out_option


def options(parser: ArgumentParser) -> None:
    """The options of `response`."""
    parser.add_argument(
        "powers",
        metavar="POWERS.csv",
        type=Path,
        help="two columns: gray level g, and the power in the first order of a binary grating of gray 0 and g",
    )
    out_option(
        parser,
        "RESPONSE.csv",
        "where the response goes: a table with gray, phase_rad and error_rad",
    )


def run(args: Namespace, screen: Screen) -> Result:
    """Fit the response and write it."""
    import numpy as np

    from runtime.bundle.whole_files import whole_file
    from trainer.captures.grating_powers import fitted_to_powers, read_powers

    found = fitted_to_powers(*read_powers(args.powers))
    waves = float(found.phase[-1] / (2 * np.pi))
    with whole_file(args.out, "w") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(("gray", "phase_rad", "error_rad"))
        for gray, phase, error in zip(found.gray, found.phase, found.error, strict=True):
            table.writerow((f"{gray:g}", f"{phase:.5f}", f"{error:.5f}"))
    halves = np.pi * np.arange(1, int(2 * waves) + 1)
    return {
        "response": str(args.out),
        "waves": waves,
        "waves_error": float(found.error[-1] / (2 * np.pi)),
        "median_error_rad": float(np.median(found.error)),
        "half_waves_at_gray": [float(g) for g in found.gray_of(halves)],
        "left_of_range": found.left,
    }


def outputs(args: Namespace) -> list[Output]:
    """The response."""
    return files_written(out=args.out)


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """How far the phase goes, and how well the powers are explained."""
    screen.say(
        f"The phase goes to {result['waves']:.3f} ± {result['waves_error']:.3f} waves; its error is "
        f"{result['median_error_rad']:.3f} rad in the median of the gray levels.",
        style="bold",
    )
    halves = ", ".join(f"{gray:.0f}" for gray in result["half_waves_at_gray"])
    if halves:
        screen.say(f"Half waves at gray {halves}.")
    screen.say(
        f"The response leaves {100 * result['left_of_range']:.2g} % of the range of power unexplained. It is in "
        f"{result['response']}."
    )
    screen.next(
        command_line("check", "captures/"), "Captures tell a bent phase from light that no grating steers"
    )


COMMAND = Command(
    name="response",
    about="Fit a panel's phase response to the powers of a grating sweep.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=("response powers.csv --out response.csv",),
    after="Captures tell a bent phase from light that no grating steers: check captures/",
)
