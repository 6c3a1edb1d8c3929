"""On what a command computes: --device."""

from __future__ import annotations

from argparse import ArgumentParser

DEVICES = ("cpu", "cuda")
LIGHT_PATH = "what computes the light path: cpu (default), or cuda, a GPU"
ALONE = f"{LIGHT_PATH}, by this process alone: without --workers and --cluster"


def device_option(parser: ArgumentParser, what: str = LIGHT_PATH, default: str | None = "cpu") -> None:
    """--device; `what` is its help, and `default` None where the command decides."""
    parser.add_argument("--device", choices=DEVICES, default=default, help=what)
