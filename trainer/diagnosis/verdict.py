"""When an effect is worth adding, and when a model is complete.

With millions of pixels everything is significant, so a verdict asks two things: is the improvement real (a test on
held-out captures), and does it matter (a share of the ideal model's excess, and an absolute least).

The test: excess removed on held-out captures, two-sided normal interval over the picture's tiles, at a family-wise
`level` shared among all candidates tried (Bonferroni). Against noise alone, the chance that any effect's interval
lies above zero is at most half of `level`. A model's own small errors are no noise: where millions of pixels show
an iris's edge wrong by 1e-5 of the signal's variance, its interval does lie above zero. That such an effect is not
named is the work of the least amounts.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

from trainer.fitting.excess import Removed


@dataclass(frozen=True)
class Thresholds:
    """level : family-wise level of the test
    share, excess : least excess removed to be worth adding, as a share of the ideal model's and absolute
    complete_share, complete_excess : a model is complete below the larger of these
    """

    level: float = 0.05
    share: float = 0.02
    excess: float = 1e-4
    complete_share: float = 0.02
    complete_excess: float = 3e-4

    def as_json(self) -> dict[str, float]:
        """For reports."""
        return asdict(self)

    def least(self, ideal_excess: float) -> float:
        """Excess that an effect must remove to be worth adding."""
        return max(self.share * ideal_excess, self.excess)

    def worth_adding(self, gone: Removed, ideal_excess: float, candidates: int) -> bool:
        """Is it real, and does it matter?"""
        low, _ = gone.interval(1 - self.level, candidates)
        return low > 0 and gone.value > self.least(ideal_excess)

    def complete(self, excess: float, ideal_excess: float) -> bool:
        """Is what remains too little to explain?"""
        return excess < max(self.complete_share * ideal_excess, self.complete_excess)

    def inseparable(self, difference: Removed, unexplained: float) -> bool:
        """Can the data not tell two explanations apart?

        So it is when the interval of their difference holds zero, or when the difference is small: below `excess`, or
        below a fifth of what the better one leaves `unexplained`, which is how wrong its own shape may be.
        """
        low, _ = difference.interval(1 - self.level)
        return low <= 0 or difference.value < max(self.excess, 0.2 * unexplained)
