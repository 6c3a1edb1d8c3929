"""Effects of the sensor: what happens to irradiance between the image plane and the counts."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_curve, legendre_surface
from trainer.effects.definition import Parameter, effect
from trainer.effects.pupil import kernel_transfer
from trainer.effects.starts import gain_spread, ghost_starts, registration_starts
from trainer.prediction.stages import Sensor


@effect(
    stage="sensor",
    acts_on="camera",
    parameters=[
        Parameter(
            "width_y", "pixels", scale=0.15, low=0, high=20, even=True, starts=(0.3, 0.6, 1.2), about="rms"
        ),
        Parameter(
            "width_x", "pixels", scale=0.15, low=0, high=20, even=True, starts=(0.3, 0.6, 1.2), about="rms"
        ),
        Parameter("kurtosis", "1", scale=0.5, low=-1.5, high=1.5, about="shape: 0 Gaussian, -1 uniform disc"),
        Parameter(
            "halo", "1", scale=0.05, low=0, high=0.9, about="share of the light in a wider, round part"
        ),
        Parameter("halo_width", "pixels", scale=0.3, absent=2.0, low=0.1, high=60, about="rms of that part"),
    ],
)
def sensor_blur(
    sensor: Sensor, width_y: Tensor, width_x: Tensor, kurtosis: Tensor, halo: Tensor, halo_width: Tensor
) -> Sensor:
    """The camera's lens and pixels blur the picture."""
    widths = (width_y, width_x, halo_width)
    return sensor.blurred(kernel_transfer(sensor.iy, sensor.ix, widths, kurtosis, halo))


@effect(
    stage="sensor",
    acts_on="camera",
    orders=(1, 3),
    starts=registration_starts,
    parameters=[
        Parameter("shift_y", "pixels", scale=0.05, low=-60, high=60),
        Parameter("shift_x", "pixels", scale=0.05, low=-60, high=60),
        Parameter("rotation", "mrad", scale=0.5, low=-300, high=300),
        Parameter(
            "magnification",
            "%",
            scale=0.05,
            low=-20,
            high=20,
            about="size of the picture in excess of nominal",
        ),
        Parameter(
            "distortion",
            "pixels",
            scale=0.05,
            low=-30,
            high=30,
            count=lambda order: 2 * (legendre_count(order, 1) - 1),
            blocks=2,
            about="Legendre terms of the displacement that shift, rotation and size leave; rows, then columns",
        ),
    ],
)
def misregistration(
    sensor: Sensor,
    shift_y: Tensor,
    shift_x: Tensor,
    rotation: Tensor,
    magnification: Tensor,
    distortion: Tensor,
) -> Sensor:
    """Camera pixels are not where the registration states: shift, rotation, scale, distortion."""
    half_height, half_width = (n / 2 for n in sensor.y.shape)
    y, x = sensor.y * half_height, sensor.x * half_width
    angle, size = 1e-3 * rotation, 1e-2 * magnification
    dy, dx = shift_y + size * y + angle * x, shift_x + size * x - angle * y
    # The parameters above describe an affine map, except one part of it: stretch of rows against columns. So the
    # first term, P1(y), is left out.
    rows, columns = (
        legendre_surface(torch.cat((torch.zeros_like(part[:1]), part)), sensor.y, sensor.x)
        for part in distortion.reshape(2, -1)
    )
    return sensor.displaced(dy + rows, dx + columns)


@effect(
    stage="sensor",
    acts_on="camera",
    orders=(2, 4, 6),
    parameters=[
        Parameter(
            "log_gain",
            "1",
            scale=0.03,
            low=-4,
            high=4,
            count=legendre_count,
            about="Legendre terms over the picture",
        )
    ],
)
def vignetting(sensor: Sensor, log_gain: Tensor) -> Sensor:
    """The camera's sensitivity falls off over the field."""
    return sensor.multiplied(torch.exp(legendre_surface(log_gain, sensor.y, sensor.x)))


@effect(
    stage="sensor",
    acts_on="camera",
    orders=(1, 2, 4, 6, 8),
    parameters=[
        Parameter(
            "counts",
            "counts",
            scale=3.0,
            low=-4000,
            high=60000,
            count=lambda order: legendre_count(order, 0),
            about="Legendre terms over the picture, the mean first",
        )
    ],
)
def stray_light(sensor: Sensor, counts: Tensor) -> Sensor:
    """Light is simply added, smooth over the picture."""
    return sensor.brightened(legendre_surface(counts, sensor.y, sensor.x, lowest=0))


@effect(
    stage="sensor",
    acts_on="camera",
    orders=(2, 4, 6),
    parameters=[
        Parameter(
            "bend",
            "1",
            scale=0.03,
            low=-6,
            high=6,
            count=lambda order: order,
            about="Legendre terms of the deviation from a straight line, zero at both ends, share of full scale",
        )
    ],
)
def sensor_response(sensor: Sensor, bend: Tensor) -> Sensor:
    """Counts are not proportional to light."""

    def curve(share: Tensor) -> Tensor:
        # The polynomial is fitted from darkness to full scale; beyond that the curve continues as a straight line.
        inside = torch.clamp(share, -0.05, 1.0)
        return share + inside * (1 - inside) * torch.tensordot(
            bend, legendre_curve(2 * inside - 1, bend.shape[0]), dims=1
        )

    return sensor.responding(curve)


@effect(
    stage="sensor",
    acts_on="camera",
    measure=gain_spread,
    parameters=[
        Parameter("spread", "%", scale=1.0, low=0, high=100, about="rms of the gain from capture to capture")
    ],
)
def laser_drift(sensor: Sensor, spread: Tensor) -> Sensor:
    """The laser's power varies from capture to capture: each capture has its own gain, measured from it."""
    return replace(sensor, free_capture_gain=sensor.free_capture_gain or bool(spread != 0))


@effect(
    stage="sensor",
    acts_on="display",
    starts=ghost_starts,
    parameters=[
        Parameter(
            "amplitude",
            "1",
            scale=0.01,
            low=0,
            high=1,
            about="irradiance of the copy over that of the picture",
        ),
        Parameter("shift_y", "pixels", scale=0.3, low=-200, high=200),
        Parameter("shift_x", "pixels", scale=0.3, low=-200, high=200),
        Parameter(
            "blur",
            "pixels",
            scale=0.3,
            low=0,
            high=20,
            even=True,
            about="rms of the copy's own blur along an axis",
        ),
    ],
)
def ghost(sensor: Sensor, amplitude: Tensor, shift_y: Tensor, shift_x: Tensor, blur: Tensor) -> Sensor:
    """A second, weak, displaced image, as from a reflection in a window."""
    angle = -2 * math.pi * (sensor.iy * shift_y + sensor.ix * shift_x)
    none = torch.zeros_like(blur)
    size = amplitude * kernel_transfer(sensor.iy, sensor.ix, (blur, blur, none), none, none)
    return sensor.filtered(1 + size * torch.complex(torch.cos(angle), torch.sin(angle)))
