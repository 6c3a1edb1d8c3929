"""Starting points estimated from the captures, for effects that a derivative at "absent" does not reach.

The displacement between prediction and picture is found tile by tile, from the peak of their cross-correlation. A
second, displaced picture is found from the cross-correlation of the residual with the prediction.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from runtime.lightpath.grid import at_pixels
from runtime.lightpath.light_path import image_field, panel_phase, panel_spectrum
from trainer.captures.bench_file import Bench
from trainer.captures.conventions import Sample
from trainer.captures.distance_search import best_distance
from trainer.device import array_of
from trainer.effects.evidence import Evidence
from trainer.prediction.predict import bare_irradiance, light_path
from trainer.prediction.scene import bare_stages, scene_at

Starts = list[dict[str, Any]]
SEARCHED = 2  # captures of a colour and plane on which its distance is searched
REACH = 2.0  # pitch^2 / wavelength: from so far a fit of the distance finds the right one
# The squared error, as a share of the signal's variance, of a model that is wrong in its distance alone, by REACH; of
# pictures that are smoothed it is less by far.
OUT_OF_REACH = 0.25
_DISTANCES: dict[
    tuple[Any, ...], float | None
] = {}  # found before in this process: every diagnosis asks again
TILE = 64
# Of a coherent ghost: within it three colours of a display tell path differences apart.
PATH_REACH_NM = 4000.0


def distance_starts(evidence: Sequence[Evidence]) -> Starts:
    """The distance at which the first captures fit their patterns best, searched where a fit does not reach."""
    found = _found_distance(evidence[0])
    return [{"offset": 0.0}] + ([] if found is None else [{"offset": found - evidence[0].scene.plane_mm}])


def wavelength_starts(evidence: Sequence[Evidence]) -> Starts:
    """Wavelengths by which every colour's captures fit their patterns best at the stated distances."""
    bench = evidence[0].scene.bench
    offsets = np.zeros(len(bench.channels))
    for row, channel in enumerate(bench.channels):
        scenes = [one for one in evidence if one.scene.channel == channel.name]
        found = [(_found_distance(one), one.scene.plane_mm) for one in scenes]
        ratios = [distance / stated for distance, stated in found if distance is not None]
        if ratios:
            offsets[row] = channel.wavelength_nm * (float(np.mean(ratios)) - 1)
    return [{"offset": 0.0 * offsets}] + ([{"offset": offsets}] if offsets.any() else [])


def _found_distance(evidence: Evidence) -> float | None:
    """The distance, mm, at which a scene's captures fit their patterns best.

    None where none has structure, and where the model predicts so much of pictures as they are that a fit reaches the
    right one.
    """
    scene, batch = evidence.scene, evidence.batch
    if batch.seen is None and batch.errors(evidence.prediction).nrmse ** 2 < OUT_OF_REACH:
        return None
    digest = hashlib.sha256()
    for array in (batch.gray, batch.signal, batch.mask):
        digest.update(array_of(array[:SEARCHED]).tobytes())
    key = (scene.bench, scene.channel, scene.plane_mm, scene.method, digest.digest())
    if key not in _DISTANCES:
        if len(_DISTANCES) >= 64:
            _DISTANCES.clear()
        samples = [
            Sample(
                batch.ids[k],
                array_of(batch.gray[k]).astype(np.uint8),
                array_of(batch.signal[k].float()),
                array_of(batch.mask[k]) > 0,
                scene.channel,
                scene.plane_mm,
            )
            for k in range(min(SEARCHED, len(batch.ids)))
        ]

        def predict(bench: Bench, gray: NDArray, channel: str, plane_mm: float) -> NDArray:
            return bare_irradiance(scene_at(bench, channel, plane_mm, scene.method, 1.0, torch.float32), gray)

        found = best_distance(scene.bench, samples, predict, finest=REACH)
        _DISTANCES[key] = None if found is None else found.distance_mm
    return _DISTANCES[key]


def displacements(evidence: Evidence) -> tuple[NDArray, NDArray, NDArray]:
    """How far the picture lies from the prediction, tile by tile.

    Returns
    -------
    centres : float array [n, 2], camera pixels
        Of the tiles (row, column), from the picture's centre.
    shifts : float array [n, 2], camera pixels
        (row, column); a positive shift moves the picture's content down or right.
    weights : float array [n]
    """
    batch = evidence.batch
    observed = array_of((batch.signal * batch.mask).double())
    expected = array_of((evidence.prediction * batch.mask).double())
    height, width = observed.shape[-2:]
    size = min(TILE, height // 2, width // 2)
    taper = np.outer(np.hanning(size + 2)[1:-1], np.hanning(size + 2)[1:-1])
    centres, shifts, weights = [], [], []
    for top in _tops(height, size):
        for left in _tops(width, size):
            place = (slice(None), slice(top, top + size), slice(left, left + size))
            peak = _peak(_correlation(observed[place], expected[place], taper))
            centres.append((top + (size - height) / 2, left + (size - width) / 2))
            shifts.append(peak[:2])
            weights.append(max(peak[2], 0.0) ** 2)
    return np.array(centres), np.array(shifts), np.array(weights)


def registration_starts(evidence: Sequence[Evidence]) -> Starts:
    """Shift, rotation and magnification that bring the prediction onto the picture."""
    centres, shifts, weights = displacements(evidence[0])
    y, x = centres.T
    zero, one = np.zeros_like(y), np.ones_like(y)
    # A camera pixel receives light from a place that much farther on: opposite to the content's shift.
    rows = np.concatenate([np.stack([one, zero, x, y], 1), np.stack([zero, one, -y, x], 1)])
    solution = _robust(rows, np.concatenate([-shifts[:, 0], -shifts[:, 1]]), np.tile(weights, 2))
    shift = np.median(-shifts[weights > np.median(weights) / 2], axis=0)
    return [
        {
            "shift_y": solution[0],
            "shift_x": solution[1],
            "rotation": 1e3 * solution[2],
            "magnification": 1e2 * solution[3],
        },
        {"shift_y": shift[0], "shift_x": shift[1]},
    ]


def wavefront_starts(evidence: Sequence[Evidence]) -> Starts:
    """Legendre terms (second order) of the wavefront whose slope causes the picture's displacement.

    A phase slope k (rad/m) at the panel moves light by lambda z k / (2 pi).
    """
    one = evidence[0]
    bench = one.scene.bench
    centres, shifts, weights = _on_panel(bench, *displacements(one))
    half = np.array(bench.panel.shape) / 2
    to_pixels = one.scene.wavelength * one.scene.plane_mm * 1e-3 / (2 * math.pi * bench.panel.pitch**2)
    y, x = (centres / half).T
    zero, unit = np.zeros_like(y), np.ones_like(y)
    # Slopes of P1(y), P1(x), P2(y), P1(y) P1(x), P2(x) in the order of `legendre_maps`: (0,1),(1,0) then n = 2.
    slope_y = np.stack([unit, zero, 3 * y, x, zero], 1) / half[0]
    slope_x = np.stack([zero, unit, zero, y, 3 * x], 1) / half[1]
    rows = to_pixels * np.concatenate([slope_y, slope_x])
    solution = _robust(rows, np.concatenate([shifts[:, 0], shifts[:, 1]]), np.tile(weights, 2))
    colour = one.scene.wavelength / bench.channels[0].wavelength
    return [{"wavefront": solution * colour}]


def ghost_starts(evidence: Sequence[Evidence], most: int = 3) -> Starts:
    """Displacements, panel pixels, at which the residual looks most like the prediction."""
    one = evidence[0]
    batch = one.batch
    residual = array_of(((batch.signal - one.prediction) * batch.mask).double())
    expected = array_of(one.prediction.double())
    height, width = expected.shape[-2:]
    taper = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    starts = []
    for sharp in (False, True):  # the sharp one parts a far copy from what is wrong near by
        correlation = np.abs(_correlation(residual, expected, taper, whiten=False, sharp=sharp))
        for _, displacement in _peaks(correlation, most):
            moved = np.array([displacement], float)
            _, shift, _ = _on_panel(one.scene.bench, np.zeros((1, 2)), moved, np.ones(1))
            starts.append({"amplitude": 0.02, "shift_y": shift[0, 0], "shift_x": shift[0, 1]})
    return starts


def coherent_ghost_starts(evidence: Sequence[Evidence], most: int = 2) -> Starts:
    """Displacements (panel pixels), amplitudes and path differences of a second field that interferes with the first.

    A copy a u(r - s) changes irradiance by 2 Re[a* u(r) u*(r - s)]. So the correlation of the residual times the
    field with the field has its peak at the displacement, and the peak's phase is the copy's. From colour to colour
    that phase turns with the path difference.
    """
    first = evidence[0].scene
    others = (o for o in evidence if o.scene.plane_mm == first.plane_mm and o.scene.channel != first.channel)
    colours = [evidence[0], *others]
    copies = [_copies(one) for one in colours]
    wavelengths_nm = [1e9 * one.scene.wavelength for one in colours]
    starts = []
    for place, shift in _peaks(np.abs(copies[0]), most):
        amplitudes = []
        for one, copy in zip(colours, copies, strict=True):
            # `image_field` leaves out a linear phase, by the band's first frequency.
            grid = one.scene.grid
            turn = sum(b * n / p for b, n, p in zip(grid.band, shift, grid.padded, strict=True))
            amplitudes.append(complex(copy[place] * np.exp(-2j * np.pi * turn)))
        path = _path_difference(amplitudes, wavelengths_nm)
        waves = path * (1 / wavelengths_nm[0] - 1 / first.bench.channels[0].wavelength_nm)
        at_reference = amplitudes[0] * np.exp(-2j * np.pi * waves)
        starts.append(
            {
                "real": float(np.clip(at_reference.real, -0.5, 0.5)),
                "imaginary": float(np.clip(at_reference.imag, -0.5, 0.5)),
                "shift_y": float(shift[0]),
                "shift_x": float(shift[1]),
                "path_difference": path,
            }
        )
    return starts


def _copies(one: Evidence) -> NDArray:
    """Complex amplitude of a copy of the field at each displacement, on the first captures of a colour and plane."""
    scene, batch = one.scene, one.batch
    with torch.no_grad():
        path = light_path(scene, bare_stages(scene))
        total: NDArray | float = 0.0
        for k in range(min(SEARCHED, len(batch.ids))):
            spectrum = panel_spectrum(path, panel_phase(path, batch.gray[k : k + 1]))
            field = array_of(at_pixels(scene.grid, image_field(path, spectrum, 0))[0])
            power = float((np.abs(field) ** 2).sum())
            residual = _on_panel_pixels(scene.bench, ((batch.signal - one.prediction) * batch.mask)[k])
            scale = float(one.prediction[k].sum()) / max(power, 1e-30)
            shape = [2 * n for n in field.shape]
            cross = np.fft.fft2(residual * field, shape) * np.conj(np.fft.fft2(field, shape))
            total = total + np.fft.ifft2(cross) / max(scale * power**2 / field.size, 1e-30)
    return np.asarray(total / min(SEARCHED, len(batch.ids)))


def _path_difference(amplitudes: Sequence[complex], wavelengths_nm: Sequence[float]) -> float:
    """The path difference (nm) by which a copy's phases differ from the first colour's: of several, the least."""
    paths = np.arange(-PATH_REACH_NM, PATH_REACH_NM + 1, 10.0)
    fit = np.zeros(len(paths))
    for amplitude, wavelength in zip(amplitudes[1:], wavelengths_nm[1:], strict=True):
        turned = np.exp(2j * np.pi * paths * (1 / wavelength - 1 / wavelengths_nm[0]))
        fit += (np.conj(amplitude) * amplitudes[0] * turned).real
    alike = np.flatnonzero(fit >= fit.max() - 0.02 * abs(fit.max()))
    return float(paths[alike[np.abs(paths[alike]).argmin()]])


def _peaks(size: NDArray, most: int) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """The highest places of a periodic map away from its first sample, and the displacement of each; cleared."""
    for place in _near(0, 0, size.shape):
        size[place] = 0
    for _ in range(most):
        i, j = (int(n) for n in np.unravel_index(int(size.argmax()), size.shape))
        dy, dx = (n - full if n > full / 2 else n for n, full in zip((i, j), size.shape, strict=True))
        yield (i, j), (dy, dx)
        for place in _near(i, j, size.shape):
            size[place] = 0


def _near(i: int, j: int, shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Places at most two samples from one, on a period."""
    return [((i + a) % shape[0], (j + b) % shape[1]) for a in range(-2, 3) for b in range(-2, 3)]


def _on_panel_pixels(bench: Bench, picture: torch.Tensor) -> NDArray:
    """A camera's picture summed into the panel pixels that its pixels look at: [H, W]."""
    if bench.camera.registered:
        return array_of(picture.double())
    y, x = bench.camera.looks_at()
    rows, columns = np.rint(y).astype(int), np.rint(x).astype(int)
    height, width = bench.panel.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    total = np.zeros((height, width))
    np.add.at(total, (rows[inside], columns[inside]), array_of(picture.double())[inside])
    return total


def gain_spread(evidence: Sequence[Evidence]) -> dict[str, Any]:
    """Standard deviation (%) of the gain from capture to capture, about each colour's mean."""
    own: dict[str, list[float]] = {}
    for one in evidence:
        observed, expected, weight = (t.double() for t in (one.batch.signal, one.prediction, one.batch.mask))
        gains = (weight * observed * expected).sum((-2, -1)) / (weight * expected**2).sum((-2, -1))
        own.setdefault(one.batch.channel, []).extend(gains.tolist())
    deviations = np.concatenate([np.array(g) / np.mean(g) - 1 for g in own.values()])
    return {"spread": max(0.01, 100 * float(np.std(deviations)))}


def _on_panel(
    bench: Bench, centres: NDArray, shifts: NDArray, weights: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Displacements as `displacements` gives them, in panel pixels; centres from the panel's."""
    camera = bench.camera
    middle = (np.array(camera.shape) - 1) / 2
    there = np.stack(camera.on_panel(*(centres + middle).T), 1)
    moved = np.stack(camera.on_panel(*(centres + middle + shifts).T), 1)
    return there - (np.array(bench.panel.shape) - 1) / 2, moved - there, weights


def _tops(length: int, size: int) -> list[int]:
    count = max(2, round(1.5 * length / size))
    return [round(k * (length - size) / (count - 1)) for k in range(count)]


def _correlation(
    observed: NDArray, expected: NDArray, taper: NDArray, whiten: bool = True, sharp: bool = False
) -> NDArray:
    """Circular cross-correlation over the captures, normalised so that 1 is a perfect match; peak at the shift.

    With `sharp`, divided by the expected picture's own spectrum (Wiener), so that a copy is a point.
    """
    a, b = (
        np.fft.fft2((t - t.mean((-2, -1), keepdims=True)) * taper, axes=(-2, -1))
        for t in (observed, expected)
    )
    cross = (a * np.conj(b)).sum(0)
    if sharp:
        power = (np.abs(b) ** 2).sum(0)
        cross = cross / (power + 0.1 * power.mean())
    if whiten:
        cross = cross / np.sqrt(np.abs(cross) + 1e-3 * np.abs(cross).max() + 1e-30)
    result = np.fft.ifft2(cross).real
    return result / (np.sqrt((np.abs(cross) ** 2).sum()) / cross.size**0.5 + 1e-30)


def _peak(correlation: NDArray) -> tuple[float, float, float]:
    """Place (rows, columns; signed, to a fraction of a pixel) and height of the highest peak."""
    height, width = correlation.shape
    i, j = (int(k) for k in np.unravel_index(int(correlation.argmax()), correlation.shape))

    def part(before: float, here: float, after: float) -> float:
        bend = before - 2 * here + after
        return 0.0 if bend >= 0 else max(-0.5, min(0.5, 0.5 * (before - after) / bend))

    dy = part(correlation[i - 1, j], correlation[i, j], correlation[(i + 1) % height, j])
    dx = part(correlation[i, j - 1], correlation[i, j], correlation[i, (j + 1) % width])
    y, x = i + dy, j + dx
    return (y - height if y > height / 2 else y, x - width if x > width / 2 else x, float(correlation[i, j]))


def _robust(rows: NDArray, values: NDArray, weights: NDArray) -> NDArray:
    """Weighted least squares that gives outliers less weight (Huber, a few rounds)."""
    weights = weights + 1e-12
    solution = np.zeros(rows.shape[1])
    factor = np.ones_like(values)
    for _ in range(6):
        root = np.sqrt(weights * factor)
        solution = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
        error = np.abs(values - rows @ solution)
        typical = max(1.5 * float(np.median(error)), 0.05)
        factor = np.minimum(1, typical / np.maximum(error, 1e-12))
    return solution
