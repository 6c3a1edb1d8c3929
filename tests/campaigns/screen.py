"""A panel of 1080 x 1920 that mirrors a screen: `kind = "tests.campaigns.screen:screen"`.

Its frame buffer is files in memory that look as the kernel's does. What is drawn is not looked at.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from firmware_iface.panel import MirroredDisplay, Panel

SHAPE = (1080, 1920)
BYTES = 4  # of a pixel
MEMORY = Path("/dev/shm")


class Screen(MirroredDisplay):
    """A display whose frame buffer goes with it."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(
            prefix="hololoop-", dir=MEMORY if MEMORY.is_dir() else None
        )
        folder = Path(self._folder.name)
        height, width = SHAPE
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
        super().__init__(0, SHAPE, devices=folder, settings=settings.parent)

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


def screen() -> Panel:
    """The panel."""
    display = Screen()
    return Panel(display, display)
