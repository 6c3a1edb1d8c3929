"""Devices of a headset behind their drivers: a picture of lasers that a fault has put out is refused."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import DeviceError
from runtime.headset.followed_camera import FollowedCamera
from runtime.headset.open_devices import open_devices
from tests.campaigns.headset import SHAPE, hardware, write_configuration

pytestmark = pytest.mark.usefixtures("real_time")


def test_a_picture_after_the_lasers_went_dark_is_refused_and_the_fault_is_named(tmp_path: Path) -> None:
    configuration = write_configuration(tmp_path)
    with hardware(tmp_path) as remote, open_devices(str(configuration)) as devices:
        devices.panel.show(np.zeros(SHAPE, np.uint8))
        devices.light("green")
        assert devices.camera.capture().shape == devices.camera.shape
        remote.set_to("interlock", False)
        time.sleep(0.2)
        with pytest.raises(DeviceError, match="interlock"):
            devices.camera.capture()


def test_the_camera_is_otherwise_the_one_that_was_opened() -> None:
    class Camera:
        bit_depth, exposure_ms = 10, 5.0

    camera = Camera()
    lit = FollowedCamera(camera, lambda counts: None)
    lit.exposure_ms = 7
    assert (lit.bit_depth, lit.exposure_ms, camera.exposure_ms) == (10, 7, 7)
    assert getattr(lit, "longest_exposure_ms", 3) == 3
    with pytest.raises(AttributeError):
        lit.gian = 2  # type: ignore[attr-defined]
