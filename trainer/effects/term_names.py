"""Names of a map's or a curve's numbers, for people: which Legendre or Zernike polynomial each one belongs to."""

from __future__ import annotations

from runtime.lightpath.legendre import legendre_products
from trainer.effects.zernike import zernike_indices

_DIGITS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_ZERNIKE = {
    (2, -2): "astigmatism 45°",
    (2, 2): "astigmatism 0°",
    (3, -3): "trefoil y",
    (3, -1): "coma y",
    (3, 1): "coma x",
    (3, 3): "trefoil x",
    (4, -4): "tetrafoil 22.5°",
    (4, -2): "2nd astigmatism 45°",
    (4, 0): "spherical",
    (4, 2): "2nd astigmatism 0°",
    (4, 4): "tetrafoil 0°",
}


def curve_terms(order: int) -> tuple[str, ...]:
    """Names of a Legendre curve's numbers."""
    return tuple(_legendre(n) for n in range(order))


def bent_curve_terms(order: int) -> tuple[str, ...]:
    """Names of the numbers of a Legendre curve without its mean."""
    return tuple(_legendre(n + 1) for n in range(order))


def driver_terms(order: int) -> tuple[str, ...]:
    """Names of the numbers of a step that repeats every 2, 3 and 4 lines."""
    return "every 2", "every 3, cosine", "every 3, sine", "every 4, cosine", "every 4, sine"


def surface_terms(order: int) -> tuple[str, ...]:
    """Names of the numbers of a Legendre surface without its mean."""
    return tuple(_product(i, j) for i, j in legendre_products(order))


def surface_terms_with_mean(order: int) -> tuple[str, ...]:
    """Names of the numbers of a Legendre surface, its mean first."""
    return tuple(_product(i, j) for i, j in legendre_products(order, 0))


def distortion_terms(order: int) -> tuple[str, ...]:
    """Names of a field of displacements: rows first, then columns, each without its first term."""
    terms = surface_terms(order)[1:]
    return (*(f"rows {t}" for t in terms), *(f"columns {t}" for t in terms))


def aberration_terms(order: int) -> tuple[str, ...]:
    """Names of Zernike terms up to n = `order`, without tilt and defocus."""
    return tuple(
        _ZERNIKE.get((n, m), f"Z({n}, {m})") for n, m in zernike_indices(order, without_defocus=True)
    )


def _legendre(n: int) -> str:
    return "P" + str(n).translate(_DIGITS)


def _product(i: int, j: int) -> str:
    factors = [f"{_legendre(n)}({axis})" for n, axis in ((i, "y"), (j, "x")) if n]
    return " ".join(factors) or "mean"
