"""The process that owns the camera. It runs depthai and nothing else, because that library can end its process.

Started by `ProcessKeeper` with one argument, JSON. It ends by itself when no frames come, when the link is lost
and when its parent ends; a new one is started in its place. It never reconnects.
"""

from __future__ import annotations

import ctypes
import datetime
import json
import os
import select
import signal
import sys
import time
from typing import Any

from firmware_iface.camera.process_messages import Frame, frame_message, state_message

LOST, STARVED, FAILED = 11, 12, 13  # exit codes

FIRST_S = 5.0  # for the first frame: a sensor needs time to start

_ENVIRONMENT = {  # read by the library when it is loaded
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_RECONNECT_TIMEOUT": "0",
    "DEPTHAI_CRASHDUMP_TIMEOUT": "100",
    "DEPTHAI_SEARCH_TIMEOUT": "1000",
    "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0",
    "DEPTHAI_LEVEL": "off",
}


def main(argument: str) -> None:
    """Find the camera, stream until something ends it. Never returns."""
    job = json.loads(argument)
    _die_with(job["parent"])
    os.environ.update(_ENVIRONMENT)
    child = _CameraStream(job)
    try:
        child.report("starting")
        import depthai as dai

        device = child.search(dai)
        child.stream(dai, device)
    except BrokenPipeError:
        os._exit(0)
    except Exception as error:
        child.report(f"failed: {error}")
        os._exit(FAILED)


def _die_with(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends in any way."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)


class _CameraStream:
    def __init__(self, job: dict[str, Any]) -> None:
        self._job = job
        self._out, self._in = job["out"], job["in"]
        self._exposure_us, self._iso = job["exposure_us"], job["iso"]

    def report(self, text: str) -> None:
        self._write(state_message(text))

    def search(self, dai: Any) -> Any:
        """The opened camera, as soon as it is found."""
        while True:
            self.report("searching")
            self._read_settings()
            try:
                address = self._job["address"]
                device = dai.Device(dai.DeviceInfo(address)) if address else dai.Device()
            except RuntimeError as error:
                self.report(f"searching: {error}")
                time.sleep(0.2)
                continue
            device.setMaxReconnectionAttempts(0, lambda state: None)
            return device

    def stream(self, dai: Any, device: Any) -> None:
        """Send every frame on."""
        self.report("opening")
        job = self._job
        height, width = job["shape"]
        pipeline = dai.Pipeline(device)
        camera = pipeline.create(dai.node.Camera).build(
            dai.CameraBoardSocket.CAM_A, sensorFps=job["frames_per_s"]
        )
        camera.initialControl.setManualExposure(self._exposure_us, self._iso)
        if job["encoding"] == "raw10":
            output = camera.raw
        else:
            output = camera.requestOutput((width, height), type=dai.ImgFrame.Type.GRAY8)
        queue = output.createOutputQueue(maxSize=1, blocking=False)
        control = camera.inputControl.createInputQueue()
        pipeline.start()
        last, reported = time.monotonic(), 0.0
        limit_s = max(job["starved_s"], FIRST_S)
        while True:
            if self._read_settings():
                order = dai.CameraControl()
                order.setManualExposure(self._exposure_us, self._iso)
                control.send(order)
            try:
                image = queue.get(datetime.timedelta(milliseconds=20))
            except dai.MessageQueue.QueueException:
                self.report("the link was lost")
                os._exit(LOST)
            now = time.monotonic()
            if image is not None:
                self._write(frame_message(_frame(image)))
                last, limit_s = now, job["starved_s"]
            elif now - last > limit_s + self._exposure_us * 2e-6:
                self.report("no frames came")
                os._exit(STARVED)  # without closing: the library may hang in it
            if now - reported > 0.2:
                self.report("streaming")
                reported = now

    def _read_settings(self) -> bool:
        """Read settings from the parent; whether there were any. A closed pipe means: stop."""
        changed = False
        while select.select([self._in], [], [], 0)[0]:
            data = os.read(self._in, 4096)
            if not data:
                os._exit(0)
            self._exposure_us, self._iso = json.loads(data.decode().strip().splitlines()[-1])
            changed = True
        return changed

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self._out, view) :]


def _frame(image: Any) -> Frame:
    return Frame(
        image.getHeight(),
        image.getWidth(),
        image.getStride(),
        round(image.getExposureTime() / datetime.timedelta(microseconds=1)),
        image.getSensitivity(),
        image.getSequenceNum(),
        round(image.getTimestamp() / datetime.timedelta(microseconds=1) * 1000),
        bytes(image.getData()),
    )


if __name__ == "__main__":
    main(sys.argv[1])
