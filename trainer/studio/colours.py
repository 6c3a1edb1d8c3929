"""Colours of the page's plots, light and dark; those of pictures are the reports'."""

from __future__ import annotations

from typing import Any

from bokeh.themes import Theme

LIGHT = {
    "ink": "#1b1f24", "quiet": "#5c646e", "line": "#dfe3e8", "paper": "#ffffff",
    "main": "#0b6bb5", "other": "#c2540a", "third": "#00806a",
}  # fmt: skip
DARK = {
    "ink": "#e7eaee", "quiet": "#9aa4b0", "line": "#333a43", "paper": "#14171b",
    "main": "#5fb2f2", "other": "#f0954a", "third": "#3fcfae",
}  # fmt: skip


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
