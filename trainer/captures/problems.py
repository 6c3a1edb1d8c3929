"""A problem of a capture set, as the check reports it."""

from __future__ import annotations

from dataclasses import dataclass

MISREAD = (
    "convention",
    "left_justified",
    "bit_depth",
    "mosaic",
    "mismatched",
    "no_correlation",
)  # kinds of problem after which every number is wrong


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a capture set.

    Attributes
    ----------
    severity : str
        "error" or "warning".
    kind : str
        missing_file, wrong_size, saturated, left_justified, black_level, duplicate, too_few, unknown_channel,
        unreadable, bit_depth, not_a_number, noise, pattern, dark, no_signal, camera_numbers, convention,
        mismatched, shifted, distance, no_correlation, mosaic or bracket.
    capture : str
        The capture's id; "" for the whole set.
    message : str
        What is wrong, where, and what to change.
    """

    severity: str
    kind: str
    capture: str
    message: str
