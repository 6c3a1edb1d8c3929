"""Bright dots in a camera picture: their centres, and how bright they are against their neighbours."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial import cKDTree

from firmware_iface.errors import InputError


def bright_spots(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The bright dots of a camera picture.

    Parameters
    ----------
    image : array [h, w]
        In counts or any scale; an uneven background is allowed.

    Returns
    -------
    float array [n, 2], pixels
        Centres (x, y).
    float array [n]
        Light of each dot, relative to its neighbours'.

    Raises
    ------
    InputError
        If the picture is not a gray one of 16 x 16 pixels or more.
    """
    image = np.asarray(image)
    if image.ndim != 2 or min(image.shape) < 16:
        raise InputError(f"the dot picture has shape {image.shape}: give a gray one, 16 x 16 pixels or more")
    raw = np.nan_to_num(image.astype(np.float32), posinf=0, neginf=0)
    picture: np.ndarray = ndimage.gaussian_filter(raw, 0.7)
    coarse = ndimage.gaussian_filter(_resized(picture, (24, 24), Image.Resampling.BOX), 4)
    background = _resized(coarse, picture.shape, Image.Resampling.BILINEAR)
    light = picture - np.minimum(background, np.median(picture))
    noise = 1.4826 * float(np.median(np.abs(light - np.median(light))))
    bright = float(np.quantile(light, 0.995))
    level = float(np.median(light)) + max(6 * noise, 0.25 * (bright - float(np.median(light))))
    labels, count = ndimage.label(light > level, np.ones((3, 3)))
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    points = []
    for area, (rows, columns) in zip(areas, ndimage.find_objects(labels), strict=True):
        h, w = rows.stop - rows.start, columns.stop - columns.start
        at_edge = not (rows.start and columns.start) or rows.stop == picture.shape[0]
        if area < 4 or at_edge or columns.stop == picture.shape[1] or max(w, h) > 3 * min(w, h):
            continue
        x, y = (columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2
        points.append(_centroid(light, x, y, max(w, h)))
    if len(points) < 9:
        return np.zeros((0, 2)), np.zeros(0)
    xy = np.asarray(points)
    distance, near = cKDTree(xy).query(xy, k=9)
    flux = _flux(light, xy, 0.48 * float(np.median(distance[:, 1])))
    return xy, flux / np.maximum(np.median(flux[near[:, 1:]], axis=1), 1e-9)


def _resized(picture: np.ndarray, shape: tuple[int, ...], method: Image.Resampling) -> np.ndarray:
    """A picture [h, w] resized to `shape`."""
    return np.asarray(Image.fromarray(picture).resize((shape[1], shape[0]), method))


def _flux(light: np.ndarray, xy: np.ndarray, radius: float) -> np.ndarray:
    """The light within radius pixels of each point, [n], above what is on the rim."""
    reach = math.ceil(radius) + 1
    flux = np.zeros(len(xy))
    for number, (x, y) in enumerate(xy):
        left, top = max(round(x) - reach, 0), max(round(y) - reach, 0)
        part = light[top : round(y) + reach + 1, left : round(x) + reach + 1]
        away = np.hypot(np.arange(part.shape[1]) + left - x, np.arange(part.shape[0])[:, None] + top - y)
        inside = np.clip(radius + 0.5 - away, 0, 1)
        rim = part[np.abs(away - radius) < 0.8]
        flux[number] = float(((part - (np.median(rim) if rim.size else 0)) * inside).sum())
    return flux


def _centroid(light: np.ndarray, x: float, y: float, size: float) -> tuple[float, float]:
    """The centre of a dot near (x, y), by its moments under a Gaussian window that follows it."""
    sigma = max(size / 2.5, 1.0)
    reach = math.ceil(3.5 * sigma)
    for _ in range(12):
        left, top = max(round(x) - reach, 0), max(round(y) - reach, 0)
        part = light[top : round(y) + reach + 1, left : round(x) + reach + 1]
        part = np.maximum(part - np.quantile(part, 0.1), 0)
        u, v = np.arange(part.shape[1]) + left - x, np.arange(part.shape[0])[:, None] + top - y
        weight = part * np.exp(-(u**2 + v**2) / (2 * sigma**2))
        total = float(weight.sum()) + 1e-12
        dx, dy = float((weight * u).sum()) / total, float((weight * v).sum()) / total
        spread = float((weight * (u**2 + v**2)).sum()) / total / 2
        width = math.sqrt(1 / max(1 / max(spread, 1e-3) - 1 / sigma**2, 1 / (9 * sigma**2)))
        # the window pulls the moments towards its own centre: the step is lengthened by what it takes away
        stretch = 1 + (width / sigma) ** 2
        step = min(1.0, reach / (2 * stretch * math.hypot(dx, dy) + 1e-9))
        x, y = x + stretch * dx * step, y + stretch * dy * step
        if not (0 <= x < light.shape[1] and 0 <= y < light.shape[0]):
            break
        if math.hypot(dx, dy) < 1e-3:
            break
    return float(x), float(y)
