"""What is believed of a headset (`Estimate`), and what it predicts of the headset's captures (`Shot`)."""

from __future__ import annotations

from dataclasses import dataclass

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
    """One capture.

    Attributes
    ----------
    channel : str
    gray : uint8 array [H, W]
        The pattern that was shown.
    signal : float32 array [h, w], counts
        Above black.
    weight : float32 array [h, w], 1 / counts^2
        Inverse variance of the signal's noise; 0 where saturated.
    """

    channel: str
    gray: np.ndarray
    signal: np.ndarray
    weight: np.ndarray


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
    return float(np.vdot(shot.weight * light, shot.signal)) / max(
        float(np.vdot(shot.weight * light, light)), 1e-30
    )
