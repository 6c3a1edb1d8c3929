"""On what a command computes: --device."""

from __future__ import annotations

from argparse import ArgumentParser

DEVICES = ("cpu", "cuda")


def device_option(parser: ArgumentParser, more: str = "", default: str | None = "cpu") -> None:
    """--device; `more` is said of it after what it does, with the default.

    Parameters
    ----------
    default : str or None
        One of DEVICES; None where the command decides.
    """
    parser.add_argument(
        "--device",
        choices=DEVICES,
        default=default,
        help=f"what the light path is computed on: cpu, or cuda for a GPU {more or '(default: cpu)'}",
    )
