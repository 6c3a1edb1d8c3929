"""Options for when an effect is worth adding and when a model is complete."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from runtime.program.options import number

if TYPE_CHECKING:
    from trainer.diagnosis.verdict import Thresholds


def threshold_options(parser: ArgumentParser) -> None:
    """--level, --share, --min-excess, --complete-share and --complete-excess."""
    group = parser.add_argument_group(
        "what counts",
        "Shares are of the ideal model's excess: the mean squared error above the camera's noise, over\n"
        "the variance of the measured signal. No threshold is below the floor that repeated pictures show.",
    )
    share = number(0, 1)
    group.add_argument(
        "--level",
        metavar="P",
        type=number(1e-9, 0.5),
        default=None,
        help="chance that any effect is found where there is none (default 0.05)",
    )
    group.add_argument(
        "--share",
        metavar="S",
        type=share,
        default=None,
        help="an effect must remove more than this share as well (default 0; 0.02 was the first version's rule)",
    )
    group.add_argument(
        "--min-excess",
        metavar="E",
        type=share,
        default=None,
        help="an effect must remove more than this excess to be worth adding (default 0.0002)",
    )
    group.add_argument(
        "--complete-share",
        metavar="S",
        type=share,
        default=None,
        help="a model is complete below this share, too (default 0; 0.02 was the first version's rule)",
    )
    group.add_argument(
        "--complete-excess",
        metavar="E",
        type=share,
        default=None,
        help="a model is complete below this excess (default 0.0005)",
    )


def thresholds_of(args: Namespace) -> Thresholds:
    """The thresholds that the options ask for."""
    from trainer.diagnosis.verdict import Thresholds

    named = {
        "level": args.level,
        "share": args.share,
        "excess": args.min_excess,
        "complete_share": args.complete_share,
        "complete_excess": args.complete_excess,
    }
    return Thresholds(**{name: value for name, value in named.items() if value is not None})
