"""Exposure brackets: pictures of one pattern at several exposures, which count as one capture.

Rows of captures.csv with the same text in the column `bracket` are one. A long exposure has little noise in the dark,
and a short one shows what the long one saturates (Debevec and Malik 1997; weights after Granados et al. 2010).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import SURE, noise_variance
from trainer.captures.capture_table import Capture, RowFault
from trainer.captures.equal_patterns import same_gray_levels

NEAR_TOP = 0.9  # of full scale, up to which two frames' brightness is compared: saturation must not choose the pixels


@dataclass(frozen=True)
class Measured:
    """What a capture says about the light.

    Attributes
    ----------
    signal : float32 array [h, w], counts above black
        Of a bracket: at its shortest exposure, not rounded.
    valid : bool array [h, w]
        False where the pixel is saturated, in a bracket in every frame.
    variance : float32 array [h, w], counts^2
        Of the camera's noise.
    """

    signal: np.ndarray
    valid: np.ndarray
    variance: np.ndarray


def one_capture_each(rows: Sequence[Capture]) -> list[Capture]:
    """The captures of a table's rows: those of one bracket become one, with the id and the place of the first of them.

    Its `rows` are the frames, the shortest exposure first; its image and exposure are the shortest frame's.
    """
    captures: dict[tuple[str, str], Capture] = {}
    frames: dict[tuple[str, str], list[Capture]] = {}
    for number, row in enumerate(rows):
        key = ("bracket", row.bracket) if row.bracket else ("row", str(number))
        captures.setdefault(key, row)
        frames.setdefault(key, []).append(row)
    return [_joined(capture, frames[key]) for key, capture in captures.items()]


def _joined(first: Capture, frames: list[Capture]) -> Capture:
    if not first.bracket:
        return first
    frames = sorted(frames, key=lambda frame: frame.exposure_ms)
    return replace(first, image=frames[0].image, exposure_ms=frames[0].exposure_ms, frames=tuple(frames))


def bracket_faults(rows: Sequence[Capture]) -> list[RowFault]:
    """Everything that keeps the rows of a table's brackets from being merged.

    Parameters
    ----------
    rows : sequence of Capture
        In the order of the table.
    """
    places: dict[str, list[int]] = {}
    for number, row in enumerate(rows):
        if row.bracket:
            places.setdefault(row.bracket, []).append(number)
    return [fault for at in places.values() for fault in _faults(rows, at)]


def _faults(rows: Sequence[Capture], at: list[int]) -> list[RowFault]:
    first, *others = (rows[k] for k in at)
    where = f"bracket {first.bracket!r} of captures.csv"
    if not others:
        message = f"{where} has one capture only: write its name in the rows of its other exposures, or leave it empty"
        return [RowFault("bracket", first.capture, message)]
    if at[-1] - at[0] != len(at) - 1:
        message = f"the rows of {where} do not follow each other: put them in the order in which they were taken, or "
        return [RowFault("bracket", first.capture, message + "give repeats a bracket of their own")]
    faults = []
    exposures = {first.exposure_ms: first.capture}
    for row in others:
        wrong = ""
        if (row.channel, row.plane_mm) != (first.channel, first.plane_mm):
            wrong = f"captures {first.capture} and {row.capture} are of different channels or planes"
        elif not same_gray_levels(first, row):
            wrong = f"captures {first.capture} and {row.capture} show different gray levels"
        elif row.exposure_ms in exposures:
            same = exposures[row.exposure_ms]
            wrong = f"captures {same} and {row.capture} have the same exposure, {row.exposure_ms:g} ms"
        if wrong:
            change = "correct the rows, or give them brackets of their own"
            faults.append(RowFault("bracket", row.capture, f"{where}: {wrong}; {change}"))
        exposures.setdefault(row.exposure_ms, row.capture)
    return faults


def frame_scales(
    pictures: Sequence[np.ndarray], exposures_ms: Sequence[float], camera: Camera
) -> list[float]:
    """Brightness of each picture of a bracket over that of the first.

    The ratio of the exposures, unless pixels that two frames both show say surely otherwise: then the laser drifted
    between them, and the ratio of the pictures counts.

    Parameters
    ----------
    pictures : sequence of uint16 array [h, w], raw counts
        The shortest exposure first.
    exposures_ms : sequence of float, ms
    camera : Camera
    """
    scales = [1.0]
    for k in range(1, len(pictures)):
        stated = exposures_ms[k] / exposures_ms[k - 1]
        dim, bright = (p.astype(np.float64) - camera.black_level for p in (pictures[k - 1], pictures[k]))
        use = (pictures[k] < camera.saturation) & (dim * stated < NEAR_TOP * camera.full_scale)
        below, above = float(dim[use].sum()), float(bright[use].sum())
        noise = noise_variance(bright[use], camera).sum() + stated**2 * noise_variance(dim[use], camera).sum()
        sure = abs(above - stated * below) > SURE * math.sqrt(float(noise))
        scales.append(scales[-1] * (above / below if sure and above > 0 and below > 0 else stated))
    return scales


def merged(pictures: Sequence[np.ndarray], exposures_ms: Sequence[float], camera: Camera) -> Measured:
    """One picture of a bracket's frames: the mean of counts above black over brightness, weighted by the noise.

    The weights come from the camera's noise at the brightness that all frames together show. With those of each frame's
    own counts, a frame whose noise is negative would count for more.

    Parameters
    ----------
    pictures : sequence of uint16 array [h, w], raw counts
        The shortest exposure first; one picture is a bracket, too.
    exposures_ms : sequence of float, ms
    camera : Camera

    Returns
    -------
    Measured

    References
    ----------
    Debevec and Malik, SIGGRAPH 1997; Granados et al., CVPR 2010.
    """
    signals = [p.astype(np.float32) - np.float32(camera.black_level) for p in pictures]
    usable = [p < camera.saturation for p in pictures]
    valid = np.logical_or.reduce(usable)
    scales = [np.float32(s) for s in frame_scales(pictures, exposures_ms, camera)]
    frames = list(zip(signals, usable, scales, strict=True))
    whole = np.maximum(sum(ok * scale for _, ok, scale in frames), scales[0])
    mean = sum(signal * ok for signal, ok, _ in frames) / whole
    weight = np.ones_like(mean)
    for _ in range(2):  # from the shot noise's weights to those with read noise
        weights = [ok * scale**2 / noise_variance(mean * scale, camera) for _, ok, scale in frames]
        weight = np.where(valid, np.add.reduce(weights), 1)
        sums = [w * signal / scale for w, (signal, _, scale) in zip(weights, frames, strict=True)]
        mean = np.add.reduce(sums) / weight
    signal = np.where(valid, mean, signals[0]).astype(np.float32)
    variance = np.where(valid, 1 / weight, noise_variance(signals[0], camera)).astype(np.float32)
    return Measured(signal, valid, variance)
