"""Files that look as the kernel's frame buffer does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from firmware_iface.panel import MirroredDisplay

SHAPE = (6, 10)


class Screen:
    """The kernel's side: memory, settings, and what is scanned out."""

    def __init__(self, folder: Path, bits: int = 32, columns: int = 12, rows: int = 16) -> None:
        self.bytes, self.stride = bits // 8, columns * bits // 8 + 8
        self.devices, self.settings = folder / "dev", folder / "sys"
        self.devices.mkdir()
        (self.settings / "fb1").mkdir(parents=True)
        self.memory = self.devices / "fb1"
        self.memory.write_bytes(bytes(range(256)) * (rows * self.stride // 256 + 1))
        values = {"virtual_size": f"{columns},{rows}", "bits_per_pixel": bits, "stride": self.stride}
        for name, value in (values | {"mode": "U:12x8p-60", "pan": "0,0"}).items():
            self.set(name, value)

    def set(self, name: str, value: object) -> None:
        (self.settings / "fb1" / name).write_text(f"{value}\n", encoding="ascii")

    def scanned_out(self, shape: tuple[int, int] = SHAPE) -> np.ndarray:
        """Pixels of the panel's place, [H, W, bytes], in the half that is panned to."""
        top = int((self.settings / "fb1" / "pan").read_text(encoding="ascii").split(",")[1])
        rows = np.frombuffer(self.memory.read_bytes(), np.uint8)
        rows = rows[: len(rows) // self.stride * self.stride].reshape(-1, self.stride)
        height, width = shape
        return rows[top : top + height, : width * self.bytes].reshape(height, width, self.bytes)

    def display(self) -> MirroredDisplay:
        return MirroredDisplay(1, SHAPE, 0.001, devices=self.devices, settings=self.settings)
