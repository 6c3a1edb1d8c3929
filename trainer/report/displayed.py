"""What a display shows before and after it was calibrated, as a section of a report."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from PIL import Image

from runtime.solver import Quality
from runtime.solver.targets import encode_srgb

TITLES = {
    "before": "Pattern for the ideal model",
    "after": "Pattern for the explained model",
    "oracle": "Pattern by who knows the true bench",
}


@dataclass(frozen=True)
class Shown:
    """A picture as a camera saw it with several patterns: target and lights [H, W], and quality."""

    name: str
    target: np.ndarray
    lights: Mapping[str, np.ndarray]
    qualities: Mapping[str, Quality]


def with_display(html: str, shown: Sequence[Shown], sentence: str) -> str:
    """A report's page with the pictures of a display added at the end of its main part."""
    section = display_section(shown, sentence)
    head, found, tail = html.rpartition("</main>")
    if not found:
        return html + section
    return f"{head}{section}\n{found}{tail}"


def display_section(shown: Sequence[Shown], sentence: str) -> str:
    """The section: for each picture the target and what the camera saw, all at the scale that fits best."""
    rows = [_row(one) for one in shown]
    return (
        "<section>\n<h2>What the display shows</h2>\n"
        f"<p>{escape(sentence)}</p>\n"
        '<p class="quiet">Camera pictures, each scaled to the target by one factor. PSNR is of amplitude, '
        "nrmse the root mean squared error of irradiance over the target's standard deviation.</p>\n"
        + "\n".join(rows)
        + "\n</section>"
    )


def _row(one: Shown) -> str:
    figures = [_figure("Target", one.target, one.target, "")]
    for which, light in one.lights.items():
        q = one.qualities[which]
        note = f"{q.psnr_db:.1f} dB, nrmse {q.nrmse:.3f}"
        figures.append(_figure(TITLES.get(which, which), light / max(q.scale, 1e-30), one.target, note))
    columns = "display:grid;grid-template-columns:repeat(auto-fit,minmax(14rem,1fr));gap:1rem;margin:1rem 0"
    return f'<div style="{columns}">{"".join(figures)}</div>'


def _figure(title: str, light: np.ndarray, target: np.ndarray, note: str) -> str:
    white = max(float(np.percentile(target, 99.8)), 1e-12)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * encode_srgb(light / white)).astype(np.uint8)).save(buffer, format="PNG")
    data = base64.b64encode(buffer.getvalue()).decode()
    words = escape(f"{title}: {note}" if note else title)
    return (
        f'<figure><b>{escape(title)}</b><img style="width:100%" alt="{words}" '
        f'src="data:image/png;base64,{data}"><figcaption class="quiet">{escape(note)}</figcaption></figure>'
    )
