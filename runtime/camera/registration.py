"""Where the panel's pixels are in the camera's picture: a homography, given or found from a dot pattern.

Points are (x, y) in pixels, x along columns; a pixel's centre has whole coordinates. A homography is 3 x 3,
row-major, and takes the centre of a camera pixel (x, y, 1) to panel pixels (x, y, 1) up to scale.

The dot pattern is a regular grid of dots with one broad dot in the corner nearest to panel pixel (0, 0), and
a second, less broad one next to it along x. Together they tell every mirroring and quarter turn apart.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from firmware_iface.errors import InputError
from runtime.camera.spots import bright_spots

SPREAD = 0.11  # standard deviation of a plain dot, share of the spacing
BROAD = (1.7, 1.35)  # of the marker's two dots, against a plain dot
LIGHT = (1.8, 1.3)  # the least light of the marker's two dots, against their neighbours
TOLERANCE = 0.25  # share of the spacing within which a found dot is an expected one
FEWEST = 0.6  # share of the expected dots that must be found


@dataclass(frozen=True)
class Dots:
    """The dots of a pattern.

    Attributes
    ----------
    xy : float array [n, 2], panel pixels
        Centres, row by row; the marker's two come first.
    spacing : float, panel pixels
    columns, rows : int
    """

    xy: np.ndarray
    spacing: float
    columns: int
    rows: int


def dots_of(shape: tuple[int, int], spacing: float) -> Dots:
    """The dots that `dot_pattern` shows on a panel.

    Parameters
    ----------
    shape : (int, int)
        (height, width) of the panel, pixels.
    spacing : float, panel pixels

    Raises
    ------
    InputError
        If fewer than 4 x 4 dots fit, or a dot would be too small to be shown.
    """
    rows, columns = (int((n - 1.2 * spacing) // spacing) + 1 if spacing > 0 else 0 for n in shape)
    if not spacing >= 8 or rows < 4 or columns < 4:
        raise InputError(
            f"dots {spacing:g} pixels apart do not make a grid of 4 x 4 on a panel of "
            f"{shape[0]} x {shape[1]} pixels: choose a spacing from 8 to {min(shape) / 4.4:.0f}"
        )
    left, top = (shape[1] - 1 - (columns - 1) * spacing) / 2, (shape[0] - 1 - (rows - 1) * spacing) / 2
    grid = [(left + i * spacing, top + j * spacing) for j in range(rows) for i in range(columns)]
    return Dots(np.asarray(grid), float(spacing), columns, rows)


def dot_pattern(shape: tuple[int, int], spacing: float) -> np.ndarray:
    """Gaussian dots on black with an asymmetric marker, as irradiance to aim for.

    Parameters
    ----------
    shape : (int, int)
        (H, W) of the panel, pixels.
    spacing : float, panel pixels

    Returns
    -------
    float32 array [H, W], 0 to 1

    Raises
    ------
    InputError
        As `dots_of` does.
    """
    dots = dots_of(shape, spacing)
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])[None]
    target = np.zeros(shape, np.float32)
    for number, (px, py) in enumerate(dots.xy):
        sigma = SPREAD * spacing * (BROAD[number] if number < 2 else 1.0)
        across = np.exp(-(((x - px) / sigma) ** 2) / 2)
        target = np.maximum(target, np.exp(-(((y - py) / sigma) ** 2) / 2) * across).astype(np.float32)
    return target


def find_homography(image: np.ndarray, dots: Dots, believed: np.ndarray | None = None) -> np.ndarray:
    """The homography of a camera from its picture of a dot pattern.

    Parameters
    ----------
    image : array [h, w]
        In counts or any scale; an uneven background is allowed, and the picture may be mirrored and turned.
    dots : Dots
        Of the pattern.
    believed : float array [3, 3], optional
        A homography that is right to a quarter of the dots' spacing, for pictures in which the marker cannot be told
        from other dots.

    Returns
    -------
    float64 array [3, 3]
        From camera pixels (x, y, 1) to panel pixels (x, y, 1) up to scale; its last number is 1.

    Raises
    ------
    InputError
        If too few dots are seen, or they are not the expected grid.
    """
    points, light = bright_spots(image)
    if len(points) < FEWEST * len(dots.xy):
        raise InputError(
            f"only {len(points)} of {len(dots.xy)} dots are seen in the dot picture: focus the "
            "camera, see that the whole pattern is in view, and expose so that the dots are "
            "bright but not saturated"
        )
    best: tuple[float, np.ndarray] | None = None
    for first, second in _markers(points, light):
        for guess in _guesses(points, first, second, dots):
            fitted = _refined(points, guess, dots)
            if fitted is not None and (best is None or fitted[0] > best[0]):
                best = fitted
        if best is not None and best[0] > len(dots.xy) * 0.9:
            break
    if best is None and believed is not None:
        best = _refined(points, believed, dots)
    if best is None or best[0] < FEWEST * len(dots.xy):
        raise InputError(
            f"{len(points)} dots are seen but they do not fit the expected {dots.columns} x "
            f"{dots.rows} grid with its marker: show this dot pattern with its corner of two "
            "broad dots in view, or space the dots wider if they are less than 8 camera pixels "
            "apart"
        )
    return best[1] / best[1][2, 2]


def panel_points(homography: np.ndarray, camera_xy: np.ndarray) -> np.ndarray:
    """Points of the panel that camera points look at.

    Parameters
    ----------
    homography : float array [3, 3]
    camera_xy : float array [n, 2], camera pixels
        Points (x, y).

    Returns
    -------
    float array [n, 2], panel pixels
        Points (x, y).
    """
    points = np.concatenate([camera_xy, np.ones((len(camera_xy), 1))], 1) @ np.asarray(homography).T
    return points[:, :2] / points[:, 2:]


def _markers(points: np.ndarray, light: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of neighbouring dots that may be the marker (its broad dot, its second), the likeliest first."""
    order = [int(i) for i in np.argsort(-light)[:6] if light[i] > LIGHT[1]]
    tree = cKDTree(points)
    step = float(np.median(tree.query(points, k=2)[0][:, 1]))
    pairs = [
        (float(light[a] + light[b]), a, b)
        for a, b in itertools.permutations(order, 2)
        if light[a] > max(light[b], LIGHT[0]) and np.hypot(*(points[a] - points[b])) < 1.6 * step
    ]
    return [(a, b) for _, a, b in sorted(pairs, reverse=True)[:4]]


def _guesses(points: np.ndarray, first: int, second: int, dots: Dots) -> list[np.ndarray]:
    """Affine guesses of the homography, [3, 3], for a marker: plain and mirrored."""
    along = points[second] - points[first]
    guesses = []
    for side in (1.0, -1.0):
        # the dot of the next row is where a right angle puts it, or the nearest that is seen
        corner = points[first] + side * np.array([-along[1], along[0]])
        near = points[int(np.argmin(np.hypot(*(points - corner).T)))]
        if np.hypot(*(near - corner)) > 0.45 * np.hypot(*along):
            continue
        camera = np.stack([points[first], points[second], near])
        guess = _fitted_map(camera, dots.xy[[0, 1, dots.columns]], perspective=False)
        if guess is not None:
            guesses.append(guess)
    return guesses


def _refined(points: np.ndarray, guess: np.ndarray, dots: Dots) -> tuple[float, np.ndarray] | None:
    """How many dots a guess explains once grown over the grid, and the homography; None if it does not."""
    tree = cKDTree(dots.xy)
    homography = guess
    origin = dots.xy[0]
    for reach in (2.5, 4, 7, 12, 24, 1e9, 1e9, 1e9):
        where = panel_points(homography, points)
        distance, index = tree.query(where)
        near = (distance < TOLERANCE * dots.spacing) & (np.hypot(*(where - origin).T) < reach * dots.spacing)
        keep = np.flatnonzero(near)
        _, only = np.unique(index[keep], return_index=True)
        keep = keep[only]
        if reach > 1e6 and len(keep) > 16:
            # the marker's broad dots shift each other's centres: they guide the search, but are not measured
            keep = keep[index[keep] > 1]
        if len(keep) < 4:
            return None
        camera, panel = points[keep], dots.xy[index[keep]]
        # too few for a perspective: an affine map, which does not bend
        found = _fitted_map(camera, panel, len(keep) >= 9, max(0.05 * dots.spacing, 1.0))
        if found is None or not np.isfinite(found).all():
            return None
        homography = found
    error = np.hypot(*(panel_points(homography, camera) - panel).T)
    return float((error < 0.1 * dots.spacing).sum()), homography


def _fitted_map(
    camera: np.ndarray, panel: np.ndarray, perspective: bool, tolerance: float = 3.0
) -> np.ndarray | None:
    """The homography, or affine map, [3, 3], that takes camera points [n, 2] to panel points [n, 2], by OpenCV.

    Points farther off than `tolerance` (panel pixels) are left out (RANSAC). None where there is no such map.
    """
    import cv2  # only a dot pattern needs it on the headset

    if perspective:
        found, _ = cv2.findHomography(camera, panel, cv2.RANSAC, tolerance)
        return None if found is None else np.asarray(found)
    if len(camera) == 3:
        affine = cv2.getAffineTransform(camera.astype(np.float32), panel.astype(np.float32))
    else:
        affine, _ = cv2.estimateAffine2D(camera, panel, ransacReprojThreshold=tolerance)
    return None if affine is None else np.vstack([affine, [0, 0, 1]])
