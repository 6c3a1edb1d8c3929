"""When a refit replaces a headset's light path: the rule, and its thresholds."""

from __future__ import annotations

from typing import Literal

from runtime.excess import PredictionErrors, RemovedExcess, removed_excess

LEAST_SHARE = 0.5  # of the excess added since the light path was made: a refit must remove more
LEAST_EXCESS = 0.0001  # and more than this
WRONG_EXCESS = 0.001  # above it a light path does not fit: an error of 3 % of the contrast

Verdict = Literal["recalibrated", "unchanged", "not_explained"]


def is_certain(removed: RemovedExcess) -> bool:
    """Whether the interval of what a refit removes lies above zero."""
    return removed.interval()[0] > 0


def replacement_verdict(before: PredictionErrors, after: PredictionErrors, known: float = 0.0) -> Verdict:
    """What is to be done with a refit.

    Parameters
    ----------
    before, after : PredictionErrors
        Of the light path that was there and of the refit, on the same held-out captures.
    known : float
        The excess that the light path had when it was made.

    Returns
    -------
    str
        "recalibrated": the refit certainly predicts better than the light path that was there, and removes most of the
        excess that has come since. A refit that explains less would only bend parameters towards something else that
        is wrong. "unchanged": what was there predicts about as well as when it was made. "not_explained": it is wrong,
        and the refit does not correct it.
    """
    removed = removed_excess(before, after)
    if is_certain(removed) and removed.value > max(LEAST_SHARE * (before.excess - known), LEAST_EXCESS):
        return "recalibrated"
    return "unchanged" if before.excess < max(WRONG_EXCESS, 2 * known) else "not_explained"
