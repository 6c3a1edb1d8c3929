"""The bench that a command works on, opened by name: a virtual one, or a real headset by its configuration."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, read_bench

if TYPE_CHECKING:
    from runtime.headset.open_devices import Devices


@dataclass(frozen=True)
class OpenBench:
    """A bench that is open.

    Attributes
    ----------
    headset : object
        Its panel, lasers and camera, as `trainer.captures.acquire.Headset` describes.
    bench : Bench
        What is known of it.
    planes_mm : tuple of float, mm
        The planes worth capturing.
    """

    headset: Any
    bench: Bench
    planes_mm: tuple[float, ...]


@dataclass
class RealHeadset:
    """Real devices as `acquire_captures` needs them: lasers within their set powers, a clock, and a focus.

    Attributes
    ----------
    panel, lasers, camera : devices
    power : mapping of str to float
        Fraction of full power of each colour while it is lit.
    focus_mm : float, mm
        The plane that the camera is focused on.
    focus : callable, optional
        Moves the focus to a plane, mm.
    simulated : bool
        Whether the devices are emulated.
    started : float, s
        Of the monotonic clock.
    """

    panel: Any
    lasers: Any
    camera: Any
    power: Mapping[str, float]
    focus_mm: float
    focus: Any = None
    simulated: bool = False
    started: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.lasers = _LimitedLasers(self.lasers, self.power)

    @property
    def time_s(self) -> float:
        """Seconds since it was opened."""
        return time.monotonic() - self.started

    def move_to_plane(self, plane_mm: float) -> None:
        """Focus the camera on a plane.

        Raises
        ------
        InputError
            Where the focus cannot be moved and the plane is another one.
        """
        if self.focus is not None:
            self.focus(plane_mm)
        elif abs(plane_mm - self.focus_mm) > 1e-6:
            raise InputError(
                f"the camera is focused on {self.focus_mm:g} mm and cannot be moved to {plane_mm:g} mm: capture that "
                "plane in a run of its own"
            )


@dataclass
class _LimitedLasers:
    """Lasers whose full power is what the configuration allows."""

    lasers: Any
    power: Mapping[str, float]

    def set_power(self, channel: str, fraction: float) -> None:
        self.lasers.set_power(channel, fraction * self.power.get(channel, 1.0))

    def off(self) -> None:
        self.lasers.off()


@contextmanager
def open_bench(spec: str, seed: int = 0, known: Bench | None = None) -> Iterator[OpenBench]:
    """Open a bench; its lasers are off when the block ends.

    Parameters
    ----------
    spec : str
        `virtual:NAME`, a virtual bench's TOML file, or a real headset's configuration.
    seed : int
        Of a virtual bench's noise.
    known : Bench, optional
        What is known of a real headset's bench; its configuration does not hold it.

    Yields
    ------
    OpenBench

    Raises
    ------
    InputError
        For an unknown bench, or devices that are not those of `known`.
    DeviceError
        Where a device fails.
    """
    from firmware_iface.virtual import open_headset
    from runtime.headset.open_devices import configuration_of, is_simulated, open_devices

    if configuration_of(spec) is None:
        virtual = open_headset(spec, seed)
        yield OpenBench(virtual, nominal_bench(virtual), virtual.description.planes_mm)
        return
    if known is None:
        raise InputError(
            f"--bench {spec} is a real headset: give --known or --model, which says what is known of its bench"
        )
    with open_devices(spec, seed) as devices:
        check_devices(devices, known)
        headset = RealHeadset(
            devices.panel,
            devices.lasers,
            devices.camera,
            devices.power,
            known.distance_mm,
            devices.focus,
            is_simulated(spec),
        )
        yield OpenBench(headset, known, (known.distance_mm,))


def check_devices(devices: Devices | Any, bench: Bench) -> None:
    """Refuse devices that are not those of a bench: other sizes, another bit depth, or a colour without a laser.

    Parameters
    ----------
    devices : Devices
        Or a virtual headset.
    bench : Bench
        What is known of the bench.

    Raises
    ------
    InputError
    """
    for what, actual, stated in (
        ("panel is (rows, columns)", devices.panel.shape, bench.panel.shape),
        ("camera's picture is (rows, columns)", devices.camera.shape, bench.camera.shape),
        ("camera's bit depth is", devices.camera.bit_depth, bench.camera.bit_depth),
    ):
        if actual != stated:
            raise InputError(f"the {what} {actual} and the bench file says {stated}: correct it there")
    for channel in bench.channels:
        if channel.name not in devices.lasers.channels:
            names = ", ".join(devices.lasers.channels)
            raise InputError(
                f"the bench file has a channel '{channel.name}' and the lasers are {names}: correct one"
            )


def nominal_bench(headset: Any) -> Bench:
    """The bench file that a person would write for a virtual headset: nothing of what is hidden in it."""
    tables = headset.description.nominal()
    levels = tables["panel"]["levels"]
    if float(levels).is_integer():
        tables["panel"]["levels"] = int(levels)
    return read_bench(tables)
