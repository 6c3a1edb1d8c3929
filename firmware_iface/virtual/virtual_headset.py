"""A virtual headset: a panel, lasers and a camera in front of a simulated bench.

headset = open_headset("virtual:demo", seed=1)
headset.lasers.set_power("green", 1.0)
headset.panel.show(gray)
counts = headset.camera.capture()

A panel that shows colours in turn (`panel.show_fields`) lights each field with its own lasers; the camera sees the sum.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError
from firmware_iface.panel.panel import Gray, checked_gray
from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.bench_loading import load_bench
from firmware_iface.virtual.bench_optics import BenchOptics
from firmware_iface.virtual.camera_motion import CameraMotion, camera_motion
from firmware_iface.virtual.defects import LaserDrift
from firmware_iface.virtual.oracle_pattern import descend
from firmware_iface.virtual.simulated_sensor import Drift, Integrator, Sensor
from firmware_iface.virtual.virtual_devices import VirtualCamera, VirtualLasers, VirtualPanel


@dataclass(frozen=True)
class _Seen:
    """What the camera saw last of a channel, and why."""

    gray: Gray
    plane_mm: float
    before: NDArray[np.float64] | None
    motion: CameraMotion | None
    light: NDArray[np.float32]
    seen: NDArray[np.float64]

    def holds(self, gray: Gray, plane_mm: float, before: NDArray[np.float64] | None) -> bool:
        """Whether the light is still the same."""
        same = (self.before is None) == (before is None) and (
            self.before is None or before is None or np.array_equal(self.before, before)
        )
        return same and self.plane_mm == plane_mm and np.array_equal(self.gray, gray)


class VirtualHeadset:
    """All devices of one headset, on a simulated bench.

    Parameters
    ----------
    description : BenchDescription
        The bench.
    seed : int
        Fixes noise and drift; a capture's noise depends on the seed and on the number of captures before.

    Attributes
    ----------
    panel : VirtualPanel
    lasers : VirtualLasers
    camera : VirtualCamera
    plane_mm : float, mm
        Focus of the camera; the bench's distance at first.
    time_s : float, s
        Clock; each capture advances it.
    captures : int
        How many were taken.
    simulated : bool
        True, as capture sets say.
    """

    simulated = True

    def __init__(self, description: BenchDescription, seed: int = 0) -> None:
        self.description, self.seed = description, seed
        self.panel = VirtualPanel((description.panel.height, description.panel.width))
        self.lasers = VirtualLasers(tuple(c.name for c in description.channels))
        shape = (description.camera.height, description.camera.width)
        self.camera = VirtualCamera(shape, description.camera.bit_depth, self._capture)
        self.plane_mm = description.propagation.distance_mm
        self.time_s = 0.0
        self.captures = 0
        self._optics = BenchOptics(description)
        self._sensor = Sensor(description)
        self._drift = Drift(description.defect(LaserDrift), seed)
        # how far a slow panel has turned after the last capture; None: as far as it was asked to
        self._turned = self._optics.turned(self.panel.gray, None)
        self._recent: dict[tuple[str, int], _Seen] = {}
        self._integrators: OrderedDict[tuple[int, int, int], Integrator] = OrderedDict()

    def move_to_plane(self, plane_mm: float) -> None:
        """Focus the camera on another plane, mm from the panel.

        Raises
        ------
        InputError
            Unless within 2 m.
        """
        self.plane_mm = checked_plane(plane_mm)

    def has_shown(self, patterns: Sequence[tuple[Gray, int]]) -> None:
        """Say what the panel showed before what it shows now, where captures do not tell.

        Parameters
        ----------
        patterns : sequence of (uint8 array [H, W], int)
            And for how many periods each was shown, the last one last; the first has been there for long.
        """
        for k, (gray, periods) in enumerate(patterns):
            self._turned = self._optics.turned(gray, self._turned if k else None, periods)

    def _capture(self) -> NDArray[np.uint16]:
        dose = self.camera.exposure_ms / 10 * self._drift.gain(self.captures)
        motion = camera_motion(self.description, self.seed, self.captures)
        electrons = np.zeros(self.camera.shape)
        self._recent = {key: seen for key, seen in self._recent.items() if key[1] < len(self.panel.fields)}
        for number, field in enumerate(self.panel.fields):  # the camera integrates over whole frames
            for k, channel in enumerate(self.lasers.channels):
                power = self.lasers.power(channel) * field.share * (field.lasers >> k & 1)
                if power > 0:
                    seen = self._camera_irradiance(
                        field.gray, channel, self.plane_mm, motion, self._turned, number
                    )
                    electrons = electrons + self._sensor.electrons(seen, dose * power)
            self._turned = self._optics.turned(field.gray, self._turned)
        rng = np.random.default_rng([self.seed, 11, self.captures])
        counts = self._sensor.expose(self._sensor.respond(electrons), rng)
        self.time_s += max(self.description.simulation.capture_interval_s, self.camera.exposure_ms * 1e-3)
        self.captures += 1
        return counts

    def expected_counts(
        self, gray: NDArray[np.generic], channel: str, plane_mm: float | None = None
    ) -> NDArray[np.float64]:
        """Noise-free counts [h, w] at full power and 10 ms: without drift, not rounded, not clipped.

        The pattern has been shown for long, and the camera moves as it does in the mean.
        """
        gray, plane = checked_gray(gray, self.panel.shape), self._plane(plane_mm)
        motion = camera_motion(self.description, self.seed, None)
        seen = self._camera_irradiance(gray, channel, plane, motion)
        electrons = self._sensor.electrons(seen, 1.0)
        return self._sensor.counts(self._sensor.respond(electrons))

    def true_irradiance(
        self, gray: NDArray[np.generic], channel: str, plane_mm: float | None = None
    ) -> NDArray[np.float64]:
        """Noise-free irradiance over panel-sized pixels, [H, W], before any fault of the camera.

        A perfect panel under a uniform beam gives about 1. A slow panel has shown the pattern for long.

        Raises
        ------
        InputError
            For a wrong size or channel.
        """
        gray, plane = checked_gray(gray, self.panel.shape), self._plane(plane_mm)
        return (
            self._integrator(channel, plane)
            .display(self._optics.irradiance(gray, channel, plane))
            .astype(np.float64)
        )

    def oracle_pattern(
        self,
        target_irradiance: NDArray[np.floating],
        channel: str,
        plane_mm: float | None = None,
        iterations: int = 80,
        start: NDArray[np.generic] | None = None,
        progress: Callable[[int, float], None] | None = None,
    ) -> Gray:
        """The best pattern where the true bench is known. For tests and demonstrations.

        Parameters
        ----------
        target_irradiance : float array [H, W]
            Any unit, not negative.
        start : array or None
            Gray levels to start from; None: a smooth random phase at the image.
        channel : str
        plane_mm : float or None, mm
            None: the camera's focus.
        iterations : int
        progress : callable or None
            Called with the iteration and the loss.

        Returns
        -------
        uint8 array [H, W]

        Raises
        ------
        InputError
            For a target that is no picture of the panel's size, or a bench with the defect slow_response.
        """
        target = np.asarray(target_irradiance, np.float64)
        if (
            target.shape != self.panel.shape
            or not np.isfinite(target).all()
            or target.min() < 0
            or target.max() <= 0
        ):
            raise InputError(
                f"the target, {target.shape}, must be an array of the panel's size {self.panel.shape}, "
                "finite, nowhere negative and not all zero; correct it."
            )
        first = None if start is None else checked_gray(start, self.panel.shape).astype(np.float64)
        plane = self._plane(plane_mm)
        return descend(
            self._optics,
            self._integrator(channel, plane),
            target,
            channel,
            plane,
            iterations,
            first,
            progress=progress,
        )

    def _plane(self, plane_mm: float | None) -> float:
        return self.plane_mm if plane_mm is None else checked_plane(plane_mm)

    def _camera_irradiance(
        self,
        gray: Gray,
        channel: str,
        plane_mm: float,
        motion: CameraMotion | None,
        before: NDArray[np.float64] | None = None,
        field: int = 0,
    ) -> NDArray[np.float64]:
        """Irradiance on camera pixels; kept for each channel and field, since a running camera repeats most of it."""
        last = self._recent.get((channel, field))
        if last is None or not last.holds(gray, plane_mm, before):
            light = self._optics.irradiance(gray, channel, plane_mm, before)
        elif last.motion == motion:
            return last.seen
        else:
            light = last.light
        seen = self._integrator(channel, plane_mm).camera(light, motion)
        seen.flags.writeable = False
        self._recent[channel, field] = _Seen(gray.copy(), plane_mm, before, motion, light, seen)
        return seen

    def _integrator(self, channel: str, plane_mm: float) -> Integrator:
        band = self._optics.path(channel, plane_mm).band
        key = (*band.samples, band.oversampling)
        if key not in self._integrators:
            self._integrators[key] = Integrator(self.description, band.samples, band.oversampling)
            if len(self._integrators) > 4:
                self._integrators.popitem(last=False)
        return self._integrators[key]


def checked_plane(plane_mm: float) -> float:
    """A plane in mm.

    Raises
    ------
    InputError
        Unless it is a finite number within 2 m.
    """
    number = isinstance(plane_mm, int | float | np.floating | np.integer) and not isinstance(plane_mm, bool)
    if not number or not math.isfinite(plane_mm) or abs(plane_mm) > 2000:
        raise InputError(f"plane {plane_mm!r} mm is out of range; give a number from -2000 to 2000.")
    return float(plane_mm)


def open_headset(spec: str, seed: int = 0) -> VirtualHeadset:
    """Open the virtual headset of `virtual:NAME` or of a bench's TOML file.

    Raises
    ------
    InputError
        Where there is no such bench.
    """
    return VirtualHeadset(load_bench(spec), seed)
