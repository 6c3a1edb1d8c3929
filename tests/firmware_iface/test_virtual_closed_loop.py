"""The bench between byte-level models: what the panel was sent becomes what the camera sees, through the real
pyusb and depthai libraries."""

from __future__ import annotations

import importlib.util
import os

import numpy as np
import pytest

from firmware_iface.camera import open_oak
from firmware_iface.panel import open_board
from firmware_iface.panel.panel_board_messages import Timing
from firmware_iface.virtual import open_headset
from firmware_iface.virtual.bench_description import CameraDescription
from firmware_iface.virtual.oak import OakModel, expose_bench
from firmware_iface.virtual.usb import BoardModel, VirtualUsb

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))


def test_counts_are_brought_to_ten_bits_and_gain_acts_above_black() -> None:
    camera = CameraDescription(bit_depth=12, black_level=64.0)
    expose = expose_bench(lambda exposure_ms: np.array([[64, 164, 4095, 0]], np.uint16), camera)
    assert expose(1.0, 1.0).tolist() == [[16, 41, 1023, 0]]
    assert expose(1.0, 4.0).tolist() == [[16, 116, 1023, 0]]


@pytest.mark.skipif(importlib.util.find_spec("depthai") is None, reason="depthai is not installed")
def test_a_pattern_sent_over_usb_is_the_picture_that_comes_over_the_cameras_link() -> None:
    """Correlated with the bench's noise-free truth for that pattern, and not with another pattern's."""
    bench = open_headset("virtual:ideal", seed=3)
    board = BoardModel(bench.panel.shape)

    def capture(exposure_ms: float) -> np.ndarray:
        bench.panel.show(board.gray)
        bench.camera.exposure_ms = exposure_ms
        return bench.camera.capture()

    described = bench.description.camera
    oak = OakModel(expose_bench(capture, described), bench.camera.shape, f"127.0.9.{WORKER + 1}", 20)
    panel = open_board(backend=VirtualUsb(board), timing=Timing(4000, 500, 3000))
    camera = open_oak(oak.address, frames_per_s=20, exposure_ms=10.0, timeout_s=30.0, start_s=60.0)
    try:
        assert camera.capture().mean() == pytest.approx(described.black_level / 4, abs=1), "lasers are off"
        bench.lasers.set_power("green", 1.0)
        rng = np.random.default_rng(0)
        patterns = [rng.integers(0, 256, panel.shape, dtype=np.uint8) for _ in range(2)]
        truths = [bench.expected_counts(gray, "green") / 4 for gray in patterns]
        for mine, other in ((0, 1), (1, 0)):
            panel.show(patterns[mine])
            seen = camera.capture().astype(float)
            assert np.corrcoef(seen.ravel(), truths[mine].ravel())[0, 1] > 0.98
            assert abs(np.corrcoef(seen.ravel(), truths[other].ravel())[0, 1]) < 0.2
        camera.gain = 2.0
        brighter = camera.capture().astype(float)
        clear = truths[1] < 400
        black = described.black_level / 4
        ratio = (brighter - black)[clear].sum() / (seen - black)[clear].sum()
        assert ratio == pytest.approx(2, rel=0.02)
    finally:
        camera.close()
        oak.close()
