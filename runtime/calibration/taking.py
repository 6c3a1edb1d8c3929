"""Shows patterns, sets the exposure, measures the camera's noise and takes captures as a fit wants them.

Nothing of the camera's data sheet is asked for: black is a picture without lasers, the noise comes from two
pictures of one pattern, and full scale is the top of the camera's bits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.errors import InputError
from runtime.calibration.estimate import Shot
from runtime.headset.open_devices import Devices

AIM, BRIGHTEST = 0.7, 0.999  # this share of full scale for this quantile of a picture
SHORTEST_MS, LONGEST_MS = 0.02, 1000.0
DARK = 2  # pictures without lasers

Said = Callable[[str], None]


@dataclass(frozen=True)
class Noise:
    """Variance of counts above black is floor + slope * counts. black: counts; top: the first saturated count."""

    black: float
    floor: float
    slope: float
    top: float

    def variance(self, signal: np.ndarray) -> np.ndarray:
        """Expected variance of counts above black."""
        return self.floor + self.slope * np.maximum(signal, 0)


class Taker:
    """Takes captures of one colour after another; lasers are on only while it does. taken: pictures so far."""

    def __init__(self, devices: Devices, said: Said, taken: int = 0) -> None:
        self.devices, self.said, self.taken = devices, said, taken
        self.top = float(2**devices.camera.bit_depth - 1)

    def darkness(self) -> tuple[float, float]:
        """Black level (counts) and the variance of a picture without light. Raises InputError if it is not dark."""
        self.devices.lasers.off()
        self.said("dark pictures")
        first, second = (self._picture() for _ in range(DARK))
        black = float((first + second).mean() / 2)
        if black > 0.5 * self.top:
            raise InputError(
                f"the camera counts {black:.0f} of {self.top:.0f} with the lasers off: shut out the room's light, "
                "or see that counts stand in the low bits"
            )
        return black, float((first - second).var() / 2)

    def light(self, channel: str) -> None:
        """Switch one laser on, and all others off."""
        self.devices.light(channel)

    def expose(self, gray: np.ndarray, black: float) -> float:
        """Set and return the exposure, ms, at which a pattern just does not saturate. Raises InputError if dark."""
        camera = self.devices.camera
        self.said("exposure")
        for _ in range(8):
            self.devices.panel.show(gray)
            bright = float(np.quantile(self._picture(), BRIGHTEST)) - black
            room = self.top - black
            if bright < 0.9 * room:
                factor = AIM * room / max(bright, 1.0)
                wanted = min(max(camera.exposure_ms * factor, SHORTEST_MS), LONGEST_MS)
                if bright > 0.002 * room or wanted == camera.exposure_ms:
                    break
                camera.exposure_ms = wanted
            else:
                camera.exposure_ms = max(camera.exposure_ms / 5, SHORTEST_MS)
        else:
            raise InputError(
                f"no exposure from {SHORTEST_MS:g} to {LONGEST_MS:g} ms suits the light: see that the camera looks "
                "at the image and that the laser's power is steady"
            )
        if bright <= 0.002 * room:
            raise InputError(
                f"the camera sees no light at {camera.exposure_ms:g} ms: see that the laser's interlock is closed, "
                "the panel is on, and nothing stands in the way"
            )
        camera.exposure_ms = wanted
        return float(wanted)

    def noise(self, gray: np.ndarray, black: float, floor: float) -> Noise:
        """The camera's noise, from two pictures of one pattern (their brightness may differ a little)."""
        self.devices.panel.show(gray)
        self.said("noise")
        first, second = (self._picture() - black for _ in range(2))
        second = second * (first.sum() / second.sum())
        use = (first < 0.95 * self.top - black) & (second < 0.95 * self.top - black)
        signal = np.maximum((first + second)[use] / 2, 0)
        excess = float(((first - second)[use] ** 2).mean() / 2) - floor
        return Noise(black, max(floor, 1 / 12), max(excess / float(signal.mean()), 0.0), self.top)

    def shot(self, channel: str, gray: np.ndarray, noise: Noise, what: str) -> Shot:
        """One capture of a pattern."""
        self.devices.panel.show(gray)
        self.said(what)
        counts = self._picture()
        signal = counts - np.float32(noise.black)
        # weights from a picture smoothed a little, or dark noise would be trusted more than bright
        weight = np.where(counts >= noise.top, 0, 1 / noise.variance(_softened(signal)))
        return Shot(channel, gray, signal, weight.astype(np.float32))

    def shots(self, channel: str, grays: Sequence[np.ndarray], noise: Noise, what: str) -> list[Shot]:
        """One capture of each pattern."""
        return [
            self.shot(channel, gray, noise, f"{what} {number} of {len(grays)}")
            for number, gray in enumerate(grays, 1)
        ]

    def _picture(self) -> np.ndarray:
        self.taken += 1
        return np.asarray(self.devices.camera.capture()).astype(np.float32)


def _softened(signal: np.ndarray) -> np.ndarray:
    padded = np.pad(signal, 1, mode="edge")
    rows = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return np.asarray((rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 4)
