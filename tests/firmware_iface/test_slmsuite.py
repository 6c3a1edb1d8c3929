"""Panels and cameras that slmsuite drives, behind our interface: small stand-ins, and slmsuite's own simulation."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.slmsuite import SlmsuiteCamera, SlmsuitePanel


class Slm:
    """What of slmsuite's interface is used, with its rules: integers of the display's own type only."""

    name, shape = "stand-in", (4, 6)

    def __init__(self, bitdepth: int) -> None:
        self.bitdepth, self.closed = bitdepth, False

    def set_phase(self, phase: np.ndarray, settle: bool) -> None:
        assert settle and phase.dtype == (np.uint8 if self.bitdepth <= 8 else np.uint16)
        assert phase.max() < 1 << self.bitdepth
        self.display = phase.copy()

    def close(self) -> None:
        self.closed = True


class Camera:
    """Rows of their own number, brighter with exposure; between 1 and 100 ms."""

    name, shape, bitdepth = "stand-in", (3, 5), 12

    def __init__(self) -> None:
        self.exposure_s, self.stale, self.closed = 0.01, True, False

    def get_exposure(self) -> float:
        return self.exposure_s

    def set_exposure(self, exposure_s: float) -> None:
        self.exposure_s = min(max(exposure_s, 0.001), 0.1)

    def flush(self) -> None:
        self.stale = False

    def get_image(self, hdr: bool, averaging: bool) -> np.ndarray:
        assert not hdr and not averaging
        picture = np.indices(self.shape)[0] * self.exposure_s * 1e5
        stale, self.stale = self.stale, True
        return np.full(self.shape, 4095) if stale else picture.astype(np.uint16)

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(("bits", "levels"), [(8, [0, 127, 255]), (10, [0, 508, 1020]), (4, [0, 7, 15])])
def test_gray_levels_reach_the_panel_in_its_own_range(bits: int, levels: list[int]) -> None:
    slm = Slm(bits)
    panel = SlmsuitePanel(slm)
    panel.show(np.tile(np.array([[0, 127, 255]], np.uint8), (4, 2)))
    assert slm.display[0, :3].tolist() == levels
    with pytest.raises(InputError, match="4, 6"):
        panel.show(np.zeros((6, 4), np.uint8))
    assert panel.status()["bit_depth"] == bits
    panel.close()
    assert slm.closed


def test_pictures_are_fresh_and_exposures_in_ms() -> None:
    source = Camera()
    camera = SlmsuiteCamera(source)
    camera.exposure_ms = 4.0
    assert source.exposure_s == pytest.approx(0.004) and camera.exposure_ms == pytest.approx(4)
    for _ in range(2):  # the picture that waited in the camera is not the one that is given
        counts = camera.capture()
        assert counts.dtype == np.uint16 and counts[:, 0].tolist() == [0, 400, 800]
    with pytest.raises(InputError, match="took 100 ms"):
        camera.exposure_ms = 500.0


def test_what_the_library_raises_and_pictures_that_are_none_become_device_errors() -> None:
    source = Camera()
    camera = SlmsuiteCamera(source)
    source.get_image = lambda **_: np.zeros((3, 5, 3))  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="monochrome"):
        camera.capture()
    source.flush = lambda: 1 / 0  # type: ignore[assignment,return-value]
    with pytest.raises(DeviceError, match="division"):
        camera.capture()
    slm = Slm(8)
    slm.set_phase = lambda *a, **k: 1 / 0  # type: ignore[assignment,method-assign,return-value]
    with pytest.raises(DeviceError, match="division"):
        SlmsuitePanel(slm).show(np.zeros((4, 6), np.uint8))


@pytest.mark.slow
def test_the_real_slmsuite() -> None:
    """`pip install slmsuite` in an environment of its own; its simulated panel takes our gray levels as they are."""
    pytest.importorskip("slmsuite", reason="slmsuite is not installed (pip install slmsuite)")
    from slmsuite.hardware.cameras.simulated import SimulatedCamera
    from slmsuite.hardware.slms.simulated import SimulatedSLM

    for bits in (8, 10):
        slm = SimulatedSLM((64, 48), bitdepth=bits)
        panel = SlmsuitePanel(slm)
        gray = np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)
        panel.show(gray)
        assert panel.shape == (48, 64)
        np.testing.assert_array_equal(slm.display, gray.astype(np.uint16) << (bits - 8))
    camera = SlmsuiteCamera(SimulatedCamera(slm, resolution=(64, 48), bitdepth=12))
    camera.exposure_ms = 2.0
    counts = camera.capture()
    assert counts.shape == camera.shape and counts.dtype == np.uint16
