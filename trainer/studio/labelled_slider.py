"""A slider and a number field for one value, which carry their name for screen readers and work from the keyboard."""

from __future__ import annotations

from typing import Any, ClassVar

import param
from panel.reactive import ReactiveHTML


class LabelledSlider(ReactiveHTML):
    """A native slider with its name, and its value as a field to type in.

    Attributes
    ----------
    label, about : str
        The name that is shown and spoken, and what a pointer over it shows.
    low, high, step : float
        Range, and the change of one key press.
    value : float
        Of the slider.
    typed : float
        Of the field; follows the slider, and moves it when it is changed.
    """

    label = param.String(default="value")
    about = param.String(default="")
    low = param.Number(default=0.0)
    high = param.Number(default=1.0)
    step = param.Number(default=0.01)
    value = param.Number(default=0.0)
    typed = param.Number(default=0.0)

    _template = """
    <div id="box" class="labelled-slider" title="{{ about }}">
      <span id="name" class="name">{{ label }}</span>
      <input id="number" class="number" type="number" min="${low}" max="${high}" step="any"
             value="${typed}" aria-label="{{ label }}, as a number"/>
      <input id="range" class="range" type="range" min="${low}" max="${high}" step="${step}"
             value="${value}" aria-label="{{ label }}"/>
    </div>
    """
    _priority_changes: ClassVar[list[str]] = ["value", "typed"]  # handled at once, not after panel's 50 ms
    _dom_events: ClassVar[dict[str, list[str]]] = {"range": ["input"], "number": ["change"]}
    _stylesheets: ClassVar[list[str]] = [
        """
        .labelled-slider { display: grid; grid-template-columns: 1fr 5.4em; align-items: center; gap: 1px 8px; }
        .name { overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
        .number { grid-row: 1; grid-column: 2; width: 100%; box-sizing: border-box; text-align: right; font: inherit;
          font-variant-numeric: tabular-nums; color: inherit; background: transparent; padding: 1px 4px;
          border: 1px solid color-mix(in srgb, currentColor 30%, transparent); border-radius: 4px;
          appearance: textfield; }
        .number::-webkit-inner-spin-button { display: none; }
        .range { grid-column: 1 / -1; width: 100%; margin: 0; height: 20px; appearance: none; background: transparent;
          cursor: pointer; }
        .range::-webkit-slider-runnable-track { height: 4px; border-radius: 2px;
          background: color-mix(in srgb, currentColor 30%, transparent); }
        .range::-moz-range-track { height: 4px; border-radius: 2px;
          background: color-mix(in srgb, currentColor 30%, transparent); }
        .range::-webkit-slider-thumb { appearance: none; width: 16px; height: 16px; margin-top: -6px;
          border-radius: 50%; background: var(--accent, #2f7fbf); }
        .range::-moz-range-thumb { width: 16px; height: 16px; border: 0; border-radius: 50%;
          background: var(--accent, #2f7fbf); }
        input:focus-visible { outline: 2px solid var(--accent, #2f7fbf); outline-offset: 1px; }
        """
    ]

    def __init__(self, **params: Any) -> None:
        super().__init__(**{"typed": params.get("value", 0.0), **params})

    @param.depends("value", watch=True)
    def _follow(self) -> None:
        self.typed = self.value

    @param.depends("typed", watch=True)
    def _move(self) -> None:
        """Take the field's number, as far as it is in the range."""
        self.value = self.typed = min(max(self.typed, self.low), self.high)
