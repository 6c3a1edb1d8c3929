"""Pictures made small: means over blocks of pixels."""

from __future__ import annotations

import numpy as np


def blocks(array: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks of factor x factor pixels, without NaN; what is left at the border is cut off."""
    if factor <= 1:
        return array
    height, width = (n // factor * factor for n in array.shape)
    parts = array[:height, :width].reshape(height // factor, factor, width // factor, factor)
    finite = np.isfinite(parts)
    count = finite.sum((1, 3))
    total = np.where(finite, parts, 0).sum((1, 3), dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
