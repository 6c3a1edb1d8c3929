"""Colours of pictures: perceptually uniform, and safe for colour-blind readers.

Light is viridis, errors are cividis. Differences go through white at zero, from blue to orange, with equal steps of
lightness on both sides.
"""

from __future__ import annotations

from functools import lru_cache

import matplotlib
import numpy as np

IRRADIANCE, ERROR, DIFFERENCE = "viridis", "cividis", "difference"
LEVELS = 255
MISSING = "#808080"  # nothing was measured
BAR = 9  # stops of a colour bar


@lru_cache
def palette(name: str) -> tuple[str, ...]:
    """The colours of IRRADIANCE, ERROR, DIFFERENCE or of any map of matplotlib, from its low end to its high one."""
    if name == DIFFERENCE:
        return _differences()
    stops = matplotlib.colormaps[name](np.linspace(0, 1, LEVELS))[:, :3]
    return tuple("#" + "".join(f"{round(255 * v):02x}" for v in stop) for stop in stops)


def gradient(name: str) -> str:
    """The stops of a colour bar, for CSS."""
    colours = palette(name)
    return ", ".join(colours[round(k * (len(colours) - 1) / (BAR - 1))] for k in range(BAR))


def _differences() -> tuple[str, ...]:
    half = LEVELS // 2
    depth = np.linspace(1, 0, half + 1)
    below = _oklab(0.97 - 0.57 * depth, 0.145 * np.sin(np.pi * depth**0.9 * 0.75), 255.0)
    above = _oklab(0.97 - 0.57 * depth, 0.145 * np.sin(np.pi * depth**0.9 * 0.75), 50.0)
    return (*below, *above[::-1][1:])


def _oklab(lightness: np.ndarray, chroma: np.ndarray, hue_deg: float) -> list[str]:
    """sRGB of colours in Oklab's cylinder (Ottosson 2020), held to what a screen shows."""
    a, b = chroma * np.cos(np.radians(hue_deg)), chroma * np.sin(np.radians(hue_deg))
    cone = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    matrix = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    linear = np.clip(matrix @ cone**3, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return ["#" + "".join(f"{round(255 * v):02x}" for v in colour) for colour in encoded.T]
