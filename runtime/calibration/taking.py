"""Shows patterns, sets the exposure, measures the camera's noise and takes captures as a fit needs them.

Nothing of the camera's data sheet is needed: black is a picture without lasers, the noise comes from two
pictures of one pattern, and full scale is the top of the camera's bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.errors import InputError
from runtime.calibration.estimate import Shot, shot_of
from runtime.headset.exposure_growth import while_growing
from runtime.headset.open_devices import Devices

AIM, BRIGHTEST = 0.7, 0.999  # this share of full scale for this quantile of a picture
SHORTEST_MS, LONGEST_MS = 0.02, 1000.0
DARK = 2  # pictures without lasers


@dataclass(frozen=True)
class Noise:
    """The camera's noise: the variance of counts above black is floor + slope * counts.

    Attributes
    ----------
    black : float, counts
        Black level.
    floor : float, counts^2
        Variance without light.
    slope : float, counts
        Variance per count.
    top : float, counts
        The first saturated count.
    """

    black: float
    floor: float
    slope: float
    top: float

    def variance(self, signal: np.ndarray) -> np.ndarray:
        """Expected variance of counts above black, counts^2."""
        return self.floor + self.slope * np.maximum(signal, 0)


class Taker:
    """Takes captures of one colour after another. Whoever makes one switches the lasers off in the end.

    Parameters
    ----------
    devices : Devices
    announce : callable
        Called before each picture with what it is.
    taken : int
        Pictures taken before.
    settling : int
        Pictures of each pattern that are not used, because a slow panel still shows the pattern before.

    Attributes
    ----------
    taken : int
        Pictures taken so far, without those.
    """

    def __init__(
        self, devices: Devices, announce: Callable[[str], None], taken: int = 0, settling: int = 0
    ) -> None:
        self.devices, self.announce, self.taken = devices, announce, taken
        self._settling = settling
        self.top = float(2**devices.camera.bit_depth - 1)

    def darkness(self) -> tuple[float, float]:
        """Black level (counts) and the variance (counts^2) of a picture without light.

        Raises
        ------
        InputError
            If it is not dark.
        """
        self.devices.lasers.off()
        self.announce("dark pictures")
        first, second = (self._picture() for _ in range(DARK))
        black = float((first + second).mean() / 2)
        if black > 0.5 * self.top:
            raise InputError(
                f"the camera counts {black:.0f} of {self.top:.0f} with the lasers off: shut out the room's light, "
                "or check that counts stand in the low bits"
            )
        return black, float((first - second).var() / 2)

    def light(self, channel: str) -> None:
        """Switch one laser on, and all others off."""
        self.devices.light(channel)

    def expose(self, gray: np.ndarray, black: float) -> float:
        """Set the exposure to one at which a pattern just does not saturate, and its brightest pixels are not full.

        Parameters
        ----------
        gray : uint8 array [H, W]
        black : float, counts

        Returns
        -------
        float, ms
            The exposure.

        Raises
        ------
        InputError
            If there is no light, or no exposure suits it.
        """
        camera = self.devices.camera
        self.announce("exposure")
        for _ in range(8):
            self._show(gray)
            bright = float(np.quantile(self._picture(), BRIGHTEST)) - black
            room = self.top - black
            if bright < 0.9 * room:
                factor = AIM * room / max(bright, 1.0)
                exposure = min(max(camera.exposure_ms * factor, SHORTEST_MS), LONGEST_MS)
                if bright > 0.002 * room or math.isclose(exposure, camera.exposure_ms, rel_tol=1e-3):
                    break
                camera.exposure_ms = exposure
            else:
                camera.exposure_ms = max(camera.exposure_ms / 5, SHORTEST_MS)
        else:
            raise InputError(
                f"no exposure from {SHORTEST_MS:g} to {LONGEST_MS:g} ms suits the light: check that the camera looks "
                "at the image and that the laser's power is steady"
            )
        if bright <= 0.002 * room:
            raise InputError(
                f"the camera sees no light at {camera.exposure_ms:g} ms: check that the laser's interlock is closed, "
                "the panel is on, and nothing stands in the way"
            )

        def brightness(exposure_ms: float) -> float:
            camera.exposure_ms = exposure_ms
            self._show(gray)
            return (float(np.quantile(self._picture(), BRIGHTEST)) - black) / room

        camera.exposure_ms = while_growing(exposure, SHORTEST_MS, brightness)
        return float(camera.exposure_ms)

    def noise(self, gray: np.ndarray, black: float, floor: float) -> Noise:
        """The camera's noise, from two pictures of one pattern, whose brightness may differ a little.

        Parameters
        ----------
        gray : uint8 array [H, W]
        black : float, counts
        floor : float, counts^2
            Variance of a picture without light.
        """
        self._show(gray)
        self.announce("noise")
        first, second = (self._picture() - black for _ in range(2))
        second = second * (first.sum() / second.sum())
        use = (first < 0.95 * self.top - black) & (second < 0.95 * self.top - black)
        signal = np.maximum((first + second)[use] / 2, 0)
        excess = float(((first - second)[use] ** 2).mean() / 2) - floor
        return Noise(black, max(floor, 1 / 12), max(excess / float(signal.mean()), 0.0), self.top)

    def shot(self, channel: str, gray: np.ndarray, noise: Noise, what: str) -> Shot:
        """One capture of a pattern."""
        self._show(gray)
        self.announce(what)
        counts = self._counts()
        signal = counts - np.float32(noise.black)
        # weights from a picture smoothed a little, or dark noise would be trusted more than bright
        weight = np.where(counts >= noise.top, 0, 1 / noise.variance(_softened(signal)))
        return shot_of(channel, gray, counts, noise.black, weight)

    def shots(
        self,
        channel: str,
        grays: Sequence[np.ndarray],
        noise: Noise,
        what: str,
        kept: Callable[[Shot], Shot] = lambda shot: shot,
    ) -> list[Shot]:
        """One capture of each pattern, or what is to be `kept` of it."""
        return [
            kept(self.shot(channel, gray, noise, f"{what} {number} of {len(grays)}"))
            for number, gray in enumerate(grays, 1)
        ]

    def _show(self, gray: np.ndarray) -> None:
        self.devices.panel.show(gray)
        for _ in range(self._settling):
            self.devices.camera.capture()

    def _picture(self) -> np.ndarray:
        return self._counts().astype(np.float32)

    def _counts(self) -> np.ndarray:
        self.taken += 1
        return np.array(self.devices.camera.capture())


def _softened(signal: np.ndarray) -> np.ndarray:
    """A picture [h, w] blurred by about one pixel."""
    padded = np.pad(signal, 1, mode="edge")
    rows = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return np.asarray((rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 4)
