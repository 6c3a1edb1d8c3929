"""`hololoop-runtime devices`: what is attached, what answers, what is wrong, and what to do about it."""

from __future__ import annotations

import textwrap
from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from runtime.program.command import Command, Result
from runtime.program.screen import Screen

DESCRIPTION = """Say what is attached, what answers, what is wrong, and what to do.

Without CONFIG: what this host has, USB devices that hololoop knows, I2C buses, cameras. With CONFIG, the headset's
TOML file (see hololoop-runtime serve --help): each of its devices is opened and asked, with the lasers dark. Where
its service runs, which holds the devices, the service is asked instead."""

WIDTH = 110  # columns of a line about a device's status


def options(parser: ArgumentParser) -> None:
    """The options of `devices`."""
    parser.add_argument("config", metavar="CONFIG", type=Path, nargs="?", help="the headset's TOML file")


def run(args: Namespace, screen: Screen) -> Result:
    """Look at everything."""
    from runtime.headset.device_findings import headset_findings, host_findings
    from runtime.service.configuration import read_configuration

    found = host_findings() if args.config is None else headset_findings(read_configuration(args.config))
    return {
        "devices": [asdict(finding) for finding in found],
        "problems": sum(len(finding.problems) for finding in found),
        "ready": all(finding.answers and not finding.problems for finding in found),
    }


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """A line a device, and under it what is wrong."""
    for found in result["devices"]:
        state = "answers" if found["answers"] else "does not answer" if found["attached"] else "not there"
        mark = "ok" if found["answers"] and not found["problems"] else "!!"
        screen.say(f"{mark}  {found['part']:8} {found['what']}: {state}")
        status = "; ".join(f"{name} {_words(value)}" for name, value in found["status"].items())
        for line in textwrap.wrap(status, WIDTH):
            screen.say(f"      {line}")
        for problem in found["problems"]:
            screen.say(f"    - {problem}")
    screen.say("everything is well" if result["ready"] else f"to be repaired: {result['problems']}")


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_words(one)}" for name, one in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


COMMAND = Command(
    name="devices",
    about="Say what is attached, what is wrong and what to do.",
    options=options,
    run=run,
    show=show,
    problems=lambda result: result.get("problems", 0) > 0,
    examples=("devices", "devices headset.toml"),
    after="Run the headset's service: serve headset.toml",
    description=DESCRIPTION,
)
