"""A panel that mirrors a screen, on files that look as the kernel's frame buffer does."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel import MirroredDisplay, Panel, dlpc900, dlpc900_commands, open_dlpc900
from firmware_iface.panel import phase_light_modulator as plm
from firmware_iface.virtual.usb import Dlpc900Model, VirtualUsb

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


def pattern(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


@pytest.mark.parametrize("bits", [8, 24, 32])
def test_gray_goes_to_every_colour_and_the_half_in_sight_is_never_drawn_in(tmp_path: Path, bits: int) -> None:
    screen = Screen(tmp_path, bits)
    display = screen.display()
    panel = Panel(display, display)
    panel.show(pattern(0))
    for seed in range(1, 4):
        before = screen.scanned_out().copy()
        display._set = lambda name, value: None  # type: ignore[method-assign]  # the pan does not come yet
        display.send(pattern(seed))
        np.testing.assert_array_equal(screen.scanned_out(), before)
        del display._set
        display._sent -= 1
        panel.show(pattern(seed))
        colours = screen.scanned_out()[..., :3]
        np.testing.assert_array_equal(colours, np.broadcast_to(pattern(seed)[..., None], colours.shape))
    assert panel.status()["mode"] == "U:12x8p-60"
    panel.close()
    assert not screen.scanned_out().any()
    panel.close()


def test_a_screen_that_cannot_carry_the_panel_is_refused(tmp_path: Path) -> None:
    screen = Screen(tmp_path)
    screen.set("bits_per_pixel", 16)
    with pytest.raises(InputError, match="16 bits a pixel.*fbset"):
        screen.display()
    screen.set("bits_per_pixel", 32)
    screen.set("virtual_size", "12,10")
    with pytest.raises(InputError, match="two screens of 5 rows.*vyres 12"):
        screen.display()


def test_a_screen_that_is_not_there_or_off_is_said_so(tmp_path: Path) -> None:
    screen = Screen(tmp_path)
    with pytest.raises(DeviceGoneError, match="fb2 is not there"):
        MirroredDisplay(2, SHAPE, 0, devices=screen.devices, settings=screen.settings)
    display = screen.display()
    with pytest.raises(DeviceError, match="shows frame 0"):
        display.wait(3)
    (screen.settings / "fb1" / "pan").unlink()
    (screen.settings / "fb1" / "pan").mkdir()
    with pytest.raises(DeviceError, match="does not pan"):
        display.send(pattern(0))
    screen.memory.unlink()
    with pytest.raises(DeviceGoneError, match="cannot be mapped"):
        screen.display()


def test_control_over_usb_and_frames_over_the_display_link_make_one_panel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The two parts are separate: a phase light modulator in video-pattern mode, its bits on the screen."""
    screen = Screen(tmp_path, columns=20, rows=24)
    monkeypatch.setattr(
        dlpc900,
        "MirroredDisplay",
        partial(MirroredDisplay, settle_s=0, devices=screen.devices, settings=screen.settings),
    )
    model = Dlpc900Model((12, 20))
    modulator = replace(plm.P47, shape=SHAPE)

    def opened() -> Panel:
        return open_dlpc900(1, modulator=modulator, backend=VirtualUsb(model), timeout_s=0.1)

    monkeypatch.setattr(dlpc900_commands, "LOCK_S", 0.05)
    with pytest.raises(DeviceError, match="no picture on displayport"):
        opened()
    model.video = lambda: screen.scanned_out((12, 20)).astype(np.uint32) @ [1 << 16, 1 << 8, 1, 0]
    panel = opened()
    assert panel.status()["mode"] == "video-pattern" and panel.status()["running"]
    states = np.rint(plm.phase_waves() * 256).astype(np.uint8)
    gray = np.random.default_rng(1).choice(states, SHAPE)
    panel.show(gray)
    np.testing.assert_array_equal(model.gray, gray)
    assert not model.images, "nothing was uploaded"
