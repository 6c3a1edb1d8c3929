"""Colours of the page's pictures and plots: perceptually uniform, and safe for colour-blind readers.

Light is viridis and errors are cividis, as in reports. Differences go through white at zero, from blue to orange, with
equal steps of lightness on both sides.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import matplotlib
import numpy as np
from bokeh.themes import Theme

LEVELS = 255
MISSING = "#8a8a8a"
LIGHT = {
    "ink": "#1b1f24", "quiet": "#5c646e", "line": "#dfe3e8", "paper": "#ffffff",
    "main": "#0b6bb5", "other": "#c2540a", "third": "#00806a",
}  # fmt: skip
DARK = {
    "ink": "#e7eaee", "quiet": "#9aa4b0", "line": "#333a43", "paper": "#14171b",
    "main": "#5fb2f2", "other": "#f0954a", "third": "#3fcfae",
}  # fmt: skip


@lru_cache
def irradiance_palette() -> tuple[str, ...]:
    """From dark to bright."""
    return _named("viridis")


@lru_cache
def error_palette() -> tuple[str, ...]:
    """From no error to the largest."""
    return _named("cividis")


@lru_cache
def difference_palette() -> tuple[str, ...]:
    """From negative (blue) through zero (white) to positive (orange)."""
    half = LEVELS // 2
    depth = np.linspace(1, 0, half + 1)
    below = _oklab(0.97 - 0.57 * depth, 0.145 * np.sin(np.pi * depth**0.9 * 0.75), 255.0)
    above = _oklab(0.97 - 0.57 * depth, 0.145 * np.sin(np.pi * depth**0.9 * 0.75), 50.0)
    return (*below, *above[::-1][1:])


def figure_theme(dark: bool) -> Theme:
    """Bokeh's theme of the light or of the dark page."""
    c = DARK if dark else LIGHT
    axis: dict[str, Any] = {
        "axis_line_color": c["quiet"], "major_tick_line_color": c["quiet"], "minor_tick_line_color": None,
        "major_label_text_color": c["ink"], "axis_label_text_color": c["ink"], "major_label_text_font_size": "11px",
        "axis_label_text_font_size": "12px", "axis_label_text_font_style": "normal", "axis_label_standoff": 4,
        "major_label_text_font": "system-ui, sans-serif", "axis_label_text_font": "system-ui, sans-serif",
    }  # fmt: skip
    return Theme(
        json={
            "attrs": {
                "Plot": {"background_fill_color": None, "border_fill_color": None, "outline_line_color": c["line"]},
                "Axis": axis,
                "Grid": {"grid_line_color": c["line"], "grid_line_alpha": 0.8},
                "Title": {"text_color": c["ink"], "text_font_size": "13px", "text_font": "system-ui, sans-serif"},
                "Legend": {
                    "background_fill_alpha": 0.0, "border_line_color": None, "label_text_color": c["ink"],
                    "label_text_font_size": "11px", "padding": 2, "margin": 2, "spacing": 0, "glyph_width": 16,
                    "label_text_font": "system-ui, sans-serif",
                },
                "ColorBar": {
                    "background_fill_color": None, "major_label_text_color": c["ink"], "title_text_color": c["ink"],
                    "bar_line_color": None, "major_tick_line_color": None, "major_label_text_font_size": "11px",
                    "title_text_font_size": "11px", "title_text_font_style": "normal", "padding": 2,
                    "major_label_text_font": "system-ui, sans-serif", "title_text_font": "system-ui, sans-serif",
                },
                "Span": {"line_color": c["other"]},
            }
        }
    )  # fmt: skip


def line_colours(dark: bool) -> dict[str, str]:
    """Colours of curves by name: main, other, third, quiet, ink, line, paper."""
    return DARK if dark else LIGHT


def _named(name: str) -> tuple[str, ...]:
    stops = matplotlib.colormaps[name](np.linspace(0, 1, LEVELS))[:, :3]
    return tuple("#" + "".join(f"{round(255 * v):02x}" for v in stop) for stop in stops)


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
