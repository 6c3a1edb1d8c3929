"""Products: a shape whose strength another shape changes. The first one's size is the product's."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.reading import Array, Reading, Values, share_explained

CLEARLY = 0.1  # of what a shape leaves of its map: what another factor must explain


def product(first: Reading, second: Reading, found: Array, explained: float) -> Reading:
    """The reading of a shape times another: the code of both, and the numbers of both.

    Parameters
    ----------
    first, second : Reading
        `second` is the strength of `first`, or where it is not `whole` the relative change of that strength.
    found : array
        The product on the map's nodes.
    explained : float
        Share of the map's variance.
    """
    names = {n.name: n.name for n in second.numbers}
    taken = {n.name for n in first.numbers}
    names = {old: f"{second.name}_{old}" if old in taken else old for old in names}

    def renamed(text: str) -> str:
        for old, new in names.items():
            text = re.sub(rf"\b{old}\b", new, text)
        return text

    def described(values: Values) -> str:
        own = {old: values[new] for old, new in names.items()}
        return f"{first.describe(values)}; times {second.describe(own)}"

    strength = "value" if second.whole else "(1 + value)"
    return Reading(
        name=f"{first.name}_times_{second.name}",
        about=f"{first.about.rstrip('.')}; times: {second.about[0].lower()}{second.about[1:]}",
        describe=described,
        formula=rf"v = v_1 {'v_2' if second.whole else '(1 + v_2)'},\quad {_numbered(first.formula, 1)};\quad "
        + _numbered(second.formula, 2),
        numbers=(*first.numbers, *(replace(n, name=names[n.name]) for n in second.numbers)),
        code=(
            *first.code,
            "    shape = value",
            *(renamed(line) for line in second.code),
            f"    value = shape * {strength}",
        ),
        found=found,
        explained=explained,
        imports=tuple(dict.fromkeys((*first.imports, *second.imports))),
        whole=first.whole,
    )


def strength_of(one: ProbeMap, first: Reading) -> ProbeMap:
    """How the strength of a shape changes over its map: 0 on average, noise where the shape is nearly zero."""
    pattern = first.found - first.found.mean()
    values = one.values - one.values.mean()
    square = float((pattern**2).mean()) or 1e-30
    size = float((pattern * values).mean()) / square
    change = pattern * (values - size * pattern) / (square * size if size else 1e-30)
    return replace(one, place=replace(one.place, unit="1"), values=change)


def product_in(one: ProbeMap, first: Reading, second: Reading) -> Reading | None:
    """The product of two shapes, where it explains clearly more of a map than the first alone.

    Parameters
    ----------
    second : Reading
        Seen in the strength of the first (`strength_of`).
    """
    values = one.values - one.values.mean()
    pair = [first.found, first.found * second.found]
    flat = np.stack([(p - p.mean()).reshape(-1) for p in pair])
    normal = flat @ flat.T
    normal = normal + 1e-12 * np.trace(normal) * np.eye(2)
    size, change = (float(t) for t in np.linalg.solve(normal, flat @ values.reshape(-1)))
    found = size * pair[0] + change * pair[1]
    explained = share_explained(one.values, found)
    if size <= 0 or explained < first.explained + CLEARLY * (1 - first.explained):
        return None
    return product(first.scaled(size), second.scaled(change / size), found, explained)


def _numbered(formula: str, number: int) -> str:
    """A factor's formula with its own name of the value."""
    return re.sub(r"^v(?=[ _])", f"v_{number}", formula)
