"""Effects of the sensor: what happens to irradiance between the image plane and the counts."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from runtime.lightpath.legendre import legendre_count, legendre_curve, legendre_surface
from trainer.effects.blur_kernel import CORE_AND_HALO, kernel_transfer
from trainer.effects.definition import Parameter, effect
from trainer.effects.free_form import FreeForm, along
from trainer.effects.starts import gain_spread, ghost_starts, registration_starts
from trainer.effects.term_names import curve_terms, distortion_terms, surface_terms, surface_terms_with_mean
from trainer.prediction.stages import Sensor


@effect(
    stage="sensor",
    acts_on="camera",
    colours="either",
    parameters=[
        *(
            Parameter(
                f"width_{axis}",
                "pixels",
                scale=0.15,
                low=0,
                high=20,
                even=True,
                starts=(0.3, 0.6, 1.2),
                about="rms",
                typical=(0, 3),
                example=0.8,
            )
            for axis in "yx"
        ),
        *CORE_AND_HALO,
        Parameter(
            "halo_width",
            "pixels",
            scale=0.3,
            absent=2.0,
            low=0.1,
            high=60,
            about="rms of that part",
            typical=(0.1, 20),
            example=6.0,
        ),
    ],
    formula=(
        r"\hat{I}' = \hat{I}\,\bigl[(1-h)\,K_\kappa(w) + h\,K_0(w_h)\bigr],"
        r" \quad K_0 = e^{-w^2/2}, \quad K_{-1} = J_1(2w)/w, \quad K_{-1.5} = J_0(\sqrt{2}\,w),"
        r" \qquad w = 2\pi \sqrt{(\sigma_x f_x)^2 + (\sigma_y f_y)^2}"
    ),
)
def sensor_blur(
    sensor: Sensor, width_y: Tensor, width_x: Tensor, kurtosis: Tensor, halo: Tensor, halo_width: Tensor
) -> Sensor:
    """The camera's lens and pixels blur the picture.

    The camera's lens is not sharp to the pixel, and some light scatters widely. The eye does not look through this
    lens, so no pattern may correct for it.

    References
    ----------
    Goodman, Introduction to Fourier Optics, section 6.3.
    """
    widths = (width_y, width_x, halo_width)
    return sensor.blurred(kernel_transfer(sensor.iy, sensor.ix, widths, kurtosis, halo))


@effect(
    stage="sensor",
    acts_on="camera",
    colours="either",
    orders=(1, 3),
    starts=registration_starts,
    parameters=[
        Parameter("shift_y", "pixels", scale=0.05, low=-60, high=60, typical=(-4, 4)),
        Parameter("shift_x", "pixels", scale=0.05, low=-60, high=60, typical=(-4, 4), example=0.7),
        Parameter("rotation", "mrad", scale=0.5, low=-300, high=300, typical=(-30, 30)),
        Parameter(
            "magnification",
            "%",
            scale=0.05,
            low=-20,
            high=20,
            about="size of the picture in excess of nominal",
            typical=(-4, 4),
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
            typical=(-4, 4),
            terms=distortion_terms,
        ),
    ],
    formula=(
        r"I'(\mathbf{r}) = I\bigl(\mathbf{r} + \mathbf{s} + m\,\mathbf{r} + \theta\,\mathbf{r}^{\perp}"
        r" + \mathbf{d}(\mathbf{r})\bigr)"
    ),
)
def misregistration(
    sensor: Sensor,
    shift_y: Tensor,
    shift_x: Tensor,
    rotation: Tensor,
    magnification: Tensor,
    distortion: Tensor,
) -> Sensor:
    """Camera pixels are not where the registration states: shift, rotation, scale, distortion.

    The camera's pixels are taken for places on the panel where they do not look. A tenth of a pixel already shows
    at every edge.

    References
    ----------
    Hartley and Zisserman 2004, Multiple View Geometry in Computer Vision, section 7.4.
    """
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


def _brightened(sensor: Sensor, log_gain: Tensor) -> Sensor:
    return sensor.multiplied(torch.exp(log_gain))


@effect(
    stage="sensor",
    acts_on="camera",
    colours="either",
    orders=(2, 4, 6),
    free_form=FreeForm(_brightened, "1", 0.05),
    parameters=[
        Parameter(
            "log_gain",
            "1",
            scale=0.03,
            low=-4,
            high=4,
            count=legendre_count,
            about="Legendre terms over the picture",
            typical=(-1, 1),
            example=(0.0, 0.0, -0.3, 0.0, -0.3),
            terms=surface_terms,
        )
    ],
    formula=r"I' = I\,\exp\Bigl[\sum_{i,j}\,g_{ij}\,P_i(y)\,P_j(x)\Bigr]",
)
def vignetting(sensor: Sensor, log_gain: Tensor) -> Sensor:
    """The camera's sensitivity falls off over the field.

    The camera's lens passes less light towards the edge of the field, and its pixels accept oblique light less
    well.

    References
    ----------
    Goldman 2010, Vignette and exposure calibration and compensation, IEEE Trans. Pattern Anal. Mach. Intell. 32,
    2276.
    """
    return _brightened(sensor, legendre_surface(log_gain, sensor.y, sensor.x))


@effect(
    stage="sensor",
    acts_on="camera",
    colours="either",
    orders=(1, 2, 4, 6, 8),
    free_form=FreeForm(Sensor.brightened, "counts", 5.0),
    parameters=[
        Parameter(
            "counts",
            "counts",
            scale=3.0,
            low=-4000,
            high=60000,
            count=lambda order: legendre_count(order, 0),
            about="Legendre terms over the picture, the mean first",
            typical=(-400, 400),
            example=(150.0, 0.0, 100.0),
            terms=surface_terms_with_mean,
        ),
        Parameter(
            "laser_share",
            "1",
            scale=0.1,
            low=0,
            high=1,
            about="of the added light: what follows the laser's power from capture to capture",
            typical=(0, 1),
        ),
        Parameter(
            "constant",
            "counts",
            scale=3.0,
            low=-4000,
            high=60000,
            about="of the added counts: what does not grow with the exposure, as of a wrong black level",
            typical=(-400, 400),
        ),
    ],
    formula=r"N'_k = N_k + (1 - t_k)\,c + t_k\,[1 + s\,(g_k - 1)]\,\sum_{i,j}\,b_{ij}\,P_i(y)\,P_j(x)",
)
def stray_light(sensor: Sensor, counts: Tensor, laser_share: Tensor, constant: Tensor) -> Sensor:
    """Light is simply added, smooth over the picture.

    Room light, glare in the camera's lens or a black level that is wrong add counts that no pattern controls. Dark
    places show it first. Glare is the laser's own light: where the laser's power varies (`laser_drift`), so does the
    glare. Counts are those at the usual exposure t_k = 1: light grows with the exposure, and a black level does not.

    References
    ----------
    Talvala et al. 2007, Veiling glare in high dynamic range imaging, ACM Trans. Graph. 26, 37.
    """
    added = sensor.brightened(legendre_surface(counts, sensor.y, sensor.x, lowest=0))
    return replace(added, laser_share=laser_share, constant=constant)


def _bent(sensor: Sensor, deviation: Tensor) -> Sensor:
    return sensor.responding(lambda share: share + along(deviation, share))


@effect(
    stage="sensor",
    acts_on="camera",
    orders=(2, 4, 6, 10),
    free_form=FreeForm(_bent, "1", 0.01, curve=True),
    parameters=[
        Parameter(
            "bend",
            "1",
            scale=0.03,
            low=-6,
            high=6,
            count=lambda order: order,
            about="Legendre terms of the deviation from a straight line, zero at both ends, share of full scale",
            typical=(-0.6, 0.6),
            example=0.3,
            terms=curve_terms,
        )
    ],
    formula=r"s' = s + s\,(1-s)\sum_n\,b_n P_n(2s-1), \qquad s = N / N_\mathrm{full\ scale}",
)
def sensor_response(sensor: Sensor, bend: Tensor) -> Sensor:
    """Counts are not proportional to light.

    Twice the light does not give twice the counts, because a pixel's well fills or the camera's software applies a
    curve. Middle tones are off while black and white are right.

    References
    ----------
    Debevec and Malik 1997, Recovering high dynamic range radiance maps from photographs, SIGGRAPH.

    EMVA 2021, Standard for characterization of image sensors and cameras, EMVA 1288, release 4.0.
    """

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
        Parameter(
            "spread",
            "%",
            scale=1.0,
            low=0,
            high=100,
            about="rms of the gain from capture to capture",
            typical=(0, 30),
            example=8.0,
        )
    ],
    formula=r"N'_k = g_k\,N_k, \qquad \mathrm{rms}(g_k - 1) = \sigma",
)
def laser_drift(sensor: Sensor, spread: Tensor) -> Sensor:
    """The laser's power varies from capture to capture: each capture has its own gain, measured from it.

    The laser's power changes with its temperature and current between one capture and the next. Each capture is a
    little brighter or darker as a whole.
    """
    return replace(sensor, free_capture_gain=sensor.free_capture_gain or bool(spread != 0))


@effect(
    stage="sensor",
    acts_on="display",
    colours="either",
    starts=ghost_starts,
    parameters=[
        Parameter(
            "amplitude",
            "1",
            scale=0.01,
            low=0,
            high=1,
            about="irradiance of the copy over that of the picture",
            typical=(0, 0.5),
            example=0.15,
        ),
        Parameter("shift_y", "pixels", scale=0.3, low=-200, high=200, typical=(-30, 30), example=4.0),
        Parameter("shift_x", "pixels", scale=0.3, low=-200, high=200, typical=(-30, 30), example=9.0),
        Parameter(
            "blur",
            "pixels",
            scale=0.3,
            low=0,
            high=20,
            even=True,
            about="rms of the copy's own blur along an axis",
            typical=(0, 5),
        ),
    ],
    formula=r"I'(\mathbf{r}) = I(\mathbf{r}) + a\,\bigl(G_b * I\bigr)(\mathbf{r} - \mathbf{s})",
)
def ghost(sensor: Sensor, amplitude: Tensor, shift_y: Tensor, shift_x: Tensor, blur: Tensor) -> Sensor:
    """A second, weak, displaced image, as from a reflection in a window.

    Light that is reflected twice inside a window or a beam splitter arrives beside the picture. It is taken as
    incoherent: the second way is longer than the laser's coherence.

    References
    ----------
    Born and Wolf 1999, Principles of Optics, section 7.6.
    """
    angle = -2 * math.pi * (sensor.iy * shift_y + sensor.ix * shift_x)
    none = torch.zeros_like(blur)
    size = amplitude * kernel_transfer(sensor.iy, sensor.ix, (blur, blur, none), none, none)
    return sensor.filtered(1 + size * torch.complex(torch.cos(angle), torch.sin(angle)))
