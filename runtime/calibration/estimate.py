"""What is believed of a headset (`Estimate`), and what it predicts of the headset's captures (`Shot`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from runtime.calibration.drift import Drift, drifted
from runtime.camera.view import Sampler, View
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase


@dataclass(frozen=True)
class ColourLightPath:
    """A colour's light path as the bundle has it.

    Attributes
    ----------
    path : LightPath
    wavelength_nm : float, nm
    """

    path: LightPath
    wavelength_nm: float


@dataclass(frozen=True)
class Shot:
    """One capture, kept in half of the memory of its signal and weight: a calibration has a hundred of them.

    Attributes
    ----------
    channel : str
    gray : uint8 array [H, W]
        The pattern that was shown.
    counts : uint16 or float32 array [h, w]
        As the camera gave them.
    black : float, counts
        Black level.
    weight_halves : uint16 array [h, w]
        The upper halves of `weight`, which hold it to 0.4 %.
    """

    channel: str
    gray: np.ndarray
    counts: np.ndarray
    black: float
    weight_halves: np.ndarray

    @property
    def signal(self) -> np.ndarray:
        """Counts above black, float32 [h, w]."""
        return self.counts - np.float32(self.black)

    @property
    def weight(self) -> np.ndarray:
        """Inverse variance of the signal's noise, 1 / counts^2; 0 where saturated: float32 [h, w]."""
        return (self.weight_halves.astype(np.uint32) << 16).view(np.float32)

    def rows(self, which: slice) -> Shot:
        """The capture with some of its rows alone."""
        counts, halves = (a[which].copy() for a in (self.counts, self.weight_halves))
        return replace(self, counts=counts, weight_halves=halves)


def shot_of(channel: str, gray: np.ndarray, counts: np.ndarray, black: float, weight: np.ndarray) -> Shot:
    """A capture with weights [h, w], 1 / counts^2, each rounded to the 8 bits that are kept of it."""
    bits = np.ascontiguousarray(weight, np.float32).view(np.uint32)
    return Shot(channel, gray, counts, black, ((bits + np.uint32(0x8000)) >> 16).astype(np.uint16))


@dataclass(frozen=True)
class Estimate:
    """What is believed of a headset.

    Attributes
    ----------
    drift : Drift
        Of its light.
    view : View
        Of its camera.
    """

    drift: Drift
    view: View


def predicted(base: ColourLightPath, shot: Shot, estimate: Estimate, sample: Sampler) -> np.ndarray:
    """What the camera sees of a shot's pattern.

    Parameters
    ----------
    base : ColourLightPath
    shot : Shot
        Its colour and pattern are used.
    estimate : Estimate
    sample : Sampler
        Of the estimate's view.

    Returns
    -------
    float32 array [h, w], counts above black per unit of gain
        With stray light.
    """
    path = drifted(base.path, shot.channel, base.wavelength_nm, estimate.drift)
    image = irradiance(path, panel_phase(path, shot.gray.astype(np.int64)))
    return light_on_camera(estimate.view, sample, image)


def light_on_camera(view: View, sample: Sampler, image: np.ndarray) -> np.ndarray:
    """What a camera makes of irradiance on the fine grid, up to a gain: float32 [h, w]."""
    return with_stray(view, view.evenness().astype(np.float32), sample(image))


def with_stray(view: View, even: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Light on camera pixels [h, w] with a view's evenness [h, w] and stray light: float32 [h, w]."""
    return (light * even + np.float32(view.stray * float(light.mean()))).astype(np.float32)


def gain_of(shot: Shot, light: np.ndarray) -> float:
    """The factor on a prediction that brings it nearest to a capture."""
    weighted = shot.weight * light
    return float(np.vdot(weighted, shot.signal)) / max(float(np.vdot(weighted, light)), 1e-30)
