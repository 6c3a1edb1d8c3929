"""The keys of bench.toml: what each may hold, and its default."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from firmware_iface.errors import InputError

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class KeyRule:
    """What a key may hold.

    Attributes
    ----------
    kind : type
    low, high : float
        Its range, inclusive.
    above : bool
        `low` itself is excluded.
    choices : tuple
        The only values allowed; () for any in the range.
    default : object
        None where the key is required (a list is optional all the same).
    unit : str
        For messages.
    """

    kind: type
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[Any, ...] = ()
    default: Any = None
    unit: str = ""

    def allowed(self) -> str:
        """The allowed values, in words."""
        if self.choices:
            return "one of " + ", ".join(repr(c) if isinstance(c, str) else str(c) for c in self.choices)
        if self.kind is bool:
            return "true or false"
        if self.kind is str:
            return "text of 1 to 200 characters"
        name = "a whole number" if self.kind is int else "a number"
        start = f"above {self.low:g} and up to" if self.above else f"from {self.low:g} to"
        return f"{name} {start} {self.high:g}{' ' + self.unit if self.unit else ''}"


TABLES: dict[str, dict[str, KeyRule]] = {
    "panel": {
        "width": KeyRule(int, 2, 16384),
        "height": KeyRule(int, 2, 16384),
        "pitch_um": KeyRule(float, 0.05, 1000, unit="um"),
        "levels": KeyRule(int, 2, 65536, default=256),
        "fill_factor": KeyRule(float, 0, 1, above=True, default=1.0),
        "phase_sign": KeyRule(int, choices=(1, -1), default=1),
        "gray_levels": KeyRule(list),
    },
    "channel": {"name": KeyRule(str), "wavelength_nm": KeyRule(float, 100, 20000, unit="nm")},
    "propagation": {"distance_mm": KeyRule(float, -1e4, 1e4, unit="mm")},
    "iris": {
        "shape": KeyRule(str, choices=("square", "circle"), default="square"),
        "half_width": KeyRule(float, 0, 4, above=True, default=1.0),
    },
    "camera": {
        "width": KeyRule(int, 2, 16384),
        "height": KeyRule(int, 2, 16384),
        "pixel_um": KeyRule(float, 0.05, 1000, unit="um"),
        "registered": KeyRule(bool),
        "bit_depth": KeyRule(int, 4, 16),
        "black_level": KeyRule(float, 0, 65534, unit="counts"),
        # Left out, these two are measured from repeated captures; until then, or without repeats, a common camera's.
        "full_well_e": KeyRule(float, 1, 1e9, default=10000.0, unit="electrons"),
        "read_noise_e": KeyRule(float, 0, 1e6, default=5.0, unit="electrons"),
        "homography": KeyRule(list),
    },
}
TOP_KEYS = ("schema", "name", "panel", "channel", "propagation", "iris", "camera")


def checked_table(table: str, given: Any) -> dict[str, Any]:
    """A table's values, checked, with its defaults filled in.

    Raises
    ------
    InputError
        Where the table is missing, or a key is unknown, missing or not allowed.
    """
    keys = TABLES[table]
    header = "[[channel]]" if table == "channel" else f"[{table}]"
    if not isinstance(given, Mapping):
        raise InputError(f"bench.toml has no table {header}: add it with {', '.join(keys)}")
    for key in given:
        if key not in keys:
            raise InputError(
                f"{table}.{str(key)[:60]} is not known in bench.toml: {suggestion(key, tuple(keys))}"
            )
    return {key: checked_value(f"{table}.{key}", rule, given.get(key)) for key, rule in keys.items()}


def checked_value(where: str, rule: KeyRule, given: Any) -> Any:
    """A key's value, or its default.

    Parameters
    ----------
    where : str
        table.key, as the message names it.
    rule : KeyRule
    given : object
        None where the key is missing.

    Raises
    ------
    InputError
        Where the value is missing or not allowed.
    """
    if given is None and (rule.default is not None or rule.kind is list):
        return rule.default
    if rule.kind is list:
        return given
    if given is None:
        raise InputError(f"{where} is missing in bench.toml: write {rule.allowed()}")
    kinds = (int, float) if rule.kind is float else (rule.kind,)
    good = isinstance(given, kinds) and (rule.kind is bool or not isinstance(given, bool))
    if good and rule.choices:
        good = given in rule.choices
    elif good and rule.kind is str:
        good = bool(given.strip()) and len(given) <= 200 and given.isprintable()
    elif good and rule.kind in (int, float):
        good = rule.low <= given <= rule.high and not (rule.above and given == rule.low)
    if not good:
        raise InputError(f"{where} is {printed(given)}: write {rule.allowed()}")
    return float(given) if rule.kind is float else given


def printed(value: Any) -> str:
    """A value as messages show it: at most 60 characters."""
    try:
        return repr(value)[:60]
    except ValueError:  # a whole number too long to print
        return "a number too long to print"


def suggestion(key: str, known: tuple[str, ...]) -> str:
    """What to do about an unknown key."""
    near = get_close_matches(str(key), known, 1)
    return f"did you mean {near[0]!r}?" if near else f"use {', '.join(known)}, or remove it"


def checked_matrix(given: Any) -> Matrix:
    """The camera's homography, from three rows of three numbers or nine numbers.

    Raises
    ------
    InputError
        Where it is not an invertible matrix of finite numbers.
    """
    rows = given
    if isinstance(given, (list, tuple)) and len(given) == 9:
        rows = [given[0:3], given[3:6], given[6:9]]
    wrong = InputError(
        "camera.homography is not an invertible 3 x 3 matrix of finite numbers: "
        "write [[a, b, c], [d, e, f], [g, h, i]], one list a row"
    )
    if not isinstance(rows, (list, tuple)) or len(rows) != 3:
        raise wrong
    flat: list[float] = []
    for row in rows:
        if not isinstance(row, (list, tuple)) or len(row) != 3:
            raise wrong
        for value in row:
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e12:
                raise wrong
            flat.append(float(value))
    a, b, c, d, e, f, g, h, i = flat
    scale = max(map(abs, flat)) or 1.0
    if abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)) <= 1e-15 * scale**3:
        raise wrong
    return (a, b, c), (d, e, f), (g, h, i)
