"""Light on the camera, for light in the image, and the counts that the camera makes of it: all that follows `trace`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from runtime.camera.sampling import (
    finer_picture,
    pixel_area,
    registered_samples,
    sample_places,
    spline_filter,
)
from runtime.lightpath.fft import rfft2
from runtime.lightpath.grid import image_frequencies
from trainer.kept_results import kept_by_device, kept_for_same
from trainer.prediction.capture_gain import own_gain
from trainer.prediction.capture_motion import Motion, MotionNearby, measured_motion, motion_nearby
from trainer.prediction.samples_at import samples_at
from trainer.prediction.scene import Scene, Stages
from trainer.prediction.stages import Pupil, Sensor

FINER = 2  # times as many samples for the splines: exact up to half of the band that they hold


def light_on_camera(
    scene: Scene, stages: Stages, image: Tensor, motion: Motion | MotionNearby | None = None
) -> Tensor:
    """Irradiance that the camera's pixels integrate, before gain, offset and response.

    Parameters
    ----------
    scene : Scene
    stages : Stages
    image : Tensor
        Irradiance on the fine image grid, as in `Trace`.
    motion : Motion or MotionNearby, optional
        Of each capture, where the camera moves; without it all blur as the effect says.

    Returns
    -------
    Tensor [B, h, w]
    """
    sensor = stages.sensor
    spectrum, read = _before_motion(scene, stages, image)
    if motion is not None:
        return motion.light_of(sensor, spectrum, read)
    if (blur := sensor.usual_blur) is not None:
        spectrum = spectrum * blur
    return read(spectrum)


def motion_on_camera(
    scene: Scene, stages: Stages, image: Tensor, measured: tuple[Tensor, Tensor]
) -> Motion | None:
    """The captures' motions as they show themselves; None where the camera does not move.

    Parameters
    ----------
    measured : (Tensor, Tensor)
        Signal and weight of the captures, [B, h, w].
    """
    if not stages.sensor.moves:
        return None
    with torch.no_grad():
        return measured_motion(stages.sensor, *_before_motion(scene, stages, image), measured)


def motion_near(
    scene: Scene, stages: Stages, image: Tensor, measured: tuple[Tensor, Tensor], motion: Motion
) -> MotionNearby:
    """The captures' motions in models a small step from one where they are known."""
    return motion_nearby(stages.sensor, *_before_motion(scene, stages, image), measured, motion)


def _before_motion(scene: Scene, stages: Stages, image: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Spectrum of the irradiance on the camera before the captures' motions, and how its pixels read it."""
    grid, sensor = scene.grid, stages.sensor
    places = _places(scene, sensor)

    def read(spectrum: Tensor) -> Tensor:
        if places is None:
            return registered_samples(grid, spectrum)
        finer = finer_picture(spectrum * _spline_transfer(scene), grid.image_shape, FINER)
        return samples_at(finer, *places)

    return rfft2(image) * _camera_transfer(scene, stages.pupil, sensor), read


def _places(scene: Scene, sensor: Sensor) -> tuple[Tensor, Tensor] | None:
    """Where each camera pixel's centre looks, samples of the finer picture; None: at the centres of panel pixels."""
    displacement = sensor.displacement
    if displacement is None and scene.bench.camera.registered:
        return None
    if displacement is not None and any(d.requires_grad for d in displacement):
        return _looked_at(scene, displacement)
    with torch.no_grad():
        return _kept_looked_at(scene, displacement)


def _looked_at(scene: Scene, displacement: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
    if displacement is None:
        places = camera_positions(scene)
    else:
        dy, dx = displacement
        rows = torch.arange(dy.shape[-2], dtype=dy.dtype)[:, None]
        places = scene.bench.camera.on_panel(rows + dy, torch.arange(dy.shape[-1], dtype=dy.dtype) + dx)
    return sample_places(scene.grid, *places, FINER)


_kept_looked_at = kept_for_same(3)(_looked_at)


@kept_by_device(8)
def _spline_transfer(scene: Scene) -> Tensor:
    """Transfer function that makes the splines' coefficients of the finer picture."""
    fy, fx = image_frequencies(scene.grid, torch.zeros((), dtype=scene.dtype))
    pitch = scene.grid.pitch
    return 1 / spline_filter(fy[:, None] * pitch, fx[None, :] * pitch, scene.grid.fine * FINER)


@kept_for_same(2)  # of a fit's model and of its trial
def _camera_transfer(scene: Scene, pupil: Pupil, sensor: Sensor) -> Tensor:
    """Transfer function of all that filters irradiance in the image: the pixel's area, ghosts, the camera."""
    transfer = _pixel_area(scene, sensor)
    for extra in (pupil.irradiance_filter, sensor.irradiance_filter, sensor.blur):
        if extra is not None:
            transfer = transfer * extra
    return transfer


def counts(
    scene: Scene,
    stages: Stages,
    light: Tensor,
    gain: Tensor,
    measured: tuple[Tensor, Tensor] | None,
    own: Tensor | None = None,
) -> Tensor:
    """Counts above black for light on the camera.

    Parameters
    ----------
    scene : Scene
    stages : Stages
    light : Tensor [B, h, w]
        As from `light_on_camera`.
    gain : Tensor [B, 1, 1]
        Counts for one unit of light.
    measured : (Tensor, Tensor) or None
        Signal and weight [B, h, w], from which each capture's own gain is computed where laser power drifts.
    own : Tensor [B, 1, 1], optional
        Each capture's own gain, where it is known and need not be computed.

    Returns
    -------
    Tensor [B, h, w], counts above black
    """
    sensor = stages.sensor
    signal = laser_counts(sensor, light, gain)
    if own is None and sensor.free_capture_gain and measured is not None:
        own = own_gain(sensor, signal, measured)
    if own is not None:
        signal = signal * own
    if (always := sensor.added_always) is not None:
        signal = signal + always
    return sensor.responded(signal)


def laser_counts(sensor: Sensor, light: Tensor, gain: Tensor) -> Tensor:
    """Counts [B, h, w] of all light that follows the laser's power, for light on the camera, by a straight response."""
    signal = light * gain
    if sensor.gain is not None:
        signal = signal * sensor.gain
    if (by_laser := sensor.added_by_laser) is not None:
        signal = signal + by_laser
    return signal


@kept_by_device(32)
def camera_positions(scene: Scene) -> tuple[Tensor, Tensor]:
    """Where each camera pixel's centre looks.

    Returns
    -------
    y, x : Tensor [h, w], panel pixels
    """
    y, x = scene.bench.camera.looks_at()
    return torch.as_tensor(y, dtype=scene.dtype), torch.as_tensor(x, dtype=scene.dtype)


def _pixel_area(scene: Scene, sensor: Sensor) -> Tensor:
    """Transfer function of the camera pixel's area."""
    camera = scene.bench.camera
    if camera.homography is None:
        side = camera.pixel_um / scene.bench.panel.pitch_um
        return torch.sinc(sensor.iy * side) * torch.sinc(sensor.ix * side)
    return pixel_area(sensor.iy, sensor.ix, *camera_positions(scene))
