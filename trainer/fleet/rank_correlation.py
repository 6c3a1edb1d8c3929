"""Spearman's rank correlation, with its interval."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from scipy.stats import rankdata

CONFIDENCE = 0.95  # of an interval where nothing else is said

Array = np.ndarray


def spearman(first: Array, second: Array) -> float:
    """Spearman's rank correlation of two arrays [n]; 0 where one of them does not vary."""
    ranks = [rankdata(a) - (len(a) + 1) / 2 for a in (first, second)]
    size = math.sqrt(float((ranks[0] ** 2).sum() * (ranks[1] ** 2).sum()))
    return float((ranks[0] * ranks[1]).sum()) / size if size > 0 else 0.0


def interval(r: float, count: int, confidence: float = CONFIDENCE, tried: int = 1) -> tuple[float, float]:
    """Two-sided interval of a rank correlation.

    Parameters
    ----------
    r : float
    count : int
        Pairs of values, more than 3.
    tried : int
        Correlations that were looked at, for Bonferroni's correction.

    References
    ----------
    Bonett and Wright 2000.
    """
    most = 1 - 1 / count**2  # few ranks can be in perfect order by chance
    z = math.atanh(min(max(r, -most), most))
    width = NormalDist().inv_cdf(1 - (1 - confidence) / (2 * tried)) * math.sqrt((1 + r**2 / 2) / (count - 3))
    return math.tanh(z - width), math.tanh(z + width)
