"""Pictures to show, as linear irradiance.

Everywhere in hololoop a target is linear: twice the number is twice the light. Colour channels are called
"red", "green" and "blue", in that order where they are stacked.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from firmware_iface.errors import InputError

CHANNELS = ("red", "green", "blue")
MOST_VALUES = 3 * 178_956_970  # of a picture: three times what Pillow reads of one colour
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB

_UNREADABLE = (
    OSError,
    SyntaxError,  # Pillow's word for a broken PNG
    ValueError,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)


def read_target(
    path: str | os.PathLike[str],
    shape: tuple[int, int] | None = None,
    channels: int | Sequence[str] = 1,
    *,
    fit: bool = False,
) -> np.ndarray:
    """Read a picture as linear irradiance.

    PNG, 8 or 16 bits: sRGB (its colour profile is ignored), decoded to linear, white = 1.
    EXR: linear as it is, from R, G, B or from Y. Needs the OpenEXR library.
    NPY: linear as it is, [H, W] or [3, H, W].

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
    readers: dict[str, Callable[[Path], np.ndarray]] = {
        ".png": _read_png,
        ".exr": _read_exr,
        ".npy": partial(_read_npy, shape=None if fit else shape),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is not a type of picture that is read here; give PNG, EXR or NPY")
    if not path.is_file():
        raise InputError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    planes = reader(path)  # [1, H, W] or [3, H, W], linear
    if planes.size == 0:
        raise InputError(f"{path} is empty: its size is {_size_text(planes.shape[-2:])}")
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
            raise _wrong_size(path, target.shape[-2:], shape)
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


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear irradiance, clipped to 0..1, to sRGB in 0..1, as files and screens have it."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """sRGB in 0..1 to linear irradiance in 0..1: the inverse of `encode_srgb`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, np.power((encoded + 0.055) / 1.055, 2.4))


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


def _read_png(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        header = file.read(26)
    if len(header) < 26 or header[:8] != b"\x89PNG\r\n\x1a\n" or header[12:16] != b"IHDR":
        raise InputError(f"{path} is not a PNG, although its name says so")
    depth, colour_type = header[24], header[25]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG"]) as image:
                image.load()
                if depth == 16 and colour_type != 0:
                    pixels = _read_png_16_bit_colour(path)
                elif depth == 16:
                    pixels = np.asarray(image)
                elif image.mode in ("1", "L") and "transparency" not in image.info:
                    pixels = np.asarray(image.convert("L"))
                else:
                    pixels = np.asarray(image.convert("RGBA"))
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read as PNG: {error}") from error
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    top = 65535 if depth == 16 else 255
    if pixels.shape[-1] in (2, 4):
        if (pixels[..., -1] != top).any():
            raise InputError(f"{path} is partly transparent; flatten it onto a background first")
        pixels = pixels[..., :-1]
    table = decode_srgb(np.arange(top + 1) / top).astype(np.float32)
    return table[np.moveaxis(pixels, -1, 0)]


def _read_png_16_bit_colour(path: Path) -> np.ndarray:
    """Pillow reads these as 8 bits."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"{path} is a 16-bit colour PNG, which needs OpenCV: pip install 'hololoop[trainer]', "
            "or save it as 8-bit PNG or as NPY"
        ) from error
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise InputError(f"{path} cannot be read as a 16-bit PNG")
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[-1]]]
    return np.asarray(pixels)


def _read_exr(path: Path) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            f"{path} needs the OpenEXR library: pip install 'hololoop[trainer]' (or OpenEXR alone), "
            "or save it as NPY"
        ) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises bare exceptions of its own
        raise InputError(f"{path} cannot be read as EXR: {error}") from error
    for wanted in (("R", "G", "B"), ("Y",)):
        if all(name in planes for name in wanted):
            if len({planes[name].shape for name in wanted}) > 1:
                raise InputError(f"{path} has channels of different sizes; save it without subsampling")
            return np.stack([planes[name] for name in wanted]).astype(np.float32)
    found = ", ".join(sorted(planes)) or "none"
    raise InputError(f"{path} has neither R, G, B nor Y; its channels are {found}")


def _check_npy_size(path: Path, shape: tuple[int, int] | None) -> None:
    """Look at the header of an NPY file, before memory is taken for what it says."""
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            reads = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }
            size, _, dtype = reads[version](file)
        except (ValueError, KeyError, EOFError):
            return  # what is wrong is said where it is read
        begin = file.tell()
    if shape is not None and len(size) in (2, 3) and 0 not in size and size[-2:] != tuple(shape):
        raise _wrong_size(path, size[-2:], shape)
    values = math.prod(size)
    if not dtype.hasobject and begin + values * dtype.itemsize > path.stat().st_size:
        raise InputError(f"{path} is cut off: it says that it holds {size} and has too few bytes for that")
    if values > MOST_VALUES:
        raise InputError(f"{path} is too large for a picture: {_size_text(size[-2:])}")


def _wrong_size(path: Path, size: Sequence[int], shape: tuple[int, int]) -> InputError:
    return InputError(
        f"{path} is {_size_text(size)} and {_size_text(shape)} is needed; "
        "resize it, or ask for it to be fitted"
    )


def _read_npy(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray:
    _check_npy_size(path, shape)
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read as NPY: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise InputError(f"{path} does not hold an array of real numbers")
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[0] not in (1, 3):
        raise InputError(f"{path} has the shape {array.shape}; give [H, W] or [3, H, W]")
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused as such
        return array.astype(np.float32)


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


def _size_text(shape: Sequence[int]) -> str:
    return f"{shape[0]} high and {shape[1]} wide"
