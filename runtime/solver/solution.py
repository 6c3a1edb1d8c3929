"""What a solve returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from runtime.solver.quality import Quality


@dataclass
class Solution:
    """Patterns for the colours and frames of one picture; one colour and one frame have no axis of their own.

    Both arrays belong to the solver: its second next solve writes `gray` again, its next solve writes `phase` again.

    Attributes
    ----------
    gray : uint8 array [C, N, H, W], [C, H, W], [N, H, W] or [H, W]
        Gray levels to send to the panel.
    psnr_db : tuple of float, dB
        Amplitude PSNR before rounding, at the start and after each iteration, on the solver's own grid. Where the
        panel's few levels are in the loop, of phases that are rounded ever more sharply.
    expected_psnr_db : float, dB
        The pattern's PSNR on the solver's own grid, known at once: the best of `psnr_db`, or, with few levels in the
        loop, that of the gray levels.
    milliseconds : float, ms
        From the target to the gray levels.
    given : tuple of float
        Irradiance that a target of 1 gets, for each colour, as `expected_psnr_db` is known: the light of a dark picture
        goes where it is not wanted, too. Colours in turn are right where each has light for a time in proportion to
        1 / given.
    """

    gray: np.ndarray
    psnr_db: tuple[float, ...]
    expected_psnr_db: float
    milliseconds: float
    given: tuple[float, ...]
    _phase: Callable[[], np.ndarray] = field(repr=False)
    _judge: Callable[[], tuple[Quality, ...]] = field(repr=False)

    @property
    def iterations(self) -> int:
        """Steps that were made."""
        return len(self.psnr_db) - 1

    @cached_property
    def phase(self) -> np.ndarray:
        """What was asked of the panel, before rounding: float, of the shape of `gray`, rad.

        From a GPU it is copied when first asked for, which is before the next solve.
        """
        return self._phase()

    @cached_property
    def qualities(self) -> tuple[Quality, ...]:
        """Of the gray levels, through the whole padded light path on the fine grid, a colour and plane each.

        Of several frames, of the mean of their irradiances. Computed when first asked for.

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
