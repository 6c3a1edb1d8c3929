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
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.oak import nop
from firmware_iface.virtual.oak.nop import Encoded, Unsigned
from firmware_iface.virtual.oak.xlink import Link, LinkDown, discovery_answer, listen

Expose = Callable[[float, float], NDArray[np.uint16]]

_SERIAL = "14442C10EMU0000001"
_MARKER = bytes.fromhex("abcdef0123456789123456789abcdef0")
_FRAME, _CONTROL = 2, 8  # kinds of message on a stream
_RAW10, _GRAY8 = 17, 30  # pixel formats
_MANUAL_EXPOSURE = 6  # bit of a control's command mask


class OakModel:
    """The camera; frames run from when a host has started a pipeline until it goes.

    expose : given exposure in ms and gain, one picture, 10-bit counts uint16 [h, w] with w a multiple of 4;
        called when an exposure begins
    shape : (h, w), pixels
    address : loopback address, so that several can run side by side
    frames_per_s : rate, unless the exposure is longer
    faults : asked for each frame (hang, timeout: not sent; late; garbage, short_write: malformed, which
        ends the stream in the host) and each remote call (stall: refused); "unplug" drops the link and
        lets nobody in

    Attributes: exposure_ms and gain (as the host set them), frames (how many were sent).
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
                answer = discovery_answer(question, _SERIAL)
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
            elif call not in _CALLS:
                reply = [1, 2, 0, f"no function {call}"]
            else:
                result = self._call(_CALLS[call], arguments)
                reply = [1, 2, 1, [True, ""] + ([] if result is None else [result])]
            link.send(stream, msgpack.packb(reply, use_bin_type=True))

    def _call(self, name: str, arguments: list[Any]) -> Any:
        if name == "setPipelineSchema":
            self._pipeline = arguments[0]
            for _, node in arguments[0]["nodes"]:
                if node["name"] == "Camera":  # its properties begin with the initial control
                    self._control(nop.decode(bytes(node["properties"]))[0])
        elif name == "startPipeline":
            self._started.set()
        elif name == "isPipelineRunning":
            return self._started.is_set()
        elif name == "getConnectedCameraFeatures":
            return [_features(*self.shape)]
        else:
            return _ANSWERS[name]
        return None

    def _take_controls(self, link: Link, name: str, stream: int) -> None:
        while True:
            kind, metadata = _opened_message(link.receive(stream))
            if kind == _CONTROL:
                self._control(nop.decode(metadata))

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
        taken: _Taken | None = None
        coming: Future[_Taken] | None = None
        with ThreadPoolExecutor(1, "oak exposure") as sensor:
            while link.alive:
                begin = time.monotonic()
                coming = coming or sensor.submit(self._take)
                wait([coming], max(self._period_s, self.exposure_ms / 1000))
                if coming.done():
                    taken, coming = coming.result(), None
                # a bench that takes longer than a frame to compute must not silence the stream: meanwhile the
                # frame before is sent again, with the time at which it was exposed
                if taken is not None and self._send(link, stream, _frame_message(taken, source, number)):
                    number += 1
                self._sleep_until(begin + self._period_s)

    def _send(self, link: Link, stream: int, frame: bytes) -> bool:
        """Send a frame as the faults say; whether it was sent."""
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

    def _take(self) -> _Taken:
        """One exposure: what is there when it begins, at the time when it ends."""
        exposure_ms, gain = self.exposure_ms, self.gain
        end_s = time.monotonic() + exposure_ms / 1000
        counts = self._expose(exposure_ms, gain)
        self._sleep_until(end_s)
        return _Taken(counts, end_s, exposure_ms, gain)

    def _sleep_until(self, moment: float) -> None:
        self._closed.wait(max(0, moment - time.monotonic()))

    def _source(self, name: str) -> str | None:
        """Which output of the camera a stream is linked to: "raw", or the name of another."""
        assert self._pipeline is not None
        nodes = dict(self._pipeline["nodes"])
        for connection in self._pipeline["connections"]:
            if nodes[connection["node2Id"]]["name"] != "XLinkOut":
                continue
            properties = nop.decode(bytes(nodes[connection["node2Id"]]["properties"]))
            if name in properties and nodes[connection["node1Id"]]["name"] == "Camera":
                return str(connection["node1Output"])
        return None


def pack_raw10(counts: NDArray[np.uint16]) -> bytes:
    """MIPI RAW10: of four pixels the high eight bits each, then a byte of their low two bits."""
    groups = counts.reshape(-1, 4)
    out = np.empty((len(groups), 5), np.uint8)
    out[:, :4] = groups >> 2
    out[:, 4] = ((groups & 3) << np.arange(0, 8, 2, dtype=np.uint16)).sum(1)
    return out.tobytes()


@dataclass(frozen=True)
class _Taken:
    counts: NDArray[np.uint16]
    end_s: float
    exposure_ms: float
    gain: float


def _frame_message(taken: _Taken, source: str, number: int) -> bytes:
    counts = taken.counts
    height, width = counts.shape
    if source == "raw":
        data, stride, kind = pack_raw10(counts), width * 10 // 8, _RAW10
    else:
        data, stride, kind = (counts >> 2).astype(np.uint8).tobytes(), width, _GRAY8
    second, nanosecond = divmod(int(taken.end_s * 1e9), 10**9)
    moment = (second, nanosecond)
    form = (Unsigned(kind), Unsigned(width), Unsigned(height), Unsigned(stride), Unsigned(1), 0, 0, 0)
    settings = (round(taken.exposure_ms * 1000), round(taken.gain * 100), 0, 0, 0.0, 0, -1, -1.0, None)
    metadata = (moment, moment, None, number, form, form, settings, 0, 0, _geometry(width, height))
    body = nop.encode(metadata)
    return data + body + _FRAME.to_bytes(4, "little") + len(body).to_bytes(4, "little") + _MARKER


def _opened_message(message: bytes) -> tuple[int, bytes]:
    """(kind, metadata) of a message; the data before the metadata is of no use here."""
    if len(message) < 24 or message[-16:] != _MARKER:
        raise LinkDown
    size = int.from_bytes(message[-20:-16], "little")
    return int.from_bytes(message[-24:-20], "little"), message[-24 - size : -24]


def _geometry(width: int, height: int) -> tuple[Any, ...]:
    """An image that was neither cropped nor turned, and a lens nobody calibrated."""
    rows = (nop.encode([float(i == j) for j in range(3)]) for i in range(3))
    unit = Encoded(b"\xba\x03" + b"".join(rows))
    size = Unsigned(width), Unsigned(height)
    nowhere = ((0.0,) * 3, (0.0,) * 3)
    lens: tuple[Any, ...] = ([], *nowhere, -1, 1, "")
    return (lens, unit, unit, unit, unit, 0, [], *size, *size, [])


def _features(height: int, width: int) -> dict[str, Any]:
    field = {"x": 0.0, "y": 0.0, "width": 1.0, "height": 1.0, "normalized": True, "hasNormalized": True}
    mode = {"width": width, "height": height, "minFps": 1.0, "maxFps": 120.0, "fov": field, "type": 1}
    return {
        "socket": 0,
        "sensorName": "OV9282",
        "width": width,
        "height": height,
        "orientation": 0,
        "supportedTypes": [1],
        "hasAutofocusIC": False,
        "hasAutofocus": False,
        "name": "mono",
        "calibrationResolution": None,
        "additionalNames": [],
        "configs": [mode | {"hdr": False, "hfr": False}],
    }


def _call_number(name: str) -> int:
    number = 1125899906842597
    for byte in name.encode():
        number = (31 * number + byte) % 2**64
    return number


# remote calls whose answer never changes
_ANSWERS: dict[str, Any] = {
    "buildPipeline": [True, ""],
    "enableCrashDump": None,
    "getAnonymousTelemetryId": "",
    "getCalibration": [False, "none", {}],
    "getCameraSensorNames": [[0, "OV9282"]],
    "getChipTemperature": {"css": 45.0, "mss": 45.0, "upa": 45.0, "dss": 45.0, "average": 45.0},
    "getConnectedCameras": [0],
    "getMxId": _SERIAL,
    "getNodeLogLevel": 3,
    "getOSVersion": "0.0.0",
    "getUsbSpeed": 0,
    "getXLinkChunkSize": -1,
    "hasCrashDump": False,
    "isRunning": True,
    "onInit": None,
    "readAssetStorageFromXLink": None,
    "readFromEeprom": [False, "none", {}],
    "readFromEepromFactory": [False, "none", {}],
    "setAssets": None,
    "setLogLevel": None,
    "setNodeLogLevel": None,
    "setSystemInformationLoggingRate": None,
    "setTimesync": None,
    "setXLinkChunkSize": None,
    "waitForDeviceReady": [True, ""],
}
_LIVE = ("setPipelineSchema", "startPipeline", "isPipelineRunning", "getConnectedCameraFeatures")
_CALLS = {_call_number(name): name for name in (*_ANSWERS, *_LIVE)}
