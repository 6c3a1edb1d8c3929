"""Options of the commands that train networks: their size, their training, and published weights to judge by."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from runtime.program.options import whole


def size_options(parser: ArgumentParser, steps: str, default_steps: int | None, filters: str) -> None:
    """--filters and --steps.

    Parameters
    ----------
    steps, filters : str
        What the help says of each.
    default_steps : int or None
        Steps where the option is not given.
    """
    parser.add_argument("--filters", metavar="N", type=whole(2, 1024), help=filters)
    parser.add_argument("--steps", metavar="N", type=whole(0, 10**8), default=default_steps, help=steps)


def judge_options(parser: ArgumentParser) -> None:
    """--vgg and --lpips."""
    parser.add_argument(
        "--vgg",
        metavar="FILE",
        type=Path,
        help="VGG-19's weights for the perceptual loss: .pth, .safetensors or MatConvNet's .mat (none: left out)",
    )
    parser.add_argument(
        "--lpips",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="weights of LPIPS: backbone (AlexNet or VGG-16) and heads, in one file or in two (none: no 1-LPIPS)",
    )
