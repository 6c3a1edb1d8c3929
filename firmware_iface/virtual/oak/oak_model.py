"""An emulated OAK camera with one OV9282: the real depthai library opens it over 127.0.0.x and streams from it.

It starts where a booted device is: firmware upload, USB and the image processor are not emulated. It runs
in threads, so the library must be in another process (as `firmware_iface.camera` has it): it holds the
interpreter's lock while it waits for answers.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.oak.libnop import decode
from firmware_iface.virtual.oak.oak_messages import (
    CALLS,
    CONTROL,
    FIXED_ANSWERS,
    SERIAL,
    SensorExposure,
    camera_features,
    frame_message,
    split_message,
)
from firmware_iface.virtual.oak.xlink import Link, discovery_answer, listen

Expose = Callable[[float, float], NDArray[np.uint16]]

_MANUAL_EXPOSURE = 6  # bit of a control's command mask


class OakModel:
    """The camera; frames run from the start of a host's pipeline until the host ends the link.

    Parameters
    ----------
    expose : callable
        From exposure in ms and gain to 10-bit counts, uint16 array [h, w], w a multiple of 4; called
        when an exposure begins.
    shape : (int, int)
        (h, w), pixels.
    address : str
        Loopback address, so that several can run side by side.
    frames_per_s : float
        Rate, unless the exposure is longer.
    faults : Faults or None
        Asked for each frame (hang, timeout: not sent; late; garbage, short_write: malformed, which ends
        the stream in the host) and each remote call (stall: refused); "unplug" drops the link and refuses
        every host.

    Attributes
    ----------
    exposure_ms : float, ms
    gain : float
        As the host set them.
    frames : int
        How many were sent.
    """

    def __init__(
        self,
        expose: Expose,
        shape: tuple[int, int] = (800, 1280),
        address: str = "127.0.0.1",
        frames_per_s: float = 30.0,
        faults: Faults | None = None,
    ) -> None:
        self.address, self.shape = address, shape
        self.faults = faults or Faults()
        self.exposure_ms, self.gain = 1.0, 1.0
        self.frames = 0
        self._expose = expose
        self._period_s = 1 / frames_per_s
        self._pipeline: dict[str, Any] | None = None
        self._started = threading.Event()
        self._closed = threading.Event()
        self._link: Link | None = None
        self._discovery, self._links = listen(address)
        for work in (self._answer_discovery, self._accept, self._watch_cable):
            threading.Thread(target=work, name=f"oak {work.__name__}", daemon=True).start()

    def close(self) -> None:
        """Cut the link and free the address."""
        self._closed.set()
        self._drop()
        for opened in (self._discovery, self._links):
            with suppress(OSError):
                opened.shutdown(2)  # wakes the thread that waits on it
            opened.close()

    def _answer_discovery(self) -> None:
        while not self._closed.is_set():
            try:
                question, host = self._discovery.recvfrom(64)
                answer = discovery_answer(question, SERIAL)
                if answer and not self.faults.standing("unplug"):
                    self._discovery.sendto(answer, host)
            except OSError:
                if self._closed.is_set():
                    return

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._links.accept()
            except OSError:
                continue
            if self.faults.take("unplug"):
                connection.close()
                continue
            self._drop()  # one host at a time
            self._pipeline = None
            self._started.clear()
            self._link = Link(connection, self._opened)
            threading.Thread(target=self._link.run, name="oak link", daemon=True).start()

    def _watch_cable(self) -> None:
        while not self._closed.wait(0.01):
            if self._link is not None and self._link.alive and self.faults.take("unplug"):
                self._drop()

    def _drop(self) -> None:
        if self._link is not None:
            self._link.drop()

    def _opened(self, link: Link, name: str, stream: int) -> None:
        """The host opened a stream: calls, controls for the camera, or frames from it."""
        works: list[Callable[[Link, str, int], None]]
        if name == "__rpc_main":
            works = [self._serve_calls]
        elif name == "__watchdog":
            works = [self._drain, self._keep_alive]
        elif name.startswith("__x_"):
            works = [self._take_controls, self._stream]
        else:
            works = [self._drain]

        def until_down(work: Callable[[Link, str, int], None]) -> None:
            with suppress(OSError):
                work(link, name, stream)

        for work in works:
            threading.Thread(target=until_down, args=(work,), name=f"oak {name}", daemon=True).start()

    def _drain(self, link: Link, name: str, stream: int) -> None:
        while True:
            link.receive(stream)

    def _keep_alive(self, link: Link, name: str, stream: int) -> None:
        while link.alive:
            link.send(stream, bytes(4))
            time.sleep(0.3)

    def _serve_calls(self, link: Link, name: str, stream: int) -> None:
        import msgpack

        while True:
            _, _, call, arguments = msgpack.unpackb(link.receive(stream), strict_map_key=False)
            if self.faults.take("stall"):
                reply: list[Any] = [1, 2, 0, "refused"]
            elif call not in CALLS:
                reply = [1, 2, 0, f"no function {call}"]
            else:
                result = self._call(CALLS[call], arguments)
                reply = [1, 2, 1, [True, ""] + ([] if result is None else [result])]
            link.send(stream, msgpack.packb(reply, use_bin_type=True))

    def _call(self, name: str, arguments: list[Any]) -> Any:
        if name == "setPipelineSchema":
            self._pipeline = arguments[0]
            for _, node in arguments[0]["nodes"]:
                if node["name"] == "Camera":  # its properties begin with the initial control
                    self._control(decode(bytes(node["properties"]))[0])
        elif name == "startPipeline":
            self._started.set()
        elif name == "isPipelineRunning":
            return self._started.is_set()
        elif name == "getConnectedCameraFeatures":
            return [camera_features(*self.shape)]
        else:
            return FIXED_ANSWERS[name]
        return None

    def _take_controls(self, link: Link, name: str, stream: int) -> None:
        while True:
            kind, metadata = split_message(link.receive(stream))
            if kind == CONTROL:
                self._control(decode(metadata))

    def _control(self, control: Any) -> None:
        if control[0] >> _MANUAL_EXPOSURE & 1:
            exposure_us, iso = control[6][:2]
            self.exposure_ms, self.gain = exposure_us / 1000, iso / 100

    def _stream(self, link: Link, name: str, stream: int) -> None:
        self._started.wait()
        source = self._source(name)
        if source is None:
            return
        number = 0
        newest: SensorExposure | None = None
        coming: Future[SensorExposure] | None = None
        with ThreadPoolExecutor(1, "oak exposure") as sensor:
            while link.alive:
                begin = time.monotonic()
                coming = coming or sensor.submit(self._take)
                wait([coming], max(self._period_s, self.exposure_ms / 1000))
                if coming.done():
                    newest, coming = coming.result(), None
                # a bench that takes longer than a frame to compute must not interrupt the stream: meanwhile the
                # frame before is sent again, with the time at which it was exposed
                if newest is not None and self._send(link, stream, frame_message(newest, source, number)):
                    number += 1
                self._sleep_until(begin + self._period_s)

    def _send(self, link: Link, stream: int, frame: bytes) -> bool:
        """Send a frame, with its faults; whether it was sent."""
        fault = self.faults.take("hang", "timeout", "late", "garbage", "short_write")
        if fault in ("hang", "timeout"):
            return False
        if fault == "late":
            self._sleep_until(time.monotonic() + self.faults.late_s)
        elif fault == "garbage":
            frame = self.faults.garbled(frame)
        elif fault == "short_write":
            frame = frame[: len(frame) // 2]
        link.send(stream, frame)
        self.frames += 1
        return True

    def _take(self) -> SensorExposure:
        """One exposure: the picture at its begin, with the time of its end."""
        exposure_ms, gain = self.exposure_ms, self.gain
        end_s = time.monotonic() + exposure_ms / 1000
        counts = self._expose(exposure_ms, gain)
        self._sleep_until(end_s)
        return SensorExposure(counts, end_s, exposure_ms, gain)

    def _sleep_until(self, moment: float) -> None:
        self._closed.wait(max(0, moment - time.monotonic()))

    def _source(self, name: str) -> str | None:
        """Which output of the camera a stream is linked to: "raw", or the name of another."""
        assert self._pipeline is not None
        nodes = dict(self._pipeline["nodes"])
        for connection in self._pipeline["connections"]:
            if nodes[connection["node2Id"]]["name"] != "XLinkOut":
                continue
            properties = decode(bytes(nodes[connection["node2Id"]]["properties"]))
            if name in properties and nodes[connection["node1Id"]]["name"] == "Camera":
                return str(connection["node1Output"])
        return None
