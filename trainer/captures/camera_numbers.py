"""Gain and read noise of the camera, measured from repeated pictures, where bench.toml is silent or clearly wrong.

Photon transfer (Janesick 2007): light makes noise whose variance is the mean count above black times the counts that
one electron adds, on top of the read noise. Two pictures of one pattern differ by this noise alone. Where the variance
does not follow a straight line, or where neighbouring pixels differ alike, something else changes, such as vibration,
and nothing is measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from runtime.excess import PredictionErrors
from trainer.captures.bench_file import Camera
from trainer.captures.camera_noise import RepeatNoise, noise_variance, straight_line
from trainer.captures.capture_table import Capture

MOST_PAIRS = 12  # pairs of repeated pictures that are compared
MEASURED_PAIRS = 4  # of them, those that the camera's numbers are measured from
CLEARLY_WRONG = 1.1  # noise variance over the stated one's, or its inverse
MOST_READ_NOISE = 0.005  # of full scale, or
READ_NOISE_FACTOR = 8.0  # times the stated, whichever is more, up to which a read noise is believed
SIGMAS = 5.0  # by which the measured noise must differ from the stated


@dataclass(frozen=True)
class PhotonTransfer:
    """The camera's noise, as repeated pictures show it.

    Attributes
    ----------
    full_well_e, full_well_error : float, electrons
        At full scale above black, and its standard error.
    read_noise_e : float, electrons
    ratio, ratio_error : float
        Measured noise variance over the stated one's, averaged over the pixels, and its standard error.
    """

    full_well_e: float
    full_well_error: float
    read_noise_e: float
    ratio: float
    ratio_error: float

    def differs(self) -> bool:
        """Whether the stated numbers are clearly wrong."""
        far = max(self.ratio, 1 / self.ratio) > CLEARLY_WRONG
        return far and abs(self.ratio - 1) > SIGMAS * self.ratio_error


def repeated_pairs(captures: Iterable[Capture]) -> list[tuple[Capture, Capture]]:
    """Captures of one pattern, colour, plane and exposure that follow each other, MOST_PAIRS at most.

    Brackets are paired frame by frame.
    """
    groups: dict[tuple[str, float, str, float], list[Capture]] = {}
    for c in (row for capture in captures for row in capture.rows):
        groups.setdefault((c.channel, c.plane_mm, c.pattern, c.exposure_ms), []).append(c)
    return [pair for group in groups.values() for pair in pairwise(group)][:MOST_PAIRS]


def photon_transfer(repeats: Sequence[RepeatNoise], camera: Camera) -> PhotonTransfer | None:
    """Full well and read noise from the line of variance against mean.

    Returns
    -------
    PhotonTransfer or None
        None where the pictures hold too few brightnesses for a line, where the variance follows none, or where what
        does not depend on brightness is far more than a camera reads with: then something else differs.
    """
    line = straight_line(repeats, camera)
    if line is None or not all(r.is_noise for r in repeats):
        return None
    ratio = float(np.mean([r.ratio for r in repeats]))
    # A mean of squares has twice the relative variance of one square over their number; they differ in brightness, too.
    spread = math.sqrt(sum(r.ratio_error**2 for r in repeats)) / len(repeats)
    floor = math.sqrt(max(line.at_black - 1 / 12, 0.0))
    if floor > max(
        MOST_READ_NOISE * camera.full_scale,
        READ_NOISE_FACTOR * camera.read_noise_e * camera.counts_per_electron,
    ):
        return None
    return PhotonTransfer(
        camera.full_scale / line.slope,
        camera.full_scale / line.slope * line.slope_error / line.slope,
        floor / line.slope,
        ratio,
        spread,
    )


def camera_by_repeats(camera: Camera, repeats: Sequence[RepeatNoise]) -> Camera:
    """The camera with the full well and read noise that the repeats show.

    The camera itself where bench.toml states numbers that are not clearly wrong, or where nothing can be measured.
    """
    found = photon_transfer(repeats, camera) if repeats else None
    if found is None or (camera.noise_stated and not found.differs()):
        return camera
    return replace(camera, full_well_e=found.full_well_e, read_noise_e=found.read_noise_e)


def camera_of_residual(errors: PredictionErrors, camera: Camera) -> Camera | None:
    """The camera with the full well and read noise that the residual of a complete model shows.

    Photon transfer of the captures themselves: the squared error of each tile of the pictures against the mean signal
    there, which the stated noise tells.

    Parameters
    ----------
    errors : PredictionErrors
        Of a model that leaves nothing but noise.
    camera : Camera
        With the stated numbers that the errors' expected noise was computed from.

    Returns
    -------
    Camera or None
        None where brightness varies too little over the tiles for a line.
    """
    inside = errors.noise > 0.5 * np.median(
        errors.noise
    )  # not those that are cut off at the border, or saturated
    pixels = np.broadcast_to(errors.pixels[:, None] / errors.noise.shape[-1], errors.noise.shape)[inside]
    gain = camera.counts_per_electron
    signal = (errors.noise[inside] / pixels - noise_variance(0.0, camera)) / gain
    squared = errors.squared[inside] / pixels
    if signal.size < 16 or np.ptp(signal) < 0.02 * camera.full_scale:
        return None
    slope, floor = np.polyfit(signal, squared, 1, w=1 / np.maximum(errors.noise[inside] / pixels, 1e-12))
    if slope <= 0:
        return None
    read = math.sqrt(max(float(floor) - 1 / 12, 0.0)) / float(slope)
    return replace(camera, full_well_e=camera.full_scale / float(slope), read_noise_e=read)


def numbers_text(stated: Camera, used: Camera) -> str:
    """Which of the camera's numbers were measured, in one sentence; "" where the stated ones are used."""
    if used == stated:
        return ""
    measured = f"full_well_e = {used.full_well_e:.4g} and read_noise_e = {used.read_noise_e:.2g}"
    if not stated.noise_stated:
        return (
            f"bench.toml does not state the camera's noise: repeated pictures show {measured}, which are used"
        )
    text = (
        f"camera.full_well_e = {stated.full_well_e:g} and read_noise_e = {stated.read_noise_e:g} do not fit the noise "
        f"of repeated pictures: these show {measured}, which are used"
    )
    if (depth := equal_depth(stated, used)) is not None:
        text += f"; bit_depth = {depth} instead of {stated.bit_depth} would explain it, too"
    return text


def equal_depth(stated: Camera, used: Camera) -> int | None:
    """The bit depth that would explain the noise as well as the full well that was measured; None where none would."""
    bits = math.log2(used.full_well_e / stated.full_well_e)
    depth = stated.bit_depth - round(bits)
    return depth if round(bits) and abs(bits - round(bits)) < 0.1 and 4 <= depth <= 16 else None
