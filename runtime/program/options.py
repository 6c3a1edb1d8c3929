"""Types of options, each with a sentence for what it cannot read, and the options that both programs have."""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterable

from firmware_iface.errors import nearest


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


def number(low: float, high: float) -> Callable[[str], float]:
    """An option's number within a range."""

    def read(text: str) -> float:
        value = _finite(text)
        if value is None or not low <= value <= high:
            raise ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return read


def milliseconds(text: str) -> float:
    """A time in ms, more than 0."""
    value = _finite(text)
    if value is None or value <= 0:
        raise ArgumentTypeError(f"{text!r} is not a time in ms")
    return value


def exposure_ms(text: str) -> float:
    """A camera's exposure in ms."""
    value = _finite(text)
    if value is None or not 0 < value <= 10000:
        raise ArgumentTypeError(f"{text!r} is not an exposure in ms: give more than 0 and at most 10000")
    return value


def millimetres(text: str) -> float:
    """A distance in mm."""
    value = _finite(text)
    if value is None:
        raise ArgumentTypeError(f"{text!r} is not a distance in mm")
    return value


def one_of(known: Iterable[str], noun: str) -> Callable[[str], str]:
    """One of the known words, which are called `noun`, such as "a stage"."""
    words = tuple(known)

    def read(text: str) -> str:
        if text not in words:
            raise ArgumentTypeError(f"'{text}' is not {noun}; {nearest(text, words)}")
        return text

    return read


def comma_list(text: str) -> list[str]:
    """Words between commas."""
    words = [word.strip() for word in text.split(",")]
    if not all(words):
        raise ArgumentTypeError(f"{text!r} is not a list of words with commas between them")
    return words


def distances(text: str) -> list[float]:
    """Millimetres between commas."""
    return [number(-2000, 2000)(word) for word in comma_list(text)]


def seed_option(parser: ArgumentParser, what: str = "fixes every random choice") -> None:
    """--seed."""
    parser.add_argument(
        "--seed", metavar="N", type=whole(0, 2**31 - 1), default=0, help=f"{what} (default 0)"
    )


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
