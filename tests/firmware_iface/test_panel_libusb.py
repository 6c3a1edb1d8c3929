"""The panel board's driver through the real libusb, on an emulated usbfs: the same bytes, errors and recovery."""

from __future__ import annotations

import ctypes.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.virtual.usb import BoardModel

from .usbfs import UsbFs

pytestmark = pytest.mark.slow

CLIENT = """
import json, sys
import numpy as np, usb.backend.libusb1
from firmware_iface.errors import DeviceError
from firmware_iface.panel import open_board
from firmware_iface.panel.panel_board_messages import Timing

assert usb.backend.libusb1.get_backend() is not None
panel = open_board(timing=Timing(2000, 500, 1000), timeout_s=0.3)
print(json.dumps(panel.shape), flush=True)
for line in sys.stdin:
    gray = np.random.default_rng(int(line)).integers(0, 256, panel.shape, dtype=np.uint8)
    try:
        panel.show(gray)
        print(json.dumps("shown"), flush=True)
    except DeviceError as error:
        print(json.dumps(f"{type(error).__name__}: {error}"), flush=True)
"""


@pytest.fixture
def board(tmp_path: Path):
    try:
        ctypes.CDLL("libumockdev-preload.so.0")
    except OSError:
        pytest.skip("umockdev is not installed (apt install umockdev libusb-1.0-0)")
    if ctypes.util.find_library("usb-1.0") is None:
        pytest.skip("libusb is not installed (apt install libusb-1.0-0)")
    model = BoardModel((600, 800))
    usbfs = UsbFs(tmp_path, model)
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT],
        env=usbfs.environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

    def show(seed: int) -> str:
        assert client.stdin is not None and client.stdout is not None
        print(seed, file=client.stdin, flush=True)
        return json.loads(client.stdout.readline())

    assert client.stdout is not None
    assert json.loads(client.stdout.readline()) == [600, 800]
    yield usbfs, show
    client.kill()
    client.wait()


def pattern(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (600, 800), dtype=np.uint8)


def test_frames_faults_and_recovery_through_libusb(board) -> None:
    usbfs, show = board
    model = usbfs.model
    for seed in range(3):
        assert show(seed) == "shown"
        np.testing.assert_array_equal(model.gray, pattern(seed))
    for seed, kind in enumerate(("stall", "garbage", "short_write", "timeout"), start=10):
        model.faults.arm(kind)
        assert show(seed) == "shown", kind
        np.testing.assert_array_equal(model.gray, pattern(seed))
    model.faults.arm("hang", count=None)
    assert show(20).startswith("DeviceError: the panel board did not answer within 0.3 s")
    model.faults.clear()
    assert show(21) == "shown"
    model.faults.arm("unplug")
    usbfs.unplug()
    for _ in range(2):
        assert show(22).startswith("DeviceGoneError")
    assert not model.gray.any()
    model.faults.clear()
    usbfs.plug()
    assert show(23) == "shown"
    np.testing.assert_array_equal(model.gray, pattern(23))
