"""A headset's hardware, emulated at the level of its buses' bytes, with a simulated bench between its parts.

The frame on the panel board and the light of the laser board give the camera's picture. A slow panel takes one step in
each period of the board; a picture shows it as it is in the period in which its exposure begins. The panel's light
outputs gate the lasers, in version 2 of its protocol each one to its own fields. `served` runs it in a process of its
own, so that it continues when the process that drives it dies, as hardware does.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.virtual.bench_loading import load_bench
from firmware_iface.virtual.bench_process import bench_process
from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.further_defects import SlowResponse
from firmware_iface.virtual.i2c import LaserBoard
from firmware_iface.virtual.oak import OakModel, expose_bench
from firmware_iface.virtual.usb.panel_board import EVERY_OUTPUT, BoardModel, LitPattern
from firmware_iface.virtual.virtual_devices import LitField

TICK_S = 0.001
PIXELS_PER_S = 1e7  # that the camera takes and sends: more would leave the boards no time to answer
REMEMBERED = 20000  # changes of light


class EmulatedHardware:
    """Panel board, laser board and camera around one simulated bench; key on, interlock closed.

    Parameters
    ----------
    bench : str
        As `virtual_headset.open_headset` takes it.
    seed : int
        Of noise and garbage.

    Attributes
    ----------
    bench : BenchDescription
        The simulated one.
    board : BoardModel
        The panel's.
    lasers : LaserBoard
    faults : dict of str to Faults
        The script of "panel" (its USB), "panel link" (from the board to the panel, asked once a field), "lasers" and
        "camera".
    light : deque of (float, float)
        (time s, µW of all lasers, each in its own field) at each change.
    whole : dict of int to int
        CRC-32 of each pattern that the panel displayed, and how often.
    lit : dict of (int, int) to int
        CRC-32 of what was truly on the panel in a field, and the mask of the light outputs that were open then; and
        how often. Darkness is not in it.
    """

    def __init__(self, bench: str, seed: int = 0) -> None:
        self.bench = load_bench(bench)
        self._expose = bench_process(self.bench, seed)
        self._slow = self.bench.defect(SlowResponse) is not None
        self._channels = tuple(c.name for c in self.bench.channels)
        self.board = BoardModel((self.bench.panel.height, self.bench.panel.width))
        self.light: deque[tuple[float, float]] = deque([(time.monotonic(), 0.0)], REMEMBERED)
        self.whole: dict[int, int] = {}
        self.lit: dict[tuple[int, int], int] = {}
        self.lasers = LaserBoard(
            emission=lambda at, power: self.light.append((at, sum(power.values()))),
            gates=lambda: self.board.outputs,
        )
        self.lasers.key = self.lasers.interlock = True
        self._full_uw = {d.name: 1 / d.photodiode_v_per_uw for d in self.lasers.diodes}
        self.faults = {
            "panel": self.board.faults,
            "panel link": self.board.link_faults,
            "lasers": self.lasers.bus.faults,
            "camera": Faults(seed),
        }
        self._lock = threading.Lock()

    def run(self) -> None:
        """Let time pass for the parts, without end: the dead-man acts and frames appear also without traffic."""
        while True:
            self.lasers.settle()
            self.board.outputs  # noqa: B018 - a period that is over displays what was committed
            while self.board.shown:
                _, crc = self.board.shown.popleft()
                self.whole[crc] = self.whole.get(crc, 0) + 1
            opened = self.board.sequence.opened
            while opened:
                crc, outputs = opened.popleft()
                if outputs:
                    self.lit[crc, outputs] = self.lit.get((crc, outputs), 0) + 1
            time.sleep(TICK_S)

    def capture(self, exposure_ms: float) -> NDArray[np.uint16]:
        """One picture of the camera, with its faults.

        Returns
        -------
        uint16 array [h, w], counts

        Raises
        ------
        DeviceError
            Where a fault is armed.
        """
        faults = self.faults["camera"]
        fault = faults.take("unplug", "hang", "timeout", "late", "garbage", "die")
        if fault == "unplug":
            raise DeviceGoneError("the camera is not attached; check its cable.")
        while fault == "hang" and faults.standing("hang"):
            time.sleep(TICK_S)
        if fault == "timeout":
            raise DeviceError("the camera did not deliver a picture in time.")
        if fault == "late":
            time.sleep(faults.late_s)
        counts = self.exposed(exposure_ms)
        if fault == "garbage":
            counts = np.frombuffer(faults.garbled(counts.tobytes()), np.uint16).reshape(counts.shape)
        return counts

    def exposed(self, exposure_ms: float) -> NDArray[np.uint16]:
        """One picture of the camera without its faults, uint16 counts [h, w]."""
        with self._lock:
            emitted = self.lasers.emitted_uw
            power = {c: min(1.0, emitted.get(c, 0.0) / self._full_uw.get(c, 1.0)) for c in self._channels}
            before = self.board.shown_before() if self._slow else ()
            return self._expose(self._lit_fields(exposure_ms * 1e-3), power, exposure_ms, before)

    def _lit_fields(self, exposure_s: float) -> tuple[LitField, ...]:
        """The patterns on the panel, with the share of an exposure that begins now in which each is lit."""
        frame_s, into_s, patterns = self.board.lit()
        names = [diode.name for diode in self.lasers.diodes]
        return tuple(
            LitField(
                pattern.gray,
                sum(
                    1 << k
                    for k, channel in enumerate(self._channels)
                    if channel in names and pattern.outputs >> names.index(channel) & 1
                ),
                _lit_s(pattern, frame_s, into_s, into_s + exposure_s) / exposure_s,
            )
            for pattern in patterns
        )

    def set_to(self, name: str, value: Any) -> None:
        """Change the surroundings of the laser board.

        Parameters
        ----------
        name : str
            "key" or "interlock" (bool), "celsius", "photodiodes" (False: cut), "efficiency" (of every diode; 1: as
            calibrated), "gated" (False: the gates are open, as where a panel has no light outputs).
        value : bool or float

        Raises
        ------
        InputError
            For another name.
        """
        if name in ("key", "interlock", "celsius"):
            setattr(self.lasers, name, value)
            return
        if name == "gated":
            self.lasers.gates = (lambda: self.board.outputs) if value else (lambda: EVERY_OUTPUT)
            return
        if name not in ("photodiodes", "efficiency"):
            raise InputError(f"the laser board has no '{name}'.")
        for k, diode in enumerate(self.lasers.diodes):
            if name == "photodiodes":
                self.lasers.break_photodiode(k, not value)
            else:
                diode.efficiency = value
        self.lasers.settle()

    def attach_oak(self, address: str) -> None:
        """Emulate an OAK camera in front of the bench, at a loopback address; its faults are the camera's."""
        height, width = self.bench.camera.height, self.bench.camera.width
        self.oak = OakModel(
            expose_bench(self.exposed, self.bench.camera),
            (height, width),
            address,
            frames_per_s=min(120.0, PIXELS_PER_S / (height * width)),
            faults=self.faults["camera"],
        )

    def light_since(self, since_s: float) -> list[tuple[float, float]]:
        """(time s, µW of all lasers): the light at `since_s`, and each change after it."""
        self.lasers.settle()
        changes = list(self.light)
        first = max((k for k, (at, _) in enumerate(changes) if at <= since_s), default=0)
        return changes[first:]


def _lit_s(pattern: LitPattern, frame_s: float, begin_s: float, end_s: float) -> float:
    """For how long a pattern is lit between two times, both counted from the start of a frame."""

    def until(at_s: float) -> float:
        frames, into_s = divmod(at_s, frame_s)
        return frames * pattern.width_s + min(max(into_s - pattern.begins_s, 0.0), pattern.width_s)

    return until(end_s) - until(begin_s)
