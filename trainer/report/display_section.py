"""A report's section on the display: camera pictures before and after calibration, next to the target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from PIL import Image

from runtime.solver import Quality
from runtime.solver.picture_files import encode_srgb, white_of
from trainer.captures.block_means import blocks
from trainer.report.png_uri import png_uri

LARGEST = 960  # pixels: side above which a picture shows means of blocks, as pages hold it
TITLES = {
    "before": "Pattern for the ideal model",
    "after": "Pattern for the explained model",
    "oracle": "Pattern with the true bench known",
}


@dataclass(frozen=True)
class DisplayedPicture:
    """The camera's pictures of one target, shown with several patterns.

    Attributes
    ----------
    name : str
        Of the target.
    target : array [H, W] or [C, H, W]
        Irradiance of one colour, or of red, green and blue.
    lights : mapping of str to array of the same kind
        The camera's picture of each pattern.
    qualities : mapping of str to Quality
        Of each pattern.
    channels : mapping of str to mapping of str to Quality
        Of each colour of each pattern, where there are several.
    """

    name: str
    target: np.ndarray
    lights: Mapping[str, np.ndarray]
    qualities: Mapping[str, Quality]
    channels: Mapping[str, Mapping[str, Quality]] = field(default_factory=dict)


def with_display(html: str, pictures: Sequence[DisplayedPicture], sentence: str) -> str:
    """A report's page with the display's section added at the end of its main part."""
    section = display_section(pictures, sentence)
    head, found, tail = html.rpartition("</main>")
    if not found:
        return html + section
    return f"{head}{section}\n{found}{tail}"


def display_section(pictures: Sequence[DisplayedPicture], sentence: str) -> str:
    """The section: for each picture the target and the camera's pictures, each at the scale that fits best."""
    rows = [_row(one) for one in pictures]
    return (
        "<section>\n<h2>What the display shows</h2>\n"
        f"<p>{escape(sentence)}</p>\n"
        '<p class="quiet">Camera pictures, each scaled to the target by one factor. PSNR is of amplitude, '
        "nrmse the root mean squared error of irradiance over the target's standard deviation.</p>\n"
        + "\n".join(rows)
        + "\n</section>"
    )


def srgb_picture(light: np.ndarray) -> Image.Image:
    """Irradiance [H, W] or [C, H, W], 1 is white, as an sRGB picture, gray for one colour."""
    levels = np.rint(255 * encode_srgb(light)).astype(np.uint8)
    if levels.ndim == 2 or len(levels) == 1:
        return Image.fromarray(levels.reshape(levels.shape[-2:]))
    return Image.fromarray(np.moveaxis(levels, 0, -1))


def _row(one: DisplayedPicture) -> str:
    figures = [_figure("Target", one.target, one.target, "")]
    for which, light in one.lights.items():
        q = one.qualities[which]
        note = f"{q.psnr_db:.1f} dB, nrmse {q.nrmse:.3f}"
        if which in one.channels:
            each = ", ".join(f"{c} {of.psnr_db:.1f}" for c, of in one.channels[which].items())
            note = f"{note} ({each} dB)"
        figures.append(_figure(TITLES.get(which, which), light / max(q.scale, 1e-30), one.target, note))
    columns = "display:grid;grid-template-columns:repeat(auto-fit,minmax(14rem,1fr));gap:1rem;margin:1rem 0"
    return f'<div style="{columns}">{"".join(figures)}</div>'


def _figure(title: str, light: np.ndarray, target: np.ndarray, note: str) -> str:
    white = white_of(target)
    factor = -(-max(light.shape[-2:]) // LARGEST)
    if factor > 1:
        light = np.stack([blocks(one, factor) for one in light.reshape(-1, *light.shape[-2:])])
        note = "; ".join(filter(None, (note, f"each point is the mean of {factor} × {factor} pixels")))
    picture = srgb_picture(light / white)
    words = escape(f"{title}: {note}" if note else title)
    return (
        f'<figure><b>{escape(title)}</b><img style="width:100%" alt="{words}" '
        f'src="{png_uri(picture)}"><figcaption class="quiet">{escape(note)}</figcaption></figure>'
    )
