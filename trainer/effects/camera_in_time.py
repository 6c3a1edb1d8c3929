"""Effects of the camera in time and from pixel to pixel: vibration, motion between captures, fixed-pattern noise."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from trainer.effects.bessel import bessel_j0
from trainer.effects.blur_kernel import decayed
from trainer.effects.definition import Parameter, effect
from trainer.effects.measured_values import blur_rms, pixel_pattern, shift_spread
from trainer.prediction.stages import Sensor


@effect(
    stage="sensor",
    acts_on="camera",
    measure=blur_rms,
    rugged=True,
    parameters=[
        Parameter(
            "rms",
            "pixels",
            scale=0.15,
            low=0,
            high=20,
            even=True,
            starts=(0.8,),  # each capture shows its own
            about="of the motion during a usual exposure; each capture has its own",
            typical=(0, 3),
            example=1.2,
        ),
        Parameter(
            "direction",
            "deg",
            scale=4.0,
            low=-180,
            high=180,
            starts=(0.0, 45.0, 90.0, 135.0),
            about="of the motion, from x towards y",
            typical=(-90, 90),
            example=30.0,
        ),
        Parameter(
            "kurtosis",
            "1",
            scale=0.3,
            absent=-1.5,
            low=-1.5,
            high=0,
            about="shape: -1.5 a sinusoid, 0 a random motion",
            typical=(-1.5, 0),
        ),
    ],
    formula=(
        r"\hat{I}' = \hat{I}\,\bigl[\,s\,J_0(\sqrt{2}\,w) + (1-s)\,e^{-w^2/2}\bigr], \qquad s = -\kappa/1.5, \quad"
        r" w = 2\pi\sigma\,(f_x \cos\theta + f_y \sin\theta)"
    ),
)
def vibration(sensor: Sensor, rms: Tensor, direction: Tensor, kurtosis: Tensor) -> Sensor:
    """The picture moves along a direction during each exposure.

    A fan, a pump or the table's own resonance shakes the camera while it exposes. The picture blurs along one
    direction, and stays sharp across it. How far it moves is measured from each capture.

    References
    ----------
    Holst 2008, Electro-Optical Imaging System Performance, chapter on motion.
    """
    angle = math.pi / 180 * direction
    whole = (2 * math.pi * rms * (sensor.ix * torch.cos(angle) + sensor.iy * torch.sin(angle))) ** 2

    def blur(amount: Tensor) -> Tensor:
        w2 = amount * whole
        share = -kurtosis / 1.5
        sinusoid = bessel_j0(torch.sqrt(torch.clamp(2 * w2, min=1e-12)))  # a root has no slope at 0
        return share * sinusoid + (1 - share) * decayed(-0.5 * w2)

    return sensor if float(rms.detach()) == 0 else replace(sensor, capture_blur=blur)


@effect(
    stage="sensor",
    acts_on="camera",
    measure=shift_spread,
    parameters=[
        Parameter(
            "spread",
            "pixels",
            scale=0.1,
            low=0,
            high=20,
            about="rms displacement from capture to capture, along each axis",
            typical=(0, 2),
            example=0.5,
        )
    ],
    formula=r"I'_k(\mathbf{r}) = I_k(\mathbf{r} + \mathbf{s}_k), \qquad \mathrm{rms}(\mathbf{s}_k) = \sigma",
)
def frame_motion(sensor: Sensor, spread: Tensor) -> Sensor:
    """The camera moves from capture to capture: each capture has its own displacement, measured from it.

    The mount creeps, or somebody touches the table between captures. Each picture as a whole lies elsewhere, by a
    fraction of a pixel or by some; up to 8 panel pixels are found.
    """
    return replace(sensor, free_capture_shift=sensor.free_capture_shift or bool(spread != 0))


@effect(
    stage="sensor",
    acts_on="camera",
    measure=pixel_pattern,
    parameters=[
        Parameter(
            "gain_rms",
            "%",
            scale=1.0,
            low=0,
            high=100,
            about="of the pixels' sensitivity about their neighbours'",
            typical=(0, 10),
            example=3.0,
        ),
        Parameter(
            "offset_rms",
            "counts",
            scale=3.0,
            low=0,
            high=10000,
            about="of the pixels' dark counts about their neighbours'",
            typical=(0, 50),
        ),
        Parameter("gain", "1", scale=0.01, low=-1, high=10, per_pixel=True, about="of each pixel, less 1"),
        Parameter(
            "offset",
            "counts",
            scale=1.0,
            low=-60000,
            high=60000,
            per_pixel=True,
            about="dark counts of each pixel",
        ),
    ],
    formula=r"N'(i,j) = \bigl[1 + g_{ij}\bigr]\,N(i,j) + o_{ij}",
)
def fixed_pattern(
    sensor: Sensor, gain_rms: Tensor, offset_rms: Tensor, gain: Tensor, offset: Tensor
) -> Sensor:
    """Each camera pixel has a gain and an offset of its own.

    Pixels differ in sensitivity and in dark current, the same way in every picture. It looks like noise in one picture
    and does not average out over many.

    References
    ----------
    EMVA 2021, Standard for characterization of image sensors and cameras, EMVA 1288, release 4.0.
    """
    return sensor.multiplied(1 + gain).brightened(offset)
