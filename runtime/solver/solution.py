"""What a solve gives back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from runtime.solver.quality import Quality


@dataclass
class Solution:
    """Patterns for the colours of one picture; one colour has no axis of its own.

    gray: uint8 [C, H, W] or [H, W]. phase: what was asked of the panel before rounding, rad. psnr_db: amplitude PSNR
    before rounding, at the start and after each iteration, on the solver's own grid. milliseconds: from the
    target to the gray levels. Both arrays are the solver's own: `gray` is written again by its second next
    solve, `phase` by the next.
    """

    gray: np.ndarray
    phase: np.ndarray
    psnr_db: tuple[float, ...]
    milliseconds: float
    _judge: Callable[[], tuple[Quality, ...]] = field(repr=False)

    @property
    def iterations(self) -> int:
        """Steps that were made."""
        return len(self.psnr_db) - 1

    @property
    def expected_psnr_db(self) -> float:
        """The pattern's error as the solver saw it, known at once: the best of `psnr_db`."""
        return max(self.psnr_db)

    @cached_property
    def qualities(self) -> tuple[Quality, ...]:
        """Of the gray levels, through the whole padded light path on the fine grid, a colour and plane each.

        Computed when first asked for. Raises InputError where the arrays have been written again by then.
        """
        return self._judge()

    @property
    def quality(self) -> Quality:
        """The first of `qualities`: the only one where there is one colour and plane."""
        return self.qualities[0]
