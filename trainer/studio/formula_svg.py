"""A LaTeX formula as SVG in the page itself: no script, no font and nothing from the internet; text's own colour."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
from markupsafe import Markup, escape
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import TextPath

SIZE = 20.0  # units of the drawing for one em
MARGIN = 0.1  # em
_LETTERS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C", Path.CLOSEPOLY: "Z"}
_SIZED = re.compile(r"\\[bB]igg?([lr])(?![a-z])")


@lru_cache(maxsize=256)
def formula_svg(latex: str) -> Markup:
    """A formula as an <svg> element whose size is in em; its source as code where matplotlib cannot set it.

    Parameters
    ----------
    latex : str
        Without dollar signs.
    """
    try:
        drawn = TextPath(
            (0, 0),
            f"${_SIZED.sub(_stretched, latex)}$",
            size=SIZE,
            prop=FontProperties(math_fontfamily="stix"),
        )
    except ValueError:
        return Markup("<code>{}</code>").format(latex)
    box = drawn.get_extents().padded(MARGIN * SIZE)
    steps = " ".join(
        _LETTERS[code] + ("" if code == Path.CLOSEPOLY else " ".join(f"{v:.2f}" for v in np.asarray(points)))
        for points, code in drawn.iter_segments(simplify=False, curves=True)
    )
    return Markup(
        f'<svg role="img" aria-label="Formula: {escape(latex)}" class="formula" '
        f'style="width:{box.width / SIZE:.2f}em;max-width:100%;height:auto" '
        f'viewBox="{box.x0:.2f} {-box.y1:.2f} {box.width:.2f} {box.height:.2f}">'
        f'<path fill="currentColor" transform="scale(1 -1)" d="{steps}"/></svg>'
    )


def _stretched(bracket: re.Match[str]) -> str:
    """A bracket of a stated size as one that stretches, which is all that matplotlib knows."""
    return r"\left" if bracket[1] == "l" else r"\right"
