"""How the headset's camera sees the image plane: where it looks, how sharply, how evenly.

None of this changes the light path: it explains the measurement. Positions are (y, x) in panel pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import Bundle
from runtime.camera.sampling import (
    camera_places,
    finer_picture,
    finer_picture_adjoint,
    pixel_area,
    rectified,
    sample_places,
    spline_filter,
    spline_matrix,
)
from runtime.lightpath.fft import irfft2, rfft2
from runtime.lightpath.grid import Grid, image_frequencies
from runtime.lightpath.legendre import edge_to_edge, legendre_surface

SENSITIVITY_ORDER = 4  # of the camera's own fall-off, so that none of it is taken for the beam's
TERMS = 14  # of that order

Sampler = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class View:
    """A camera in front of the image plane.

    Attributes
    ----------
    shape : (int, int)
        (h, w), camera pixels.
    homography : tuple of 9 floats
        Row-major, from camera pixels (x, y, 1) to panel pixels (x, y, 1) up to scale.
    shift_y_px, shift_x_px : float, panel pixels
        A motion on the panel after the homography.
    rotation_mrad : float, mrad
        A rotation after the homography, about the panel's centre.
    magnification, aspect, shear, keystone_y, keystone_x : float, relative at the panel's border
        Corrections of a homography from dots.
    distortion : float, relative at the panel's corners
        Radial, of the lens.
    blur_y_px2, blur_x_px2 : float, panel pixels squared
        Variance of the lens's blur.
    sensitivity : tuple of float
        Legendre terms of the logarithm of the camera's sensitivity, from order 1 on.
    stray : float, share of a picture's mean
        Light that is added.
    """

    shape: tuple[int, int]
    homography: tuple[float, ...] = (1, 0, 0, 0, 1, 0, 0, 0, 1)
    shift_y_px: float = 0.0
    shift_x_px: float = 0.0
    rotation_mrad: float = 0.0
    magnification: float = 0.0
    aspect: float = 0.0
    shear: float = 0.0
    keystone_y: float = 0.0
    keystone_x: float = 0.0
    distortion: float = 0.0
    blur_y_px2: float = 0.0
    blur_x_px2: float = 0.0
    sensitivity: tuple[float, ...] = (0.0,) * TERMS
    stray: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """The view for a bundle's description: its fields by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> View:
        """The view from what `as_json` gave.

        Raises
        ------
        TypeError, ValueError
            Where it is something else.
        """
        values = {f.name: given[f.name] for f in fields(cls) if f.name in given}
        for name in ("shape", "homography", "sensitivity"):
            values[name] = tuple(values[name])
        return cls(**values)

    def evenness(self) -> np.ndarray:
        """The camera's relative sensitivity, float64 [h, w]."""
        return np.exp(legendre_surface(np.asarray(self.sensitivity, float), *edge_to_edge(self.shape)))

    def matrix(self, panel: tuple[int, int]) -> np.ndarray:
        """The homography with the motion: from camera pixels (x, y, 1) to pixels of a panel of that shape."""
        cy, cx = (panel[0] - 1) / 2, (panel[1] - 1) / 2
        cos, sin = np.cos(1e-3 * self.rotation_mrad), np.sin(1e-3 * self.rotation_mrad)
        to_centre, back = np.eye(3), np.eye(3)
        to_centre[:2, 2], back[:2, 2] = (-cx, -cy), (cx + self.shift_x_px, cy + self.shift_y_px)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        m, a, s = self.magnification, self.aspect, self.shear
        keystone = (2 * self.keystone_x / panel[1], 2 * self.keystone_y / panel[0], 1)
        stretch = np.array([[1 + m + a, s, 0], [s, 1 + m - a, 0], keystone])
        return back @ turn @ stretch @ to_centre @ np.asarray(self.homography, float).reshape(3, 3)

    def positions(self, panel: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Where each camera pixel's centre looks on a panel of that shape: (y, x), each float64 [h, w]."""
        down, right = np.arange(self.shape[0])[:, None], np.arange(self.shape[1])
        x, y, share = (m[0] * right + (m[1] * down + m[2]) for m in self.matrix(panel))
        return _bent(y / share, x / share, panel, self.distortion)


def view_of(bundle: Bundle) -> View | None:
    """The camera's view of an earlier calibration, if the bundle holds one.

    Raises
    ------
    InputError
        Where the bundle's record cannot be read.
    """
    given = bundle.description.get("camera")
    if not isinstance(given, Mapping) or "view" not in given:
        return None
    try:
        return View.from_json(given["view"])
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"the bundle's record of its camera cannot be read: {error}; export it again"
        ) from None


def _bent(
    y: np.ndarray, x: np.ndarray, panel: tuple[int, int], distortion: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions on a panel after a radial distortion; the opposite distortion takes them back, to first order."""
    v, u = y - (panel[0] - 1) / 2, x - (panel[1] - 1) / 2
    by = distortion * (v**2 + u**2) / ((panel[0] / 2) ** 2 + (panel[1] / 2) ** 2)
    return y + by * v, x + by * u


def on_panel(signal: np.ndarray, view: View, shape: tuple[int, int]) -> np.ndarray:
    """A capture on the panel's pixels, without stray light and the camera's unevenness.

    Parameters
    ----------
    signal : float array [h, w], counts
        Above black.
    view : View
    shape : (int, int)
        (H, W), pixels of the panel.

    Returns
    -------
    float32 array [H, W], counts
        0 where the camera does not look.
    """
    stray = view.stray / (1 + view.stray) * float(signal.mean())
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    y, x = _bent(rows, columns, shape, -view.distortion)
    light = ((signal - stray) / view.evenness()).astype(np.float32)
    return rectified(light, *camera_places(view.matrix(shape), y, x))


def sampler(view: View, grid: Grid, finer: int = 2) -> Sampler:
    """The linear map from irradiance on a fine grid [..., *grid.image_shape] to camera pixels [..., h, w].

    Light is integrated over the camera pixel's area, blurred by the lens, and read where the pixel looks. Pixels that
    look beyond the grid read 0.

    Parameters
    ----------
    view : View
    grid : Grid
        Of the light path.
    finer : int
        How many times as fine as the light path's fine grid the splines' samples are: 2 to predict.
    """
    return sampler_and_adjoint(view, grid, finer)[0]


def sampler_and_adjoint(view: View, grid: Grid, finer: int = 2) -> tuple[Sampler, Sampler]:
    """`sampler`, and its adjoint, from camera pixels [..., h, w] to irradiance on the fine grid."""
    y, x = view.positions(grid.shape)
    fy, fx = image_frequencies(grid, np.zeros((), np.float64))
    fy, fx = fy[:, None] * grid.pitch, fx[None, :] * grid.pitch  # cycles a panel pixel
    transfer = pixel_area(fy, fx, y, x) / spline_filter(fy, fx, grid.fine * finer)
    transfer = transfer * np.exp(-2 * np.pi**2 * (view.blur_y_px2 * fy**2 + view.blur_x_px2 * fx**2))
    transfer = transfer.astype(np.float32)
    height, width = (finer * n for n in grid.image_shape)
    weights = spline_matrix(*sample_places(grid, y, x, finer), (height, width))

    def sampled(image: np.ndarray) -> np.ndarray:
        fine = finer_picture(rfft2(image) * transfer, grid.image_shape, finer)
        flat = fine.reshape(-1, height * width)
        seen = np.stack([weights @ one for one in flat])
        return seen.reshape(*image.shape[:-2], *view.shape)

    def back(light: np.ndarray) -> np.ndarray:
        flat = light.reshape(-1, weights.shape[0])
        fine = np.stack([weights.T @ one for one in flat]).reshape(*light.shape[:-2], height, width)
        spectrum = finer_picture_adjoint(rfft2(fine), grid.image_shape)
        return irfft2(spectrum * transfer, grid.image_shape)

    return sampled, back
