"""Pictures from files, as linear planes: PNG, JPEG, TIFF, EXR and NPY.

What a file is, its content says, whatever its name.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from firmware_iface.errors import InputError

READ = "PNG, JPEG, TIFF, EXR or NPY"
BITS_PER_SAMPLE = 258  # a tag of TIFF

_UNREADABLE = (
    OSError,
    SyntaxError,  # Pillow's word for a broken PNG
    ValueError,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)

MOST_VALUES = 3 * 178_956_970  # of a picture: three times what Pillow reads of one colour


def read_planes(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Read a picture's planes.

    PNG, JPEG and TIFF, 8 or 16 bits: sRGB (a colour profile is ignored), decoded to linear, white = 1.
    TIFF of 32-bit floats: linear as it is.
    EXR: linear as it is, from R, G, B or from Y. Needs the OpenEXR library.
    NPY: linear as it is, [H, W] or [3, H, W].

    Parameters
    ----------
    path : Path
    shape : (int, int), pixels, optional
        The size that the picture must have. An NPY file says its size before it is read, and so one of another size is
        refused before it takes memory.

    Returns
    -------
    float32 array [1, H, W] or [3, H, W], linear

    Raises
    ------
    InputError
        For a file that cannot be read as a picture.
    """
    reader = _reader_of(path)
    try:
        return reader(path, shape) if reader is _read_npy else reader(path)
    except MemoryError:
        raise InputError(f"{path} does not fit into memory: give a smaller picture") from None


def _reader_of(path: Path) -> Callable[[Path], np.ndarray]:
    """How a file is read: by its first bytes or, where they say nothing, by its name, so that it is named."""
    by_name = {
        ".png": _read_png,
        ".jpg": _read_jpeg,
        ".jpeg": _read_jpeg,
        ".tif": _read_tiff,
        ".tiff": _read_tiff,
        ".exr": _read_exr,
        ".npy": _read_npy,
    }
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except FileNotFoundError:
        raise InputError(f"{path} is missing") from None
    except IsADirectoryError:
        raise InputError(f"{path} is not a file") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    for magic, reader in (
        (b"\x89PNG\r\n\x1a\n", _read_png),
        (b"\xff\xd8\xff", _read_jpeg),
        (b"II*\0", _read_tiff),
        (b"MM\0*", _read_tiff),
        (b"v/1\x01", _read_exr),
        (b"\x93NUMPY", _read_npy),
    ):
        if start.startswith(magic):
            return reader
    if path.suffix.lower() not in by_name:
        raise InputError(f"{path} is not a type of picture that is read here; give {READ}")
    return by_name[path.suffix.lower()]


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear irradiance, clipped to 0..1, to sRGB in 0..1, as files and screens have it."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)


def white_of(light: np.ndarray) -> float:
    """What is white where irradiance is shown in any unit: its 99.8th percentile."""
    return max(float(np.percentile(light, 99.8)), 1e-12)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """sRGB in 0..1 to linear irradiance in 0..1: the inverse of `encode_srgb`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, np.power((encoded + 0.055) / 1.055, 2.4))


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
                    pixels = _read_with_opencv(path, "PNG")
                elif depth == 16:
                    pixels = np.asarray(image)
                elif image.mode in ("1", "L") and "transparency" not in image.info:
                    pixels = np.asarray(image.convert("L"))
                else:
                    pixels = np.asarray(image.convert("RGBA"))
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read as PNG: {_reason(error)}") from error
    return _linear(path, pixels, 65535 if depth == 16 else 255)


def _read_jpeg(path: Path) -> np.ndarray:
    return _linear(path, _read_8_bit(path, "JPEG"), 255)


def _read_tiff(path: Path) -> np.ndarray:
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=["TIFF"]) as image:
            bits = max(image.tag_v2.get(BITS_PER_SAMPLE, (1,)))  # type: ignore[attr-defined]
    except UnidentifiedImageError:
        bits = 32  # of several floats, which Pillow does not read
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read as TIFF: {_reason(error)}") from error
    if bits <= 8:
        return _linear(path, _read_8_bit(path, "TIFF"), 255)
    pixels = _read_with_opencv(path, "TIFF")
    if pixels.dtype == np.uint16:
        return _linear(path, pixels, 65535)
    if pixels.dtype != np.float32:
        raise InputError(
            f"{path} is a TIFF of {pixels.dtype}: save it with 8 or 16 bits, or as 32-bit floats"
        )
    planes = np.moveaxis(pixels.reshape(*pixels.shape[:2], -1), -1, 0)
    if len(planes) not in (1, 3):
        raise InputError(f"{path} has {len(planes)} planes of floats: save it as gray or as RGB")
    return planes


def _read_8_bit(path: Path, kind: str) -> np.ndarray:
    """Pixels, uint8 [H, W] or [H, W, 4], the right way up."""
    try:
        with warnings.catch_warnings(action="ignore"):
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=[kind]) as image:
                upright = ImageOps.exif_transpose(image)
                return np.asarray(upright.convert("L" if upright.mode in ("1", "L") else "RGBA"))
    except _UNREADABLE as error:
        raise InputError(f"{path} cannot be read as {kind}: {_reason(error)}") from error


def _linear(path: Path, pixels: np.ndarray, top: int) -> np.ndarray:
    """Linear planes of sRGB pixels [H, W] or [H, W, 1 to 4], of which `top` is white.

    Raises
    ------
    InputError
        Where a pixel is transparent.
    """
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.shape[-1] in (2, 4):
        if (pixels[..., -1] != top).any():
            raise InputError(f"{path} is partly transparent; flatten it onto a background first")
        pixels = pixels[..., :-1]
    table = decode_srgb(np.arange(top + 1) / top).astype(np.float32)
    return table[np.moveaxis(pixels, -1, 0)]


def _reason(error: BaseException) -> str:
    """What a library says is wrong, in one line and without its objects."""
    if isinstance(error, UnidentifiedImageError):
        return "it is damaged, or is something else"
    return " ".join(str(error).split()) or type(error).__name__


def _read_with_opencv(path: Path, kind: str) -> np.ndarray:
    """Pixels of more than 8 bits, red first: Pillow reads those of colours as 8 bits."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"{path} is a {kind} of more than 8 bits, which needs OpenCV: pip install 'hololoop[trainer]', "
            f"or save it as 8-bit {kind} or as NPY"
        ) from error
    before = cv2.utils.logging.setLogLevel(
        cv2.utils.logging.LOG_LEVEL_SILENT
    )  # what is wrong is said once, below
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    finally:
        cv2.utils.logging.setLogLevel(before)
    if pixels is None:
        raise InputError(
            f"{path} cannot be read as {kind}: it is damaged, or of a kind that is not read here"
        )
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
        raise InputError(f"{path} cannot be read as EXR: {_reason(error)}") from error
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
        raise wrong_size(path, size[-2:], shape)
    values = math.prod(size)
    if not dtype.hasobject and begin + values * dtype.itemsize > path.stat().st_size:
        raise InputError(f"{path} is cut off: it says that it holds {size} and has too few bytes for that")
    if values > MOST_VALUES:
        raise InputError(f"{path} is too large for a picture: {size_text(size[-2:])}")


def wrong_size(path: Path, size: Sequence[int], shape: tuple[int, int]) -> InputError:
    """The error for a picture that is not of the needed size."""
    return InputError(
        f"{path} is {size_text(size)} and {size_text(shape)} is needed; resize it, or ask for it to be fitted"
    )


def _read_npy(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray:
    _check_npy_size(path, shape)
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read as NPY: {_reason(error)}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise InputError(f"{path} does not hold an array of real numbers")
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[0] not in (1, 3):
        raise InputError(f"{path} has the shape {array.shape}; give [H, W] or [3, H, W]")
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused as such
        return array.astype(np.float32)


def size_text(shape: Sequence[int]) -> str:
    """A picture's size in words."""
    return f"{shape[0]} high and {shape[1]} wide"
