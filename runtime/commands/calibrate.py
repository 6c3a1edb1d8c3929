"""`hololoop-runtime calibrate`: what has drifted, found with the headset's own camera and put into the bundle."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from runtime.commands.inputs import bundle_argument, headset_option, say_simulated
from runtime.program.command import Command, Result
from runtime.program.options import millimetres, seed_option
from runtime.program.outputs import Output, files_written
from runtime.program.screen import Screen

DESCRIPTION = """Find out with the headset's own camera what has drifted, and put it into the bundle's light path.

Some thirty patterns a colour are shown and captured: dots (where the camera looks), a sweep of gratings (the panel's
phase response), ten patterns of random grains (wavefront, beam, distance and, of several colours, where each
laser points, refit together) and three that the fit does not see. The light path is replaced only if it predicts
those three better, surely and by enough to matter, and predicts them no worse in the bundle's other planes, as far as
the camera can be focused on them. A network in
the bundle is refitted, kept or left out with it, as a test picture decides. The folder holds the old bundle
or the new one at every moment; the old one is kept as BUNDLE.previous. Where the headset's configuration has fields in
turn, each colour is lit in its own field alone.

verdict: recalibrated (replaced), unchanged (it was as good as the camera can tell), not_explained (it is wrong, and
refitting what drifts does not correct it: capture and diagnose on the workstation)."""


WAYS = {"left_out": "left out", "kept": "as it was", "refitted": "refitted"}


def options(parser: ArgumentParser) -> None:
    """The options of `calibrate`."""
    bundle_argument(parser, "the bundle that the headset uses")
    what = parser.add_mutually_exclusive_group(required=True)
    headset_option(what, required=False)
    what.add_argument("--restore", action="store_true", help="put back the bundle that was last replaced")
    parser.add_argument(
        "--plane", metavar="MM", type=millimetres, help="plane that the camera sees (default: the bundle's)"
    )
    parser.add_argument("--check", action="store_true", help="measure and report, but replace nothing")
    parser.add_argument("--report", metavar="FILE.html", type=Path, help="write a report with pictures")
    seed_option(parser, "which random patterns")


def run(args: Namespace, screen: Screen) -> Result:
    """Calibrate, report, and replace the bundle where that is right."""
    from runtime.bundle.bundle_folder import read_bundle
    from runtime.bundle.light_path_arrays import bundle_channels
    from runtime.calibration.bundle_replacement import previous, replace_bundle, restore_bundle
    from runtime.calibration.calibration_report import write_report
    from runtime.calibration.self_calibration import calibrate
    from runtime.calibration.summary import numbers, sentence_of
    from runtime.headset.colour_fields import open_colours
    from runtime.headset.open_devices import is_simulated

    if args.restore:
        restore_bundle(args.bundle)
        return {"verdict": "restored", "bundle": str(args.bundle), "previous": str(previous(args.bundle))}
    bundle = read_bundle(args.bundle)
    with screen.progress("calibrating") as progress:
        found = calibrate(
            lambda: open_colours(args.headset, bundle_channels(bundle), args.seed),
            bundle,
            args.plane,
            args.seed,
            progress,
        )
    replaced = found.verdict == "recalibrated" and not args.check
    result: dict[str, Any] = {
        "bundle": str(args.bundle),
        "simulated": is_simulated(args.headset),
        "replaced": replaced,
        "previous": None,
        "report": None,
    }
    if replaced:
        result["previous"] = str(replace_bundle(args.bundle, bundle, found))
    if args.report:
        write_report(args.report, found, replaced)
        result["report"] = str(args.report)
    return {**numbers(found), **result, "sentence": sentence_of(numbers(found), replaced)}


def outputs(args: Namespace) -> list[Output]:
    """The report; the bundle has a rule of its own, and its former one is kept."""
    return files_written(report=args.report)


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """The verdict in words, and what drifted."""
    if result["verdict"] == "restored":
        screen.say(
            f"{result['bundle']} is again what it was; the calibrated one is now {result['previous']}."
        )
        return
    say_simulated(result, screen)
    screen.say(result["sentence"])
    wavefront, distance = result["wavefront"], result["distance_mm"]
    screen.say(
        f"\nwavefront   {wavefront['rms_nm']:.1f} nm rms, {wavefront['peak_to_valley_nm']:.0f} nm peak to valley "
        f"(± {wavefront['error_rms_nm']:.2f} nm rms from noise)\n"
        f"distance    {distance['value']:+.4f} ± {distance['error']:.4f} mm"
    )
    for name, c in result["channels"].items():
        screen.say(
            f"{name:<11} response up to {c['response_change_rad']:.3f} rad from what was believed; beam "
            f"{100 * c['illumination_rms']:.1f} % rms; power {_power(c)}; picture "
            f"{c['picture_psnr_db']['before']:.1f} -> {c['picture_psnr_db']['after']:.1f} dB"
        )
    first, *others = result["channels"]
    for name in others:
        tilt = result["channels"][name].get("laser_tilt_mrad")
        if tilt is not None:
            screen.say(f"{name:<11} laser at {math.hypot(*tilt):.3f} mrad to {first}'s")
    for plane in result["planes"]:
        before, after = (plane["heldout"][k]["excess"] for k in ("before", "after"))
        screen.say(
            f"at {plane['plane_mm']:g} mm   excess {before:.2g} -> {after:.2g}, where nothing was fitted"
        )
    if result["network"]:
        outcome, errors = result["network"]["outcome"], result["network"]["errors"]
        tried = ", ".join(f"{WAYS[name]} {error:.3g}" for name, error in errors.items())
        screen.say(f"network     {WAYS[outcome]}; error of amplitude squared on the test pictures: {tried}")
    if result["replaced"]:
        screen.say(
            f"\nThe old light path is {result['previous']}; to put it back: calibrate {result['bundle']} --restore"
        )


def _power(colour: dict[str, Any]) -> str:
    """A colour's power in words."""
    steady = f"steady to {100 * colour['power_spread']:.2f} %"
    change = colour["power_change"]
    return steady if change is None else f"{100 * change:+.1f} % since the last calibration, {steady}"


COMMAND = Command(
    name="calibrate",
    about="Find what has drifted and put it into the bundle.",
    options=options,
    run=run,
    show=show,
    outputs=outputs,
    examples=(
        "calibrate bundle/ --headset virtual:panel_wavefront --report calibration.html",
        "calibrate bundle/ --headset my_bench.toml --check",
        "calibrate bundle/ --restore",
    ),
    after="Solve with it: solve bundle/ picture.png --out pattern.png",
    description=DESCRIPTION,
)
