"""When an effect is worth adding, and when a model is complete.

With millions of pixels everything is significant, so a verdict asks two things: is the improvement real (a test on
held-out captures), and does it matter (an absolute least, or the floor that the captures themselves show).

The test: excess removed on held-out captures, two-sided normal interval over the picture's tiles, at a family-wise
`level` shared among all candidates tried (Bonferroni). Against noise alone, the chance that any effect's interval
lies above zero is at most half of `level`. A model's own small errors are not noise: where millions of pixels show
an iris's edge wrong by 1e-5 of the signal's variance, its interval does lie above zero. The least amounts prevent
that such an effect is named.

The floor: an excess is the difference of the squared error and the noise that is expected. Where repeated pictures
show another noise than is expected, nothing below that difference can be believed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from runtime.excess import PredictionErrors, RemovedExcess, is_complete
from trainer.captures.camera_noise import compare_repeats
from trainer.captures.camera_numbers import MEASURED_PAIRS, repeated_pairs
from trainer.captures.capture_set import CaptureSet

SURELY = 0.999  # confidence of the interval that lies below zero where there is less error than noise

Verdict = Literal["complete", "missing", "outside_catalogue"]


def verdict_of(complete: bool, worth_adding: bool) -> Verdict:
    """The three answers to "is something missing?".

    Parameters
    ----------
    complete : bool
        What remains is too little to explain.
    worth_adding : bool
        An effect of the catalogue is worth adding.
    """
    if complete:
        return "complete"
    return "missing" if worth_adding else "outside_catalogue"


def below_the_noise(errors: PredictionErrors) -> bool:
    """Whether a model errs by less than the camera's noise, which no model can: the noise is overstated."""
    return errors.interval(SURELY)[1] < 0


def noise_floor(captures: CaptureSet, errors: PredictionErrors) -> float:
    """Excess by which the noise that is expected may be wrong, as repeated pictures show it; 0 without repeats.

    Parameters
    ----------
    captures : CaptureSet
    errors : PredictionErrors
        Of any prediction of the captures that are judged: their expected noise over the signal's variance.
    """
    pairs = repeated_pairs(captures.captures)[:MEASURED_PAIRS]
    camera = captures.noise_camera()
    repeats = [compare_repeats(captures.counts(a), captures.counts(b), camera) for a, b in pairs]
    ratios = [r.ratio for r in repeats if r is not None and r.is_noise]
    if not ratios:
        return 0.0
    # The pair that fits best: more noise in another one may be real change between its pictures.
    off = min(abs(ratio - 1) for ratio in ratios)
    return off * errors.noise_nrmse**2


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the verdict.

    Attributes
    ----------
    level : float
        Family-wise level of the test.
    excess, share : float
        Least excess removed to be worth adding, absolute and as a share of the ideal model's.
    complete_excess, complete_share : float
        A model is complete below the larger of these, absolute and as a share of the ideal model's excess.
    floor : float
        Excess that the captures themselves cannot tell from nothing; no threshold is below it.
    pixel_noise : float
        Excess that the noise in the model's values by pixel leaves; it does not count as something to explain.
    """

    level: float = 0.05
    share: float = 0.0
    excess: float = 2e-4
    complete_share: float = 0.0
    complete_excess: float = 5e-4
    floor: float = 0.0
    pixel_noise: float = 0.0

    def as_json(self) -> dict[str, float]:
        """Keys `level`, `share`, `excess`, `complete_share`, `complete_excess`, `floor`, `pixel_noise`."""
        return asdict(self)

    def least(self, ideal_excess: float) -> float:
        """Excess that an effect must remove to be worth adding."""
        return max(self.share * ideal_excess, self.excess, self.floor)

    def worth_adding(self, removed: RemovedExcess, ideal_excess: float, candidates: int) -> bool:
        """Whether removed excess is real, and matters.

        Parameters
        ----------
        ideal_excess : float
            Held-out excess of the bench file's own model.
        candidates : int
            How many were tried, which the test is corrected for.
        """
        low, _ = removed.interval(1 - self.level, candidates)
        return low > 0 and removed.value > self.least(ideal_excess)

    def complete(self, excess: float, ideal_excess: float) -> bool:
        """Whether what remains is too little to explain."""
        least = max(self.complete_excess, self.floor)
        return is_complete(excess - self.pixel_noise, ideal_excess, self.complete_share, least)

    def may_be_worth_adding(self, excess: float, ideal_excess: float) -> bool:
        """Whether enough remains for any effect to be worth adding."""
        return excess - self.pixel_noise > self.least(ideal_excess)

    def inseparable(self, difference: RemovedExcess, unexplained: float, most: float) -> bool:
        """Whether the data cannot tell two explanations apart.

        They cannot when the interval of the difference includes zero, or when the difference is small: below `excess`,
        or below half of what the better one leaves unexplained. What it leaves is how wrong the shape of either may
        be. While other effects are missing it leaves much, so there is a limit of its own.

        Parameters
        ----------
        difference : RemovedExcess
            Excess that the better one removes from the other.
        unexplained : float
            Excess that the better one leaves.
        most : float
            Difference that is never small, a share of what the better one removes.
        """
        low, _ = difference.interval(1 - self.level)
        return low <= 0 or difference.value < max(self.excess, min(0.5 * unexplained, most))
