"""The report of a calibration: one HTML file with its pictures inside, made with Pillow and plain SVG.

The headset has no matplotlib and needs none: maps are small PNG pictures with a colour scale, curves are SVG.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from runtime.bundle.whole_files import whole_file
from runtime.calibration.response import Sweep
from runtime.calibration.self_calibration import Calibration
from runtime.calibration.shown_patterns import proof_picture
from runtime.calibration.summary import numbers, sentence_of
from runtime.solver.picture_files import encode_srgb, white_of

WIDTH = 320  # of a picture, screen pixels
BLUE, WHITE, RED = (33, 102, 172), (247, 247, 247), (178, 24, 43)

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 66rem; margin: 2rem auto; padding: 0 1rem; }
.verdict { font-size: 1.2rem; border-left: 0.4rem solid; padding: 0.5rem 1rem; }
.recalibrated, .unchanged { border-color: #00806a; } .not_explained { border-color: #a8235a; }
.row { display: flex; flex-wrap: wrap; gap: 1.2rem; } figure { margin: 0; } figcaption { max-width: 20rem; }
img { image-rendering: pixelated; width: 20rem; max-width: 100%; border: 1px solid #8888; }
table { border-collapse: collapse; } td, th { padding: 0.2rem 0.8rem; text-align: right; }
td:first-child, th:first-child { text-align: left; }
"""


def write_report(path: Path, found: Calibration, replaced: bool) -> None:
    """Write the report; the file appears whole or not at all.

    Parameters
    ----------
    path : Path
        An HTML file.
    found : Calibration
    replaced : bool
        Whether the bundle was replaced.

    Raises
    ------
    InputError
        Where it cannot be written.
    """
    values = numbers(found)
    shape = next(iter(found.bases.values())).path.grid.shape
    parts = [
        f'<p class="verdict {found.verdict}">{html.escape(sentence_of(values, replaced))}</p>',
        _heldout_table(values),
        *(_colour(found, values, channel) for channel in found.bases),
        "<h2>Wavefront and beam</h2>",
        _row(
            [
                _signed(
                    found.estimate.drift.wavefront(shape),
                    "nm",
                    f"Change of the panel's wavefront, {values['wavefront']['rms_nm']:.2f} nm rms",
                ),
                *_free_form(found, values),
                *(
                    _signed(
                        100 * (found.estimate.drift.amplitude(c, shape) - 1),
                        "%",
                        f"Change of the beam's amplitude, {c}",
                    )
                    for c in found.bases
                ),
            ]
        ),
        "<h2>What is left on held-out patterns</h2>",
        "<p>Error of the prediction in standard deviations of the camera's noise: above as it was, below refitted. "
        "What is left should be noise, without shapes.</p>",
        _row([_signed(r, "σ", "as it was", 8.0) for r in found.before.residuals]),
        _row([_signed(r, "σ", "refitted", 8.0) for r in found.after.residuals]),
        "<h2>Where the camera looks</h2>",
        _row([_gray(t.dots.signal, f"Dots as the camera saw them, {c}") for c, t in found.captures.items()]),
        _registration(values),
        f"<p>{found.pictures_taken} pictures were taken in {found.seconds['capturing']:.1f} s and explained in "
        f"{found.seconds['fitting']:.1f} s, in the plane at {found.plane_mm:g} mm.</p>",
    ]
    page = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Calibration</title>'
        f"<style>{STYLE}</style></head><body><h1>Self-calibration</h1>{''.join(parts)}</body></html>\n"
    )
    with whole_file(path, "w") as stream:
        stream.write(page)


def _heldout_table(values: dict[str, Any]) -> str:
    """Errors on held-out patterns, before and after."""
    rows = "".join(
        f"<tr><td>{name}</td><td>{v['nrmse']:.4f}</td><td>{v['noise_nrmse']:.4f}</td><td>{v['excess']:.2g}</td></tr>"
        for plane, heldout in (
            ("", values["heldout"]),
            *((f", at {p['plane_mm']:g} mm", p["heldout"]) for p in values["planes"]),
        )
        for name, v in ((f"as it was{plane}", heldout["before"]), (f"refitted{plane}", heldout["after"]))
    )
    return (
        "<table><tr><th>on held-out patterns</th><th>error (nrmse)</th><th>camera noise alone</th><th>excess</th></tr>"
        f"{rows}</table>"
    )


def _colour(found: Calibration, values: dict[str, Any], channel: str) -> str:
    """The picture before and after, and the response, of one colour."""
    base, seen = found.bases[channel], found.pictures[channel]
    c = values["channels"][channel]
    was, now = base.path.response, found.estimate.drift.response[channel]
    return "".join(
        [
            f"<h2>{html.escape(channel)}, {c['wavelength_nm']:g} nm</h2>",
            _row(
                [
                    _gray(proof_picture(base.path.grid.shape), "Asked for"),
                    *(
                        _gray(light, f"Seen by the camera, {name}: {psnr:.1f} dB amplitude PSNR")
                        for name, (light, psnr) in seen.items()
                    ),
                ]
            ),
            _response(np.asarray(was), np.asarray(now), found.sweeps[channel]),
            f"<p>Power: {c['counts_per_ms']:.4g} counts a millisecond, steady to {100 * c['power_spread']:.2f} %. "
            f"Gratings were seen with {100 * c['grating_visibility']:.1f} % of the predicted contrast.</p>",
        ]
    )


def _registration(values: dict[str, Any]) -> str:
    """Where the camera looks, in a sentence."""
    view = values["registration"]
    return (
        f"<p>Against its homography the camera is moved by {view['shift_y_px']:z.3f} rows and "
        f"{view['shift_x_px']:z.3f} columns of the panel and turned by {view['rotation_mrad']:z.3f} mrad; its own blur "
        f"is {view['blur_y_px2']:z.3f} and {view['blur_x_px2']:z.3f} square pixels, its stray light "
        f"{100 * view['stray']:.2f} % of the mean.</p>"
    )


def _free_form(found: Calibration, values: dict[str, Any]) -> list[str]:
    """A picture of the free-form part of the wavefront, where one was fitted."""
    if values["wavefront"]["free_form"]["nodes"] is None:
        return []
    shape = next(iter(found.bases.values())).path.grid.shape
    fine = replace(found.estimate.drift, wavefront_nm=np.zeros(0)).wavefront(shape)
    return [_signed(fine, "nm", f"of it the free-form part, {fine.std():.2f} nm rms")]


def _row(figures: Sequence[str]) -> str:
    """Figures side by side."""
    return f'<div class="row">{"".join(figures)}</div>'


def _gray(light: np.ndarray, caption: str) -> str:
    """Irradiance as an sRGB picture, its 99.8th percentile white."""
    return _figure(np.rint(255 * encode_srgb(light / white_of(light))).astype(np.uint8), caption)


def _signed(values: np.ndarray, unit: str, caption: str, most: float | None = None) -> str:
    """A map from blue (lowest) over white (0) to red."""
    most = most or max(float(np.abs(values).max()), 1e-9)
    share = np.clip(values / most, -1, 1)[..., None]
    ends = np.where(share < 0, np.array(BLUE), np.array(RED))
    colour = np.array(WHITE) + np.abs(share) * (ends - np.array(WHITE))
    return _figure(
        np.rint(colour).astype(np.uint8),
        f"{caption} (blue −{most:.3g} {unit}, white 0, red +{most:.3g} {unit})",
    )


def _figure(pixels: np.ndarray, caption: str) -> str:
    """A picture, uint8 [h, w] or [h, w, 3], with its caption."""
    picture = Image.fromarray(pixels)
    if picture.width > 2 * WIDTH:
        picture.thumbnail((2 * WIDTH, 2 * WIDTH))
    stream = io.BytesIO()
    picture.save(stream, format="PNG")
    data = base64.b64encode(stream.getvalue()).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _response(was: np.ndarray, now: np.ndarray, sweep: Sweep) -> str:
    """Phase over gray level: as it was, as refitted, and the gratings that were measured."""
    wide, high, left, low = 640.0, 260.0, 50.0, 30.0
    was, now = was - was[0], now - now[0]
    phases = np.concatenate([was, now, sweep.phase])
    bottom, top = float(phases.min()), max(float(phases.max()), float(phases.min()) + 1e-6)

    def place(gray: float, phase: float) -> tuple[float, float]:
        return left + gray / (len(was) - 1) * wide, 10 + (top - phase) / (top - bottom) * high

    def line(values: np.ndarray, style: str) -> str:
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(g, v) for g, v in enumerate(values)))
        return f'<polyline points="{points}" fill="none" stroke-width="2" {style}/>'

    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="#b2182b"/>'
        for x, y in (place(g, p) for g, p in zip(sweep.gray, sweep.phase, strict=True))
    )
    dashed, blue = 'stroke="#888" stroke-dasharray="6 4"', 'stroke="#2166ac"'
    (x0, y0), (x1, y1) = place(0, bottom), place(len(was) - 1, top)
    return (
        f'<figure><svg viewBox="0 0 {wide + left + 20:.0f} {high + low + 20:.0f}" style="max-width:44rem" role="img" '
        f'aria-label="phase response"><path d="M{x0},{y1} V{y0} H{x1}" fill="none" stroke="currentColor"/>'
        f"{line(was, dashed)}{line(now, blue)}{dots}"
        f'<g font-size="13" fill="currentColor"><text x="4" y="{y1 + 4}">{top:.2f}</text>'
        f'<text x="4" y="{y0}">{bottom:.2f}</text><text x="{x0}" y="{y0 + 20}">0</text>'
        f'<text x="{x1 - 20}" y="{y0 + 20}">{len(was) - 1}</text>'
        f'<text x="{(x0 + x1) / 2 - 40}" y="{y0 + 20}">gray level</text></g></svg>'
        "<figcaption>Phase (rad) from gray 0: as it was (dashed), refitted (blue), measured gratings (red)."
        "</figcaption></figure>"
    )
