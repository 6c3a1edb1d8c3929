"""Panels of 1080 x 1920 at a display link: `kind = "tests.campaigns.screen:screen"`, or `:colours` for three in turn.

The first mirrors a screen. The second is a phase light modulator with so many mirrors, four bits each, behind the model
of its controller, whose pattern table lights three fields a frame of the display. The frame buffer is files in memory
that look as the kernel's does. What is drawn is not looked at.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from firmware_iface.panel import FieldPanel, MirroredDisplay, Panel
from firmware_iface.panel.dlpc900 import PRODUCT, VENDOR
from firmware_iface.panel.dlpc900_commands import Dlpc900Control
from firmware_iface.panel.dlpc900_video import VideoFields
from firmware_iface.panel.phase_light_modulator import P47
from firmware_iface.usb_link import UsbLink
from firmware_iface.virtual.usb import Dlpc900Model, VirtualUsb

SHAPE = (1080, 1920)
FIELDS, FIELD_US = 3, 5556  # in a frame of a display of 60 Hz
BYTES = 4  # of a pixel
MEMORY = Path("/dev/shm")


class Screen(MirroredDisplay):
    """A display whose frame buffer goes with it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._folder = tempfile.TemporaryDirectory(
            prefix="hololoop-", dir=MEMORY if MEMORY.is_dir() else None
        )
        folder = Path(self._folder.name)
        height, width = shape
        with (folder / "fb0").open("wb") as file:
            file.truncate(2 * height * width * BYTES)
        settings = folder / "settings" / "fb0"
        settings.mkdir(parents=True)
        values = {
            "virtual_size": f"{width},{2 * height}",
            "bits_per_pixel": 8 * BYTES,
            "stride": width * BYTES,
        }
        for name, value in (values | {"mode": f"U:{width}x{height}p-60", "pan": "0,0"}).items():
            (settings / name).write_text(f"{value}\n", encoding="ascii")
        super().__init__(0, shape, devices=folder, settings=settings.parent)

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


def screen() -> Panel:
    """A panel that mirrors a screen."""
    display = Screen(SHAPE)
    return Panel(display, display)


def colours() -> FieldPanel:
    """A phase light modulator that shows three colours in turn."""
    modulator = replace(P47, shape=SHAPE)
    model = Dlpc900Model(modulator.memory_shape)
    model.video = lambda: np.zeros(modulator.memory_shape, np.uint32)
    link = UsbLink(VENDOR, PRODUCT, "the phase light modulator", backend=VirtualUsb(model), timeout_s=0.5)
    control = Dlpc900Control(link, "displayport", FIELD_US, colours=True)
    return FieldPanel(control, VideoFields(control, Screen(modulator.memory_shape), modulator), FIELDS)
