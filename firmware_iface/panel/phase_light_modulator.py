"""TI's phase light modulators: 16 mirror heights, and the four memory bits under each mirror that set them.

Facts of TI's device tables as published with its open `ti-plm` package (1.1): how far each state moves the
mirror, which bits hold it, and where these lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.panel.panel import Gray

# displacement of state 0..15 over that of state 15; state 15 is 15/16 of a wave
_LOWER = (0, 0.0126, 0.0259, 0.0495, 0.071, 0.0878, 0.1382, 0.2153)
_UPPER = (0.3274, 0.361, 0.4204, 0.5046, 0.5916, 0.673, 0.8254, 1)
DISPLACEMENT = _LOWER + _UPPER
# memory bits of each state
MEMORY = (3, 2, 1, 7, 0, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12)


@dataclass(frozen=True)
class Modulator:
    """One kind of modulator.

    Attributes
    ----------
    shape : (int, int)
        (H, W), mirrors.
    electrodes : ((int, int), (int, int))
        Which memory bit lies where under a mirror.
    mirrored : bool
        Whether the memory's columns run the other way.
    controllers : int
        1, or 2 where a second one has the right half.
    """

    shape: tuple[int, int]
    electrodes: tuple[tuple[int, int], tuple[int, int]]
    mirrored: bool = False
    controllers: int = 1

    @property
    def memory_shape(self) -> tuple[int, int]:
        """(rows, columns) of bits."""
        return 2 * self.shape[0], 2 * self.shape[1]


P47 = Modulator((540, 960), ((2, 3), (0, 1)))
P67 = Modulator((800, 1280), ((1, 3), (0, 2)), mirrored=True, controllers=2)


def phase_waves() -> NDArray[np.float64]:
    """Phase of each state, waves, [16]."""
    return np.array(DISPLACEMENT) * 15 / 16


def gray_levels() -> list[int]:
    """The gray level nearest to each state: `gray_levels` in [panel] of bench.toml, so that solvers see them."""
    return [round(256 * waves) for waves in phase_waves().tolist()]


def states(gray: Gray) -> NDArray[np.uint8]:
    """The state, 0 to 15, whose phase is nearest on the circle to gray / 256 of a wave."""
    requested = np.arange(256)[:, None] / 256
    apart = np.abs(requested - phase_waves())
    nearest = np.minimum(apart, 1 - apart).argmin(1).astype(np.uint8)
    return nearest[gray]


def bit_plane(gray: Gray, modulator: Modulator) -> NDArray[np.uint8]:
    """The memory's bits, 0 or 1, [2 H, 2 W], that show gray levels [H, W]."""
    return bit_planes([gray], modulator)


def bit_planes(grays: Sequence[Gray], modulator: Modulator) -> NDArray[np.uint8]:
    """The memory's bits of up to eight patterns [H, W], those of pattern k as bit k, uint8 [2 H, 2 W]."""
    memory = np.array(MEMORY, np.uint8)[states(np.arange(256, dtype=np.uint8))]
    corners = memory[:, None] >> np.array(modulator.electrodes, np.uint8).ravel() & 1
    four = corners.view(np.uint32)[:, 0]  # a byte each, so that all are looked up at once
    height, width = grays[0].shape
    together = np.zeros((height, width), np.uint32)
    for k, gray in enumerate(grays):
        together |= np.take(four << np.uint32(k), gray)
    plane = together.view(np.uint8).reshape(height, width, 2, 2).swapaxes(1, 2).reshape(2 * height, 2 * width)
    return np.ascontiguousarray(plane[:, ::-1] if modulator.mirrored else plane)
