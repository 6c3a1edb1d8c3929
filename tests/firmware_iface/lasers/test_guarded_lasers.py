"""Every way out of the process ends dark, in real time: a board in this process, the guard and its client in others."""

from __future__ import annotations

import functools
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS
from firmware_iface.lasers.guarded_lasers import GuardedLasers, open_guarded_lasers
from firmware_iface.virtual.i2c import LaserBoard
from firmware_iface.virtual.i2c.bus_server import BoardServer

pytestmark = pytest.mark.usefixtures("real_time")

ROOT = Path(__file__).resolve().parents[3]
SLACK_S = 0.15  # for a machine that has other work: everything is measured by the clock on the wall

CLIENT = """
import os, sys, time
from firmware_iface.lasers import VIRTUAL_CHANNELS, open_lasers
from firmware_iface.errors import DeviceError
from firmware_iface.lasers.guarded_lasers import open_guarded_lasers
opened = {open}(sys.argv[1], VIRTUAL_CHANNELS)
with opened as lasers:
    for attempt in range(5):  # a machine that stalls for 100 ms may need more than one
        try:
            lasers.clear()
            lasers.arm()
            lasers.set_power("green", 1.0)
            break
        except DeviceError:
            continue
    print("on", flush=True)
    for i in range(1000):
        lasers.heartbeat()
        time.sleep(0.02)
        if i == 5:
            {end}
"""


def patient(test: Callable[..., None]) -> Callable[..., None]:
    """Try a test up to five times: on a machine that stalls for 100 ms, the lasers rightly go off."""

    @functools.wraps(test)
    def tried(light: Light, lasers: GuardedLasers) -> None:
        for _ in range(4):
            try:
                return test(light=light, lasers=lasers)
            except DeviceError as error:
                assert not light.on() and re.search(
                    "silent|heartbeat|photodiode|not armed|latched", str(error)
                )
                light.board.key = light.board.interlock = True
                lasers.clear()
        test(light=light, lasers=lasers)

    return tried


class Light:
    """The light of a served board, as it changed over time."""

    def __init__(self, folder: Path) -> None:
        self.changes: list[tuple[float, float]] = []
        self.board = LaserBoard(emission=lambda t, p: self.changes.append((t, sum(p.values()))))
        self.board.key = self.board.interlock = True
        self.server = BoardServer(self.board, folder / "bus")
        self.bus = f"virtual:{folder / 'bus'}"

    def on(self) -> bool:
        return bool(self.changes) and self.changes[-1][1] > 0

    def dark_after(self, moment_s: float) -> float:
        """How long after a moment of time.monotonic() the light went out for good."""
        while self.on() and time.monotonic() < moment_s + 3:
            time.sleep(0.005)
        time.sleep(0.05)
        assert not self.on(), "still on after 3 s"
        return self.changes[-1][0] - moment_s


@pytest.fixture
def light(tmp_path: Path) -> Iterator[Light]:
    light = Light(tmp_path)
    yield light
    light.server.close()


@pytest.fixture
def lasers(light: Light) -> Iterator[GuardedLasers]:
    with open_guarded_lasers(light.bus, VIRTUAL_CHANNELS) as lasers:
        yield lasers


def client(light: Light, end: str = "pass", how: str = "open_guarded_lasers") -> subprocess.Popen[str]:
    script = CLIENT.format(end=end, open=how)
    process = subprocess.Popen(
        [sys.executable, "-c", script, light.bus],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "on\n", process.communicate()[1]
    assert any(power > 0 for _, power in light.changes)
    return process


def show(lasers: GuardedLasers) -> None:
    """Light; on a machine that stalls, which rightly ends an attempt, after some attempts."""
    until = time.monotonic() + 20
    while True:
        try:
            lasers.clear()
            lasers.arm()
            return lasers.set_power("red", 0.5)
        except DeviceGoneError:
            raise
        except DeviceError:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


@pytest.mark.parametrize(
    ("how", "within_s"), [("open_guarded_lasers", 0.0), ("open_lasers", 0.1)], ids=["guarded", "direct"]
)
@pytest.mark.parametrize(
    "end",
    [
        "raise RuntimeError",
        "sys.exit(3)",
        "os._exit(3)",
        "os.abort()",
        "os.kill(os.getpid(), 9)",
        "os.kill(os.getpid(), 15)",
        "os.kill(os.getpid(), 2)",
        "os.kill(os.getpid(), 11)",
    ],
)
def test_a_program_that_ends_in_any_way_ends_dark(light: Light, end: str, how: str, within_s: float) -> None:
    """At once where a guard is left to do it, and by the dead-man where not."""
    process = client(light, end, how)
    process.communicate(timeout=20)
    assert process.returncode != 0
    assert light.dark_after(time.monotonic()) < within_s + SLACK_S
    assert not light.board.controller.armed


def test_a_program_that_is_stopped_is_missed(light: Light) -> None:
    process = client(light)
    began = time.monotonic()
    process.send_signal(signal.SIGSTOP)
    took = light.dark_after(began)
    process.send_signal(signal.SIGCONT)
    _, error = process.communicate(timeout=20)
    assert took < 0.1 + SLACK_S
    assert "silent for 100 ms" in error


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGSEGV])
def test_a_guard_that_ends_or_hangs_leaves_it_to_the_dead_man(light: Light, number: int) -> None:
    with open_guarded_lasers(light.bus, VIRTUAL_CHANNELS) as lasers, lasers.beating():
        show(lasers)
        began = time.monotonic()
        os.kill(lasers.pid, number)
        took = light.dark_after(began)
        assert took < 0.1 + SLACK_S
        with pytest.raises(DeviceGoneError):
            lasers.set_power("red", 1.0)
        lasers.off()


def test_after_a_guard_was_killed_a_new_one_goes_on(light: Light, lasers: GuardedLasers) -> None:
    show(lasers)
    os.kill(lasers.pid, signal.SIGKILL)
    light.dark_after(time.monotonic())
    with open_guarded_lasers(light.bus, VIRTUAL_CHANNELS) as again:
        with pytest.raises(DeviceError, match="heartbeat"):
            again.arm()
        show(again)


@patient
def test_the_interface_of_the_lasers(light: Light, lasers: GuardedLasers) -> None:
    assert lasers.channels == ("red", "green", "blue")
    lasers.arm()
    with lasers.beating():
        lasers.set_power("red", 0.25)
        assert (lasers.power("red"), lasers.power("blue")) == (0.25, 0)
        assert light.changes[-1][1] == pytest.approx(30, abs=0.2)
        lasers.set_power("blue", 1.0)
        lasers.set_power("red", 0.0)
        assert light.changes[-1][1] == pytest.approx(15, abs=0.1)
        time.sleep(0.3)  # the thread beats
        status = lasers.status()
        assert (status["state"], status["faults"], status["power"]["blue"]) == ("emit", [], 1.0)
        assert lasers.expect({"red": [0.1] * 13}) == 1
        lasers.off()
        assert not light.on()
        for wrong in ("pink", ""):
            with pytest.raises(InputError, match="there is no laser"):
                lasers.set_power(wrong, 1.0)
        with pytest.raises(InputError, match="give 0 to 1"):
            lasers.set_power("red", 2.0)
        lasers.set_power("red", 0.25)
        assert light.on(), "a refusal leaves it armed"
    lasers.off()


@patient
def test_a_fault_is_reported_with_the_next_heartbeat_and_until_it_is_armed_again(
    light: Light, lasers: GuardedLasers
) -> None:
    lasers.arm()
    lasers.set_power("green", 1.0)
    light.board.interlock = False
    assert not light.on()
    time.sleep(0.1)
    for _ in range(2):
        with pytest.raises(DeviceError, match="interlock"):
            lasers.heartbeat()
    light.board.interlock = True
    with pytest.raises(DeviceError, match=r"clear\(\)"):
        lasers.arm()
    lasers.clear()
    lasers.arm()
    lasers.heartbeat()


@patient
def test_an_off_in_the_middle_of_a_ramp_stops_it(light: Light, lasers: GuardedLasers) -> None:
    lasers.arm()
    lasers._ask("set_power", "green", 1.0)
    time.sleep(0.03)
    lasers.off()
    for _ in range(10):
        time.sleep(0.02)
        lasers.heartbeat()
        assert not light.on()


def test_what_cannot_be_opened_is_said(tmp_path: Path) -> None:
    for bus in (f"virtual:{tmp_path}/nothing", "/dev/i2c-99"):
        with pytest.raises(InputError, match="cannot be opened"):
            open_guarded_lasers(bus, VIRTUAL_CHANNELS)


@pytest.mark.parametrize(
    "packet",
    [b"x", b"{}", b"[]", b'{"do": "open"}', b'{"do": "fly", "with": []}', b'{"do": "status", "with": {"a": 1}}',
     b'{"do": "set_power", "with": [1, [2]]}', b'{"do": [], "with": []}', b"[" * 9000, b'{"do": "arm", "with": [7]}'],
)  # fmt: skip
def test_requests_that_make_no_sense_are_refused(lasers: GuardedLasers, packet: bytes) -> None:
    lasers._socket.send(packet)
    assert b"input" in lasers._socket.recv(65536)
    assert lasers.status()["state"] == "off"


def within(seconds: float, holds: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)
    return holds()


@patient
def test_closing_ends_the_guard(light: Light, lasers: GuardedLasers) -> None:
    lasers.arm()
    lasers.close()
    assert within(1, lambda: not light.board.controller.armed)
    lasers.close()
    with pytest.raises(DeviceGoneError):
        lasers.heartbeat()
