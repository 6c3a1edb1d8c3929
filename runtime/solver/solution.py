"""What a solve returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from runtime.solver.quality import Quality


@dataclass
class Solution:
    """Patterns for the colours of one picture; one colour has no axis of its own.

    Both arrays belong to the solver: its second next solve writes `gray` again, its next solve writes `phase` again.

    Attributes
    ----------
    gray : uint8 array [C, H, W] or [H, W]
        Gray levels to send to the panel.
    phase : float array [C, H, W] or [H, W], rad
        What was asked of the panel, before rounding.
    psnr_db : tuple of float, dB
        Amplitude PSNR before rounding, at the start and after each iteration, on the solver's own grid.
    milliseconds : float, ms
        From the target to the gray levels.
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
        """The pattern's PSNR on the solver's own grid, known at once: the best of `psnr_db`."""
        return max(self.psnr_db)

    @cached_property
    def qualities(self) -> tuple[Quality, ...]:
        """Of the gray levels, through the whole padded light path on the fine grid, a colour and plane each.

        Computed when first asked for.

        Raises
        ------
        InputError
            Where the arrays have been written again by then.
        """
        return self._judge()

    @property
    def quality(self) -> Quality:
        """The first of `qualities`: the only one where there is one colour and plane."""
        return self.qualities[0]
