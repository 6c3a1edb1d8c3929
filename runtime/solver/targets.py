"""Pictures to show, as linear irradiance.

Everywhere in hololoop a target is linear: twice the number is twice the light. Colour channels are called
"red", "green" and "blue", in that order where they are stacked.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from firmware_iface.errors import InputError
from runtime.solver.picture_files import decode_srgb, encode_srgb, read_planes, size_text, wrong_size

__all__ = [
    "CHANNELS",
    "LUMINANCE",
    "channel_targets",
    "decode_srgb",
    "encode_srgb",
    "fit_area",
    "read_target",
]

CHANNELS = ("red", "green", "blue")
TEST_PICTURE = Path(__file__).with_name(
    "test_picture.png"
)  # for a first pattern, where nobody gives a picture
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB


def read_target(
    path: str | os.PathLike[str],
    shape: tuple[int, int] | None = None,
    channels: int | Sequence[str] = 1,
    *,
    fit: bool = False,
) -> np.ndarray:
    """Read a picture as linear irradiance.

    PNG, JPEG and TIFF of 8 or 16 bits are sRGB and become linear, white = 1. EXR, NPY and TIFF of floats are linear
    as they are. `picture_files.read_planes` says more.

    Parameters
    ----------
    path : path
    shape : (int, int) or None, pixels
        Height, width that the picture must have.
    channels : int or sequence of str
        1 (a colour picture gives its luminance), 3 (red, green, blue) or a sequence of those names, one plane each,
        in its order. A gray picture is the same in every channel.
    fit : bool
        Crop a picture of another size about its centre to the aspect of `shape` and resize it by area: each pixel
        gets the mean of the light that falls on it.

    Returns
    -------
    float32 array [H, W], or [C, H, W] for several channels

    Raises
    ------
    InputError
        For a file that cannot be read as a picture, and for another size without `fit`.
    """
    names = _channel_names(channels)
    path = Path(path)
    planes = read_planes(path, None if fit else shape)
    if planes.size == 0:
        raise InputError(f"{path} is empty: its size is {size_text(planes.shape[-2:])}")
    if not np.isfinite(planes).all():
        raise InputError(f"{path} has values that are not finite numbers (or too large for float32)")
    if (lowest := float(planes.min())) < 0:
        raise InputError(f"{path} has negative values (down to {lowest:.4g}); irradiance is never below zero")
    if names is None:
        target = planes[0] if len(planes) == 1 else np.tensordot(LUMINANCE, planes, 1)
    else:
        target = planes[[0 if len(planes) == 1 else CHANNELS.index(name) for name in names]]
    if shape is not None and target.shape[-2:] != tuple(shape):
        if not fit:
            raise wrong_size(path, target.shape[-2:], shape)
        target = fit_area(target, shape)
    return np.ascontiguousarray(target, dtype=np.float32)


def channel_targets(
    path: Path, shape: tuple[int, int], channels: Sequence[str], *, fit: bool, colour: bool
) -> dict[str, np.ndarray]:
    """A picture's irradiance for each channel of a bundle.

    Parameters
    ----------
    path : Path
        The picture, as `read_target` reads it.
    shape : tuple of int
        Height and width of the panel, pixels.
    channels : sequence of str
        Those that are wanted.
    fit : bool
        Whether a picture of another size is cropped and resized.
    colour : bool
        Whether the bundle has several channels, so that each shows its own part; otherwise luminance is shown.

    Returns
    -------
    dict of str to float32 array [H, W]

    Raises
    ------
    InputError
        As `read_target`.
    """
    if colour and all(name in CHANNELS for name in channels):
        return dict(zip(channels, read_target(path, shape, channels, fit=fit), strict=True))
    return dict.fromkeys(channels, read_target(path, shape, fit=fit))


def fit_area(picture: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Crop [..., H, W] about its centre to the aspect of `shape`, and resize it to `shape` by area.

    The mean over the crop is kept for all sizes; no value overshoots, and none goes below zero.
    """
    height, width = picture.shape[-2:]
    scale = min(height / shape[0], width / shape[1])  # pixels of the picture per pixel of the result
    return _resize_axis(_resize_axis(picture, -2, shape[0], scale), -1, shape[1], scale)


def _channel_names(channels: int | Sequence[str]) -> Sequence[str] | None:
    """The planes to return, or None for one plane of luminance."""
    if isinstance(channels, int):
        if channels not in (1, 3):
            raise InputError(f"a picture has 1 or 3 channels, not {channels}; or give the channels' names")
        return None if channels == 1 else CHANNELS
    names = (channels,) if isinstance(channels, str) else tuple(channels)
    if not names or any(name not in CHANNELS for name in names):
        raise InputError(
            "channels of a picture are called red, green and blue, not "
            + (", ".join(map(repr, names)) or "nothing at all")
        )
    return names


def _resize_axis(picture: np.ndarray, axis: int, size: int, scale: float) -> np.ndarray:
    """Means over `size` cells of `scale` pixels about the centre: differences of the running integral."""
    picture = np.moveaxis(picture, axis, -1)
    length = picture.shape[-1]
    integral = np.zeros((*picture.shape[:-1], length + 1))
    np.cumsum(picture, axis=-1, out=integral[..., 1:])
    edges = np.clip(length / 2 + scale * (np.arange(size + 1) - size / 2), 0, length)
    whole = np.minimum(edges.astype(int), length - 1)
    at_edges = integral[..., whole] + (edges - whole) * picture[..., whole]
    means = np.maximum(np.diff(at_edges, axis=-1) / scale, 0)
    return np.moveaxis(means, -1, axis)
