"""The camera driver with the real depthai library against the emulated camera, through what can go wrong."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.camera import OakCamera, open_oak
from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.virtual.oak import OakModel
from tests.waiting import until

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("depthai") is None, reason="depthai is not installed (extra 'camera')"
)

SHAPE = (40, 64)
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
ADDRESS = f"127.0.7.{WORKER + 1}"


class Scene:
    """Irradiance that rises to the right, in counts a millisecond at gain 1."""

    def __init__(self) -> None:
        self.level = 100.0

    def __call__(self, exposure_ms: float, gain: float) -> NDArray[np.uint16]:
        ramp = np.linspace(0, 1, SHAPE[1]) * self.level * exposure_ms * gain
        return np.broadcast_to(np.clip(np.rint(ramp), 0, 1023), SHAPE).astype(np.uint16)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def oak(scene: Scene) -> Iterator[OakModel]:
    model = OakModel(scene, SHAPE, ADDRESS, frames_per_s=60)
    yield model
    model.close()


def opened(**options) -> OakCamera:
    """With time limits for a machine that does much else; only what is meant to starve waits for one."""
    limits = {"starved_s": 0.6, "timeout_s": 25.0, "start_s": 40.0}
    return open_oak(ADDRESS, **({"exposure_ms": 1.0, "frames_per_s": 60.0} | limits | options))


@pytest.fixture
def camera(oak: OakModel) -> Iterator[OakCamera]:
    driver = opened()
    yield driver
    driver.close()


def test_a_capture_shows_what_was_there_after_it_was_asked_with_the_settings_in_force(
    camera: OakCamera, scene: Scene
) -> None:
    assert camera.shape == SHAPE and camera.bit_depth == 10
    assert camera.exposure_ms == 1.0 and camera.gain == 1.0
    np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))
    for level in (200.0, 50.0, 150.0):
        scene.level = level
        np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))
    camera.exposure_ms = 2.5
    np.testing.assert_array_equal(camera.capture(), scene(2.5, 1.0))
    camera.gain = 4
    np.testing.assert_array_equal(camera.capture(), scene(2.5, 4.0))
    assert camera.status()["state"] == "streaming"


def test_eight_bit_pictures(oak: OakModel, scene: Scene) -> None:
    camera = opened(encoding="gray8", shape=SHAPE)
    try:
        assert camera.bit_depth == 8
        np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0) >> 2)
    finally:
        camera.close()


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL])
def test_a_dying_camera_process_costs_one_longer_capture(
    camera: OakCamera, scene: Scene, number: int
) -> None:
    """And the settings are in force again afterwards."""
    camera.exposure_ms = 2.0
    camera.capture()
    dead = camera.pid
    assert dead is not None
    os.kill(dead, number)
    until(lambda: camera.status()["restarts"] > 0, 25)
    assert camera.status()["last_loss"] == f"its process was ended by signal {int(number)}"
    scene.level = 77
    np.testing.assert_array_equal(camera.capture(), scene(2.0, 1.0))
    assert camera.pid != dead


def test_a_camera_process_that_hangs_is_replaced(oak: OakModel, scene: Scene) -> None:
    camera = opened()
    try:
        assert camera.pid is not None
        os.kill(camera.pid, signal.SIGSTOP)
        until(lambda: camera.status()["restarts"] > 0, 25)
        assert camera.status()["last_loss"] == "its process hung"
        np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))
    finally:
        camera.close()


@pytest.mark.parametrize("kind", ["garbage", "short_write"])
def test_a_malformed_packet_that_silences_the_stream_is_noticed(
    camera: OakCamera, oak: OakModel, scene: Scene, kind: str
) -> None:
    """The library goes on as if nothing were wrong; our watchdog sees that no frames come."""
    oak.faults.arm(kind)
    until(lambda: camera.status()["restarts"] > 0, 25)
    assert camera.status()["last_loss"] in ("frames stayed out", "the link was lost")
    np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))


def test_frames_that_come_late_or_not_at_all_delay_a_capture_only(oak: OakModel, scene: Scene) -> None:
    camera = opened(starved_s=10.0)
    try:
        oak.faults.late_s = 0.2
        oak.faults.arm("late", count=2)
        oak.faults.arm("timeout", count=4)
        scene.level = 33
        np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))
        assert camera.status()["restarts"] == 0
    finally:
        camera.close()


def shows(camera: OakCamera, expected: NDArray[np.uint16]) -> bool:
    try:
        return np.array_equal(camera.capture(), expected)
    except DeviceError:
        return False


def test_unplugged_the_capture_fails_with_the_reason_and_replugged_it_works(
    oak: OakModel, scene: Scene
) -> None:
    camera = opened(timeout_s=1.0)
    try:
        oak.faults.arm("unplug")
        time.sleep(0.1)
        with pytest.raises(DeviceError, match=r"no picture within 1 s \(.*\); it is being looked for"):
            camera.capture()
        oak.faults.clear()
        until(lambda: shows(camera, scene(1.0, 1.0)), 25)
    finally:
        camera.close()


def test_a_camera_that_refuses_a_call_is_tried_again(oak: OakModel, scene: Scene) -> None:
    oak.faults.arm("stall", after=3)
    camera = opened()
    try:
        np.testing.assert_array_equal(camera.capture(), scene(1.0, 1.0))
    finally:
        camera.close()
    assert oak.faults.struck["stall"] == 1


def test_the_camera_process_does_not_outlive_a_killed_parent(oak: OakModel) -> None:
    script = (
        "import time; from firmware_iface.camera import open_oak\n"
        f"camera = open_oak({ADDRESS!r}, exposure_ms=1.0); print(camera.pid, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    os.kill(pid, 0)
    parent.kill()
    parent.wait()
    until(lambda: not alive(pid), 25)


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_where_there_is_no_camera_opening_says_so_in_time() -> None:
    begun = time.monotonic()
    with pytest.raises(DeviceGoneError, match=r"127\.0\.8\.1 sent no picture within 1 s"):
        open_oak("127.0.8.1", start_s=1)
    assert time.monotonic() - begun < 15


def test_without_the_library_opening_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DeviceError, match="extra 'camera'"):
        open_oak("127.0.8.1")


@pytest.mark.parametrize(
    "options",
    [{"exposure_ms": 0}, {"exposure_ms": 40.0}, {"gain": 0.5}, {"gain": 17}, {"encoding": "nv12"}],
)
def test_settings_out_of_range_are_refused_before_a_camera_is_looked_for(options: dict) -> None:
    with pytest.raises(InputError, match="use|give"):
        open_oak("127.0.8.1", **options)
