"""Pictures to patterns from a bundle's folder: the Python interface of `hololoop-runtime solve`."""

from __future__ import annotations

import base64
import io
import os
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import INITIALISER, read_bundle
from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, plane_of
from runtime.bundle.whole_files import whole_file
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import approximator_of
from runtime.solver.quality import shown
from runtime.solver.solver import Solver
from runtime.solver.targets import CHANNELS, encode_srgb, fit_area, read_target


@dataclass(frozen=True)
class PatternResult:
    """A pattern, and what the model says that it shows.

    Attributes
    ----------
    gray : uint8 array [H, W]
        Gray levels to send to the panel as they are.
    psnr_db : float, dB
        Of amplitude, predicted against asked for, after one free scale.
    iterations : int
    milliseconds : float, ms
        From the picture to the gray levels.
    channel : str
    plane_mm : float, mm
        Panel to image plane.
    """

    gray: np.ndarray
    psnr_db: float
    iterations: int
    milliseconds: float
    channel: str
    plane_mm: float
    _path: LightPath = field(repr=False)
    _white: float = field(repr=False)

    @cached_property
    def predicted(self) -> np.ndarray:
        """Irradiance [H, W] that the bundle's light path predicts in the image plane; the target's white is 1.

        It is computed when first asked for. A trained approximator's correction is not in it.
        """
        return shown(self._path, self.gray) / self._white

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the pattern as an 8-bit gray PNG, whole or not at all."""
        with whole_file(Path(path)) as file:
            Image.fromarray(self.gray).save(file, format="PNG")

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        seen = np.rint(255 * encode_srgb(self.predicted)).astype(np.uint8)
        text = (
            f"{self.channel}, {self.plane_mm:g} mm: amplitude PSNR {self.psnr_db:.1f} dB after "
            f"{self.iterations} iterations, {self.milliseconds:.0f} ms. Left: the pattern. "
            "Right: what the model predicts."
        )
        return (
            f"<p>{escape(text)}</p>{_image_tag(self.gray, 'pattern')} {_image_tag(seen, 'predicted picture')}"
        )


class BundleSolver:
    """Computes the pattern of one picture after the other, through one colour and plane of a bundle.

    It is prepared once, for instance as `hololoop.Solver("bundle/")`, and then quick. The solver for several colours
    at once, regions and stacks of planes is `runtime.solver.Solver`.

    Parameters
    ----------
    bundle : path
        Folder that `hololoop.export` or `hololoop-trainer export` wrote.
    channel : str, optional
        Name of the colour; needed where the bundle has several.
    plane_mm : float, mm, optional
        Image plane; the bench's own distance where none is given.
    **options
        For `runtime.solver.Solver`: `penalty`, `grid`, `region` and others.

    Attributes
    ----------
    channel : str
    plane_mm : float, mm
    shape : (int, int)
        Rows and columns of the panel.

    Raises
    ------
    InputError
        Where the bundle is damaged, has no such colour or plane, or holds an approximator for several colours.
    """

    def __init__(
        self,
        bundle: str | os.PathLike[str],
        channel: str | None = None,
        plane_mm: float | None = None,
        **options: Any,
    ) -> None:
        content = read_bundle(Path(bundle))
        every = bundle_channels(content)
        self._path = load_light_path(content, channel, plane_mm)
        self.channel: str = every[0] if channel is None else channel
        self.plane_mm: float = plane_of(content, self.channel, plane_mm)
        self.shape: tuple[int, int] = self._path.grid.shape
        approximator = approximator_of(content, (len(every), *self.shape))
        if approximator is not None and len(every) > 1:
            raise InputError(
                "the bundle's approximator sees all channels together: use hololoop-runtime solve, or "
                "runtime.solver.Solver with all of them"
            )
        self._colour = self.channel if len(every) > 1 and all(c in CHANNELS for c in every) else None
        self._solver = Solver(
            self._path, approximator=approximator, initialiser=content.networks.get(INITIALISER), **options
        )

    def solve(
        self,
        picture: str | os.PathLike[str] | np.ndarray,
        iterations: int | None = None,
        *,
        deadline_ms: float | None = None,
        fit: bool = False,
    ) -> PatternResult:
        """Compute the pattern that shows a picture best.

        Parameters
        ----------
        picture : path or array [H, W]
            A PNG (taken as sRGB), an EXR or an NPY file (linear); or linear irradiance of any scale.
        iterations : int, optional
            20, or as many as the deadline allows.
        deadline_ms : float, ms, optional
            From picture to pattern; the best pattern met by then is returned.
        fit : bool
            Whether a picture of another size than the panel's is cropped about its centre and resized.

        Returns
        -------
        PatternResult

        Raises
        ------
        InputError
            Where the picture cannot be read, has another size, or is dark or negative.
        """
        if isinstance(picture, np.ndarray):
            target = picture
            if fit and target.ndim == 2 and target.size and target.shape != self.shape:
                target = fit_area(target, self.shape)
        elif self._colour is not None:
            target = read_target(picture, self.shape, [self._colour], fit=fit)[0]
        else:
            target = read_target(picture, self.shape, fit=fit)
        solution = self._solver.solve(target, iterations, deadline_ms=deadline_ms)
        quality = solution.quality
        return PatternResult(
            solution.gray.copy(),
            quality.psnr_db,
            solution.iterations,
            solution.milliseconds,
            self.channel,
            self.plane_mm,
            self._path,
            max(quality.scale * float(target.max()), 1e-30),
        )


def _image_tag(gray: np.ndarray, alt: str) -> str:
    """Gray levels as an <img> element that needs no other file."""
    stream = io.BytesIO()
    Image.fromarray(gray).save(stream, "PNG")
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    return f'<img alt="{alt}" src="data:image/png;base64,{data}" style="max-width: 48%">'
