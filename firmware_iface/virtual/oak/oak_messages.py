"""Messages of an emulated OAK camera, as depthai 3.12 has them: frames, controls and answers to remote calls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.oak.libnop import Encoded, Unsigned, encode
from firmware_iface.virtual.oak.xlink import LinkDown

SERIAL = "14442C10EMU0000001"
CONTROL = 8  # kind of a message on a stream
_FRAME = 2
_MARKER = bytes.fromhex("abcdef0123456789123456789abcdef0")
_RAW10, _GRAY8 = 17, 30  # pixel formats


def pack_raw10(counts: NDArray[np.uint16]) -> bytes:
    """MIPI RAW10: of four pixels the high eight bits each, then a byte of their low two bits."""
    groups = counts.reshape(-1, 4)
    out = np.empty((len(groups), 5), np.uint8)
    out[:, :4] = groups >> 2
    out[:, 4] = ((groups & 3) << np.arange(0, 8, 2, dtype=np.uint16)).sum(1)
    return out.tobytes()


@dataclass(frozen=True)
class SensorExposure:
    """One exposure; `end_s` is its end, monotonic s."""

    counts: NDArray[np.uint16]
    end_s: float
    exposure_ms: float
    gain: float


def frame_message(exposure: SensorExposure, source: str, number: int) -> bytes:
    """A frame as it is sent; `source` is "raw" for RAW10, any other name for GRAY8."""
    counts = exposure.counts
    height, width = counts.shape
    if source == "raw":
        data, stride, kind = pack_raw10(counts), width * 10 // 8, _RAW10
    else:
        data, stride, kind = (counts >> 2).astype(np.uint8).tobytes(), width, _GRAY8
    second, nanosecond = divmod(int(exposure.end_s * 1e9), 10**9)
    moment = (second, nanosecond)
    form = (Unsigned(kind), Unsigned(width), Unsigned(height), Unsigned(stride), Unsigned(1), 0, 0, 0)
    settings = (round(exposure.exposure_ms * 1000), round(exposure.gain * 100), 0, 0, 0.0, 0, -1, -1.0, None)
    metadata = (moment, moment, None, number, form, form, settings, 0, 0, _geometry(width, height))
    body = encode(metadata)
    return data + body + _FRAME.to_bytes(4, "little") + len(body).to_bytes(4, "little") + _MARKER


def split_message(message: bytes) -> tuple[int, bytes]:
    """(kind, metadata) of a message; the data before the metadata is not used."""
    if len(message) < 24 or message[-16:] != _MARKER:
        raise LinkDown
    size = int.from_bytes(message[-20:-16], "little")
    return int.from_bytes(message[-24:-20], "little"), message[-24 - size : -24]


def _geometry(width: int, height: int) -> tuple[Any, ...]:
    """An image that was neither cropped nor turned, and a lens without calibration."""
    rows = (encode([float(i == j) for j in range(3)]) for i in range(3))
    unit = Encoded(b"\xba\x03" + b"".join(rows))
    size = Unsigned(width), Unsigned(height)
    nowhere = ((0.0,) * 3, (0.0,) * 3)
    lens: tuple[Any, ...] = ([], *nowhere, -1, 1, "")
    return (lens, unit, unit, unit, unit, 0, [], *size, *size, [])


def camera_features(height: int, width: int) -> dict[str, Any]:
    """The answer to getConnectedCameraFeatures."""
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
FIXED_ANSWERS: dict[str, Any] = {
    "buildPipeline": [True, ""],
    "enableCrashDump": None,
    "getAnonymousTelemetryId": "",
    "getCalibration": [False, "none", {}],
    "getCameraSensorNames": [[0, "OV9282"]],
    "getChipTemperature": {"css": 45.0, "mss": 45.0, "upa": 45.0, "dss": 45.0, "average": 45.0},
    "getConnectedCameras": [0],
    "getMxId": SERIAL,
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
CALLS = {_call_number(name): name for name in (*FIXED_ANSWERS, *_LIVE)}
