"""Panel patterns that tell effects apart: pictures, noise of several grains, ramps, gratings, checkerboards,
flats.

Pictures put light where the camera can count it, with a smooth phase (which shows the path's errors as
fringes) or a random one (which reaches all of the pupil). Noise shows the panel's response to every gray
level and to its neighbours; ramps, gratings and checkerboards go to known places of the pupil; a flat shows
the beam itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from PIL import Image

from firmware_iface.errors import InputError
from runtime.camera.registration import dot_pattern
from runtime.lightpath.grid import grid_for
from runtime.lightpath.propagation import band_limit, transfer_function
from trainer.captures.bench_file import Bench

Gray = NDArray[np.uint8]
Array = NDArray[np.floating]

ONE_COLOUR, EACH_OF_SEVERAL = 12, 7  # patterns by default
ITERATIONS = 8  # of Gerchberg and Saxton: enough to recognise the picture
MOST_SAMPLES = 2**28  # of a hologram's grid, with room for light to spread
PICTURES = ("camera", "coins", "text", "chelsea", "page", "moon", "coffee", "astronaut", "brick", "rocket")


@dataclass(frozen=True)
class Pattern:
    """Gray levels to show.

    Attributes
    ----------
    kind : str
        The family of the pattern, such as "grains".
    gray : uint8 array [H, W]
    """

    kind: str
    gray: Gray


@dataclass(frozen=True)
class _PatternRequest:
    """What a pattern is made for.

    Attributes
    ----------
    turn : int
        How many patterns of this kind came before.
    """

    bench: Bench
    channel: str
    plane_mm: float
    rng: np.random.Generator
    turn: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.bench.panel.shape

    def gray(self, phase: Array) -> Gray:
        """Gray levels of a phase, rad, modulo one wave."""
        panel = self.bench.panel
        wave = np.mod(panel.phase_sign * phase / (2 * math.pi), 1) * panel.levels
        level = np.rint(wave).astype(np.int64) % panel.levels
        return np.minimum(level, 255).astype(np.uint8)


def default_count(channels: int) -> int:
    """How many patterns each colour and plane should have."""
    return ONE_COLOUR if channels == 1 else EACH_OF_SEVERAL


def choose_patterns(bench: Bench, channel: str, plane_mm: float, count: int, seed: int = 0) -> list[Pattern]:
    """Patterns for one colour and plane; the same seed gives the same ones.

    The order is part of the choice: the commands that fit hold out every third pattern, from the second on, so each
    family has members on both sides.

    Parameters
    ----------
    bench : Bench
    channel : str
    plane_mm : float, mm
    count : int
    seed : int

    Returns
    -------
    list of Pattern

    Raises
    ------
    InputError
        Where the count is below one, or the plane is out of reach.
    """
    if count < 1:
        raise InputError(f"--patterns {count}: show at least one pattern, and better 7 or more")
    rng = np.random.default_rng([seed, *_scene_entropy(bench, channel, plane_mm)])
    patterns, turns = [], dict.fromkeys(_ORDER, 0)
    for number in range(count):
        kind = _ORDER[number % len(_ORDER)]
        request = _PatternRequest(bench, channel, plane_mm, rng, turns[kind])
        turns[kind] += 1
        patterns.append(Pattern(kind, _KINDS[kind](request)))
    return patterns


def pattern_of_kind(
    bench: Bench, channel: str, plane_mm: float, kind: str, turn: int, seed: int = 0
) -> Pattern:
    """One pattern of a family; the same seed gives the same one.

    Parameters
    ----------
    kind : str
        One of PATTERN_KINDS.
    turn : int
        How many patterns of this kind came before.

    Returns
    -------
    Pattern

    Raises
    ------
    InputError
        Where the plane is out of reach.
    """
    entropy = [seed, turn, PATTERN_KINDS.index(kind), *_scene_entropy(bench, channel, plane_mm)]
    request = _PatternRequest(bench, channel, plane_mm, np.random.default_rng(entropy), turn)
    return Pattern(kind, _KINDS[kind](request))


def dots_to_show(bench: Bench, channel: str, plane_mm: float, spacing: float) -> Gray:
    """Gray levels that show the dot pattern of `runtime.camera.registration` in a plane, to find the camera's place.

    Parameters
    ----------
    bench : Bench
    channel : str
    plane_mm : float, mm
    spacing : float, panel pixels
        Between dots.

    Returns
    -------
    uint8 array [H, W]

    Raises
    ------
    InputError
        As `dot_pattern` does, and where the plane is out of reach.
    """
    request = _PatternRequest(bench, channel, plane_mm, np.random.default_rng(0), 0)
    picture = np.maximum(dot_pattern(bench.panel.shape, spacing).astype(float), 1e-3)
    return request.gray(_hologram(request, picture, _quadratic(request, 0.1)))


def _scene_entropy(bench: Bench, channel: str, plane_mm: float) -> tuple[int, int]:
    """What makes the random choices of one colour and plane other than those of the next."""
    return [c.name for c in bench.channels].index(channel), round(plane_mm * 1000) % 2**32


def _quadratic(s: _PatternRequest, edge: float) -> Array:
    """A quadratic phase over the picture, as behind a lens; `edge` is its slope at the border, cycles a pixel."""
    height, width = s.shape
    y, x = _centred(height) / height, _centred(width) / width
    return math.pi * edge * (height * y[:, None] ** 2 + width * x[None, :] ** 2)


def _smooth_picture(s: _PatternRequest) -> Gray:
    """A picture whose light starts with a quadratic phase, as behind a lens: smooth, and spread over the
    pupil.
    """
    edge = (0.35, 0.1)[s.turn % 2]  # inside the band, with room for the picture's own
    return s.gray(_hologram(s, _picture(s.shape, 2 * s.turn), _quadratic(s, edge)))


def _rough_picture(s: _PatternRequest) -> Gray:
    """A picture whose light starts with a random phase: a diffuse object that fills the pupil."""
    return s.gray(_hologram(s, _picture(s.shape, 2 * s.turn + 1), s.rng.uniform(0, 2 * math.pi, s.shape)))


def _random(s: _PatternRequest) -> Gray:
    """A random gray level in every pixel."""
    return s.rng.integers(0, 256, s.shape).astype(np.uint8)


def _grains(s: _PatternRequest) -> Gray:
    """Smooth noise; grains of 4, 2.5 and 8 pixels in turn, wide in phase, so that all gray levels have
    neighbours.
    """
    grain = (4.0, 2.5, 8.0)[s.turn % 3]
    noise = scipy.fft.rfft2(s.rng.standard_normal(s.shape))
    fy, fx = np.fft.fftfreq(s.shape[0])[:, None], np.fft.rfftfreq(s.shape[1])[None, :]
    smooth = scipy.fft.irfft2(noise * np.exp(-2 * (grain * math.pi / 2) ** 2 * (fy**2 + fx**2)), s.shape)
    return s.gray(smooth / smooth.std() * 2.5)


def _ramps(s: _PatternRequest) -> Gray:
    """Tiles of blazed ramps, each to its own place in the pupil and with its own part of the gray levels."""
    return _tiles(s, lambda y, x, fy, fx, low, high: low + (high - low) * np.mod(fy * y + fx * x, 1))


def _gratings(s: _PatternRequest) -> Gray:
    """Tiles of sinusoidal gratings of several periods, rows and columns, and depths."""

    def grating(y: Array, x: Array, fy: float, fx: float, low: float, high: float) -> Array:
        f, t = (fy, y) if abs(fy) > abs(fx) else (fx, x)
        return low + (high - low) * (0.5 + 0.5 * np.sin(2 * math.pi * f * t))

    return _tiles(s, grating)


def _checkers(s: _PatternRequest) -> Gray:
    """Tiles of checkerboards of two gray levels, squares of 1 to 8 pixels."""

    def checker(y: Array, x: Array, fy: float, fx: float, low: float, high: float) -> Array:
        side = max(1, round(0.25 / max(abs(fy), abs(fx), 0.03)))
        return np.where((y // side + x // side) % 2 == 0, low, high)

    return _tiles(s, checker)


def _flat(s: _PatternRequest) -> Gray:
    """One gray level everywhere."""
    return np.full(s.shape, (0, 128, 64, 192)[s.turn % 4], np.uint8)


# fmt: off
_ORDER = (  # the middle one of every line is held out, and others of its kind are not
    "smooth_picture", "random", "rough_picture",
    "grains", "rough_picture", "random",
    "ramps", "smooth_picture", "gratings",
    "checkers", "grains", "flat",
)
# fmt: on
_KINDS: dict[str, Callable[[_PatternRequest], Gray]] = {
    "smooth_picture": _smooth_picture,
    "rough_picture": _rough_picture,
    "random": _random,
    "grains": _grains,
    "ramps": _ramps,
    "gratings": _gratings,
    "checkers": _checkers,
    "flat": _flat,
}
PATTERN_KINDS = tuple(_KINDS)


def _tiles(s: _PatternRequest, draw: Callable[[Array, Array, float, float, float, float], Array]) -> Gray:
    """A mosaic: `draw(y, x, fy, fx, low, high)` for each tile, frequencies in cycles a pixel, gray levels."""
    height, width = s.shape
    rows, columns = max(1, min(6, height // 24)), max(1, min(8, width // 24))
    gray = np.zeros(s.shape)
    for top, bottom in _spans(height, rows):
        for left, right in _spans(width, columns):
            y, x = np.mgrid[top:bottom, left:right]
            fy, fx = s.rng.uniform(-0.4, 0.4, 2)
            low, high = np.sort(s.rng.uniform(0, 256, 2)) if s.rng.random() < 0.7 else (0.0, 256.0)
            gray[top:bottom, left:right] = draw(y, x, fy, fx, low, high)
    return np.clip(gray, 0, 255).astype(np.uint8)


def _spans(length: int, count: int) -> list[tuple[int, int]]:
    edges = np.linspace(0, length, count + 1).round().astype(int)
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def _hologram(s: _PatternRequest, picture: Array, start: Array) -> Array:
    """Phase on the panel that shows a picture in the ideal image plane, from a starting phase in the image.

    Iterations between panel and image plane; light outside the picture is not constrained.

    References
    ----------
    Gerchberg and Saxton 1972.
    """
    panel = s.bench.panel
    half_width = min(s.bench.iris.half_width, 1.0)
    wavelength, distance = s.bench.channel(s.channel).wavelength, s.plane_mm * 1e-3
    grid = grid_for(panel.shape, panel.pitch, wavelength, distance, half_width, margin=0)
    if grid.padded[0] * grid.padded[1] > MOST_SAMPLES:
        raise InputError(
            f"plane {s.plane_mm:g} mm: light from this panel spreads over {grid.padded[0]} x "
            f"{grid.padded[1]} pixels by then, which is too many to compute; choose a nearer plane"
        )
    fy, fx = (np.fft.fftfreq(n, panel.pitch) for n in grid.padded)
    limits = (
        band_limit(wavelength, distance, grid.padded[0] * panel.pitch),
        band_limit(wavelength, distance, grid.padded[1] * panel.pitch),
    )
    transfer = transfer_function(fy[:, None], fx[None, :], wavelength, distance, limits, "angular_spectrum")
    edge = half_width / (2 * panel.pitch) * (1 + 1e-9)
    inside = (np.abs(fy)[:, None] <= edge) & (np.abs(fx)[None, :] <= edge)
    transfer = (transfer * inside).astype(np.complex64)
    window = (slice(0, panel.height), slice(0, panel.width))
    amplitude = np.sqrt(picture / picture.mean()).astype(np.float32)
    field = np.zeros(grid.padded, np.complex64)
    field[window] = amplitude * np.exp(1j * start)
    phase = np.zeros(panel.shape)
    for iteration in range(ITERATIONS):
        if iteration:
            field = scipy.fft.ifft2(scipy.fft.fft2(field) * transfer)
            arriving = field[window]
            field[window] = amplitude * arriving / np.maximum(np.abs(arriving), 1e-6)
        back = scipy.fft.ifft2(scipy.fft.fft2(field) * np.conj(transfer))[window]
        phase = np.angle(back)
        field = np.zeros(grid.padded, np.complex64)
        field[window] = np.exp(1j * phase)
    return phase


def _picture(shape: tuple[int, int], number: int) -> Array:
    """One of the photographs that scikit-image ships, cut to the panel's shape: irradiance, 0.01 .. 1."""
    from skimage import data

    pixels = np.asarray(getattr(data, PICTURES[number % len(PICTURES)])())
    if pixels.ndim == 3:
        pixels = pixels[..., :3] @ np.array([0.3, 0.59, 0.11])
    height, width = pixels.shape
    scale = min(height / shape[0], width / shape[1])
    tall, wide = scale * shape[0], scale * shape[1]
    box = ((width - wide) / 2, (height - tall) / 2, (width + wide) / 2, (height + tall) / 2)
    picture = Image.fromarray(pixels.astype(np.uint8)).resize(shape[::-1], Image.Resampling.LANCZOS, box)
    return np.maximum((np.asarray(picture) / 255.0) ** 2.2, 0.01)


def _centred(count: int) -> Array:
    return np.arange(count) - (count - 1) / 2
