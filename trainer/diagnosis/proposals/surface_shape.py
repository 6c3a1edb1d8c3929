"""Smooth shapes in a probe's map: a low-order surface, and a function of the distance from a centre."""

from __future__ import annotations

import numpy as np

from runtime.lightpath.legendre import legendre_count, legendre_maps
from trainer.diagnosis.proposals.probe_maps import ProbeMap
from trainer.diagnosis.proposals.product_shape import product_in, strength_of
from trainer.diagnosis.proposals.reading import Array, Number, Reading, share_explained, with_unit
from trainer.formatting import number

ORDER = 5  # of the surface
ENVELOPE = 2  # order of the surface by which another shape is multiplied
POWERS = 4  # of the squared distance
CENTRES = np.linspace(-0.8, 0.8, 9)  # of the half width, where the search for a centre looks
LEGENDRE = "from runtime.lightpath.legendre import legendre_surface"


def smooth_in(one: ProbeMap, order: int = ORDER, lowest: int = 1) -> list[Reading]:
    """The low-order surface of a map, with its mean where `lowest` is 0."""
    basis = _surfaces(one, order, lowest)
    if lowest:
        terms, shape = _fitted(basis, one.values)
    else:
        flat = basis.reshape(len(basis), -1)
        terms = [float(t) for t in np.linalg.lstsq(flat.T, one.values.reshape(-1), rcond=None)[0]]
        shape = np.tensordot(terms, basis, axes=1)
    unit, size = one.place.unit, float(np.std(shape))
    return [
        Reading(
            name="surface",
            about="A smooth surface.",
            describe=lambda v: (
                f"a surface of order {order}, terms of {with_unit(float(np.hypot.reduce(v['terms'])), unit)} in all"
            ),
            formula=r"v = \sum_k a_k L_k(y, x)",
            numbers=(
                Number(
                    "terms",
                    unit,
                    _scale(unit, size),
                    tuple(terms),
                    0.0,
                    *_range(unit),
                    f"of Legendre products of orders {lowest} to {order}",
                    True,
                ),
            ),
            code=(_surface_line("value", "terms", one, lowest),),
            found=shape,
            explained=share_explained(one.values, shape),
            imports=(LEGENDRE,),
        )
    ]


def radial_in(one: ProbeMap) -> list[Reading]:
    """The function of the distance from a centre that explains most of a map."""
    y, x = one.grid
    values = one.values - one.values.mean()
    stride = max(1, int(np.sqrt(values.size / 4000)))
    few = tuple(a[::stride, ::stride] for a in (y, x, values))
    tried = []
    for cy in CENTRES * one.reach[0]:
        for cx in CENTRES * one.reach[1]:
            basis = _powers(few[0] - cy, few[1] - cx, one.radius)
            shape = _fitted(basis, few[2])[1]
            tried.append((float(((few[2] - shape) ** 2).sum()), float(cy), float(cx)))
    _, cy, cx = min(tried)
    terms, shape = _fitted(_powers(y - cy, x - cx, one.radius), values)
    unit, spread = one.place.unit, one.place.spread
    far = 2 * one.radius
    return [
        Reading(
            name="radial",
            about="A function of the distance from a centre.",
            describe=lambda v: (
                f"a function of the distance from row {number(float(v['row']))}, column "
                f"{number(float(v['column']))} {spread} from the middle, terms of "
                f"{with_unit(float(np.hypot.reduce(v['terms'])), unit)} in all"
            ),
            formula=r"v = \sum_{k=1}^{4} a_k \rho^{2k},\quad \rho^2 = \frac{(y-y_0)^2 + (x-x_0)^2}{R^2}",
            numbers=(
                Number(
                    "row", spread, 0.02 * one.radius, cy, 0.0, -far, far, "of the centre, from the middle"
                ),
                Number(
                    "column", spread, 0.02 * one.radius, cx, 0.0, -far, far, "of the centre, from the middle"
                ),
                Number(
                    "terms",
                    unit,
                    _scale(unit, float(np.std(shape))),
                    tuple(terms),
                    0.0,
                    *_range(unit),
                    "of the even powers of the distance, from the second on",
                    True,
                ),
            ),
            code=(
                f"    square = ((y - row) ** 2 + (x - column) ** 2) / {one.radius:.6g} ** 2",
                f"    value = sum(terms[k] * square ** (k + 1) for k in range({POWERS}))",
            ),
            found=shape,
            explained=share_explained(one.values, shape),
        )
    ]


def times_surface(one: ProbeMap, first: Reading) -> Reading | None:
    """The product of a shape and a smooth surface, where it explains clearly more of the map than the shape alone."""
    (surface,) = smooth_in(strength_of(one, first), ENVELOPE)
    return product_in(one, first, surface)


def _surface_line(name: str, terms: str, one: ProbeMap, lowest: int) -> str:
    """The line of a file that makes a surface: coordinates run over -1 .. 1."""
    mean = "" if lowest else ", lowest=0"
    if one.place.spread == "pixels":
        stage = one.place.stage
        return f"    {name} = legendre_surface({terms}, {stage}.y, {stage}.x{mean})"
    return f"    {name} = legendre_surface({terms}, torch.clamp(y, -1, 1), torch.clamp(x, -1, 1){mean})"


def _surfaces(one: ProbeMap, order: int, lowest: int = 1) -> Array:
    y, x = one.grid
    half = (one.shape[0] / 2, one.shape[1] / 2) if one.place.spread == "pixels" else (1.0, 1.0)
    maps = np.asarray(legendre_maps(y[:, :1] / half[0], x[:1, :] / half[1], order, lowest))
    return maps.reshape(legendre_count(order, lowest), *one.values.shape)


def _powers(y: Array, x: Array, radius: float) -> Array:
    square = (y**2 + x**2) / radius**2
    return np.stack([square ** (k + 1) for k in range(POWERS)])


def _fitted(basis: Array, values: Array) -> tuple[list[float], Array]:
    """Least-squares terms of maps (and a constant), and the sum of the maps without it."""
    flat = basis.reshape(basis.shape[0], -1)
    centred = flat - flat.mean(axis=1, keepdims=True)
    normal = centred @ centred.T + 1e-12 * np.trace(centred @ centred.T) * np.eye(len(flat))
    terms = np.linalg.solve(normal, centred @ (values - values.mean()).reshape(-1))
    return [float(t) for t in terms], (terms @ flat).reshape(values.shape)


def _scale(unit: str, size: float) -> float:
    return 0.02 if unit != "counts" else float(f"{max(0.2 * size, 0.1):.2g}")


def _range(unit: str) -> tuple[float, float]:
    return (-1e4, 1e4) if unit == "counts" else (-20.0, 20.0)
