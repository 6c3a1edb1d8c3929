"""A panel that mirrors a screen, on files that look as the kernel's frame buffer does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel import MirroredDisplay, Panel

from .frame_buffer import SHAPE, Screen


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
