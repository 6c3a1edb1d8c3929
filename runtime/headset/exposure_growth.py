"""An exposure up to which a picture's brightest pixels grow with the light.

Pixels may be full below the camera's top count, or the camera's software may bend bright counts. No pixel is then ever
saturated, and an exposure that is chosen by the top count alone ends many times too long.
"""

from __future__ import annotations

from collections.abc import Callable

from firmware_iface.errors import InputError

FULL = 1.25  # twice the light in a pixel that gives no more than so many times the counts: it is nearly full
DIM = 0.05  # share of full scale below which no pixel is full


def while_growing(exposure_ms: float, shortest_ms: float, brightness: Callable[[float], float]) -> float:
    """The exposure, or of its half, its quarter and so on, the longest up to which a picture's brightness grows.

    Parameters
    ----------
    exposure_ms : float
        The longest that may be.
    shortest_ms : float
        The shortest that may be.
    brightness : callable
        Takes an exposure, ms, and gives counts above black of a picture's brightest pixels at it, as a share of full
        scale. Called for the exposure and its half, and for shorter ones while these are not short enough.

    Returns
    -------
    float, ms

    Raises
    ------
    InputError
        If the brightness grows nowhere between the two.
    """
    found, bright = exposure_ms, brightness(exposure_ms)
    while bright > DIM and found / 2 >= shortest_ms:
        less = brightness(found / 2)
        if bright > FULL * less:
            return found
        found, bright = found / 2, less
    if bright > DIM and found < exposure_ms:
        raise InputError(
            f"the camera counts nearly as much at {found:.3g} ms as at {exposure_ms:.3g} ms: switch off its automatic "
            "exposure and gain, or dim the laser"
        )
    return found
