"""A headset that shows colours in turn, for captures of its colours: each one has light in its own fields alone.

Where a frame has several fields for each colour, all of a colour's show the same pattern: a picture is of one
pattern, with as much light as the service's pictures have. A picture of the camera is of whole frames, so that it has
all of a field's light wherever in a frame it begins. The time of the light in a field makes it darker or brighter:
`exposure_ms` is of light, as where a laser shines without pause. A laser is switched on when a frame with its field
is displayed, and off before its field is dark, so that its photodiode always shows the light that there is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface.configured_devices import panel_fields
from firmware_iface.errors import InputError, nearest
from firmware_iface.panel.fields import SHORTEST_LIGHT_US, Field, colours_in_turn, light_times_us
from runtime.headset.open_devices import FULL, Devices, configuration_of, open_devices

CLOCKS_DIFFER = 1.001  # a camera's longest exposure may be a frame, but for the rounding of two clocks


@contextmanager
def open_colours(spec: str, colours: Sequence[str], seed: int = 0) -> Iterator[Devices]:
    """The devices of a headset, to light and capture its colours; gated to fields where its configuration says so.

    Parameters
    ----------
    spec : str
        As `open_devices` takes it.
    colours : sequence of str
        In the order of their fields.
    seed : int
        Of a virtual bench's noise.

    Yields
    ------
    Devices

    Raises
    ------
    InputError
        As `open_devices`, and where a frame has fewer fields than there are colours.
    DeviceError
        As `open_devices`.
    """
    tables = configuration_of(spec)
    fields = 1 if tables is None else panel_fields(tables["panel"])
    with open_devices(spec, seed, fields, _each(fields, colours)) as devices:
        yield devices if fields == 1 else gated(devices, colours, fields)


def _each(fields: int, colours: Sequence[str]) -> int:
    """How many fields of a frame each colour has."""
    return max(1, fields // len(colours))


def gated(devices: Devices, colours: Sequence[str], fields: int) -> Devices:
    """Devices whose panel shows `fields` fields, as devices that light each colour in its own fields alone.

    Raises
    ------
    InputError
        Where a frame has fewer fields than there are colours, or a colour has no laser.
    """
    for colour in colours:
        if colour not in devices.lasers.channels:
            raise InputError(f"the headset has no laser '{colour}', which the bundle is for: check both")
    if len(colours) > fields:
        raise InputError(
            f"a frame has {fields} fields and there are {len(colours)} colours ({', '.join(colours)}): write fields = "
            f"{len(colours)} in [panel]"
        )
    panel = ColourPanel(devices, colours, fields)
    camera = WholeFrameCamera(devices.camera, panel)
    return _GatedDevices(panel, devices.lasers, camera, devices.power, devices.focus)


class ColourPanel:
    """A field panel that gives light to the fields of some colours, and none to the others.

    Parameters
    ----------
    devices : Devices
        Whose panel shows fields.
    colours : sequence of str
        In the order of their fields.
    fields : int
        Of a frame; each colour has as many, and those that are left over are dark.

    Attributes
    ----------
    each : int
        Fields of each colour.
    shape : (int, int)
        (H, W), pixels.
    light_us : int, µs
        Time of the light in a field, from the next frame that is shown.
    """

    def __init__(self, devices: Devices, colours: Sequence[str], fields: int) -> None:
        self.shape: tuple[int, int] = tuple(devices.panel.shape)
        self._devices, self._colours, self._fields = devices, tuple(colours), fields
        self.each = _each(fields, self._colours)
        self._lit: tuple[str, ...] = ()
        self._waiting: tuple[str, ...] = ()  # those of `_lit` whose laser is still off
        self.light_us = self.most_us

    @property
    def most_us(self) -> int:
        """Time of the longest light in a field, µs."""
        return light_times_us(self._devices.panel.field_us)[1]

    @property
    def frame_us(self) -> int:
        """Time of a frame, µs."""
        return int(self._devices.panel.field_us) * self._fields

    def light(self, colours: Sequence[str]) -> None:
        """Switch the lasers off; those of `colours` go on with the next frame, and light their own fields.

        Raises
        ------
        InputError
            For a colour without a field.
        """
        for colour in colours:
            if colour not in self._colours:
                raise InputError(f"'{colour}' has no field; {nearest(colour, self._colours)}")
        self._devices.lasers.off()
        if self._lit:
            time.sleep(2e-6 * self.frame_us)  # each field has passed once without light
        self._lit = self._waiting = tuple(colours)

    def show(self, gray: np.ndarray) -> None:
        """Show one pattern, uint8 [H, W], in every field of a frame."""
        self.show_colours(np.stack([gray] * len(self._colours)))

    def show_colours(self, grays: np.ndarray) -> None:
        """Show a pattern for each colour, uint8 [C, H, W], each in its own fields.

        Raises
        ------
        InputError
            For another type or size.
        DeviceError
            Where the panel or a laser fails.
        """
        lasers = [self._devices.lasers.channels.index(colour) for colour in self._colours]
        share = self.light_us / self.most_us
        brightness = [share if colour in self._lit else 0.0 for colour in self._colours]
        frame = self.each * colours_in_turn(grays, lasers, brightness, self._devices.panel.field_us)
        frame += [Field(grays[-1], 0, 0, 0)] * (self._fields - len(frame))
        self._devices.panel.show_fields(frame)
        for colour in self._waiting:
            self._devices.lasers.set_power(colour, self._devices.power.get(colour, FULL))
        self._waiting = ()


class WholeFrameCamera:
    """A camera in front of a panel of fields, whose pictures are of whole frames.

    Parameters
    ----------
    camera : object
        The headset's.
    panel : ColourPanel

    Attributes
    ----------
    shape : (int, int)
        (h, w), pixels.
    bit_depth : int
        Bits of a count.
    """

    def __init__(self, camera: Any, panel: ColourPanel) -> None:
        self.shape: tuple[int, int] = tuple(camera.shape)
        self.bit_depth: int = camera.bit_depth
        self._camera, self._panel = camera, panel
        self.exposure_ms = 1e-3 * panel.most_us

    @property
    def exposure_ms(self) -> float:
        """Time of light in a picture, ms: of a colour's fields, over as many frames as it takes.

        The next pattern that is shown has it. Setting it raises InputError where the camera cannot expose for so many
        frames.
        """
        return self._exposure_ms

    @exposure_ms.setter
    def exposure_ms(self, value: float) -> None:
        each = self._panel.each
        frames = max(1, math.ceil(1000 * value / (each * self._panel.most_us) - 1e-6))
        light_us = max(SHORTEST_LIGHT_US, round(1000 * value / (each * frames)))
        whole_ms = 1e-3 * frames * self._panel.frame_us
        longest_ms = getattr(self._camera, "longest_exposure_ms", math.inf)
        if longest_ms < whole_ms <= longest_ms * CLOCKS_DIFFER:
            whole_ms = longest_ms
        self._camera.exposure_ms = whole_ms
        self._panel.light_us, self._exposure_ms = light_us, 1e-3 * each * frames * light_us

    def capture(self) -> np.ndarray:
        """One picture, uint16 counts [h, w], black level included."""
        return np.asarray(self._camera.capture())


@dataclass(frozen=True)
class _GatedDevices(Devices):
    """Devices whose panel is a ColourPanel."""

    def light_all(self, channels: Sequence[str]) -> None:
        """Light these colours in their own fields from the next pattern on, and no other."""
        self.panel.light(channels)
