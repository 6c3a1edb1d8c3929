"""A slider and a number field for one value, which carry their name for screen readers and work from the keyboard."""

from __future__ import annotations

from typing import ClassVar

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
        Of the slider and of the field. The browser keeps the two the same, and a number that is typed in the range.
    """

    label = param.String(default="value")
    about = param.String(default="")
    low = param.Number(default=0.0)
    high = param.Number(default=1.0)
    step = param.Number(default=0.01)
    value = param.Number(default=0.0)

    _template = """
    <div id="box" class="labelled-slider" title="{{ about }}">
      <span id="name" class="name">{{ label }}</span>
      <input id="number" class="number" type="number" min="${low}" max="${high}" step="any"
             onchange="${script('typed')}" aria-label="{{ label }}, as a number"/>
      <input id="range" class="range" type="range" min="${low}" max="${high}" step="${step}"
             oninput="${script('moved')}" aria-label="{{ label }}"/>
    </div>
    """
    _scripts: ClassVar[dict[str, str]] = {
        "render": "number.value = range.value = data.value",
        "value": "number.value = range.value = data.value",
        "moved": "data.value = Number(range.value)",
        "typed": "data.value = Math.min(Math.max(number.value, data.low), data.high); number.value = data.value",
    }
    _priority_changes: ClassVar[list[str]] = ["value"]  # handled at once, not after panel's 50 ms
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
