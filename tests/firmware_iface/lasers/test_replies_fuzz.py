"""Whatever the bus replies, each driver gives a number in range or a DeviceError; nothing else, and nothing endless."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers
from firmware_iface.lasers.ads1115 import Ads1115
from firmware_iface.lasers.mcp4728 import decode
from firmware_iface.lasers.safety_controller import Fault, Input, SafetyController, State, packet_error_code
from firmware_iface.lasers.tmp117 import Tmp117


class ReplyBus:
    """A bus whose replies are given: what smbus2.SMBus is to the drivers."""

    def __init__(self, replies: bytes, proper_code: bool) -> None:
        self.replies, self.proper_code, self.transfers = replies, proper_code, 0

    def i2c_rdwr(self, *messages: object) -> None:
        self.transfers += 1
        for m in messages:
            if m.flags & 1:  # type: ignore[attr-defined]
                data, self.replies = self.replies[: len(m)], self.replies[len(m) :]  # type: ignore[arg-type]
                data = data.ljust(len(m), b"\xff")  # type: ignore[arg-type]
                if self.proper_code and m.addr == 0x36:  # type: ignore[attr-defined]
                    asked = bytes(messages[0])[0]  # type: ignore[call-overload]
                    code = packet_error_code(bytes([0x6C, asked, 0x6D]) + data[:-1])
                    data = data[:-1] + bytes([code])
                for i, byte in enumerate(data):
                    m.buf[i] = byte  # type: ignore[attr-defined]

    def close(self) -> None:
        pass


@given(st.binary(max_size=40))
@example(bytes(24))
def test_the_dacs_reply(reply: bytes) -> None:
    try:
        now, at_power_on = decode(reply)
    except DeviceError:
        return
    assert len(reply) == 24
    for output in now + at_power_on:
        assert 0 <= output.code <= 4095


@given(st.binary(min_size=2, max_size=2))
def test_words_are_in_the_parts_ranges(reply: bytes) -> None:
    assert -2.048 <= Ads1115(ReplyBus(reply, False)).volts() < 2.048
    assert -256 <= Tmp117(ReplyBus(reply, False)).celsius() < 256


@given(st.binary(max_size=64), st.booleans())
def test_the_safety_controllers_replies(reply: bytes, proper_code: bool) -> None:
    for ask, kind in (("state", State), ("faults", Fault), ("inputs", Input), ("token", int)):
        try:
            assert isinstance(getattr(SafetyController(ReplyBus(reply, proper_code)), ask)(), kind)
        except DeviceError:
            continue
    for laser in range(3):
        try:
            assert all(
                0 <= v <= 6.5536 for v in SafetyController(ReplyBus(reply, proper_code)).ceilings_v(laser)
            )
        except DeviceError:
            continue


# what a board in order answers while it is opened, so that the fuzz gets past it
OPENING = [
    bytes([0x4C, 0]),
    bytes([1, 0]),
    b"".join(bytes([0xC0 | c << 4, 0xE0, 0]) for c in (0, 0, 1, 1, 2, 2, 3, 3)),
]


@given(st.binary(max_size=200), st.integers(0, 3), st.booleans())
def test_opening_and_using_ends_in_bounded_time_and_in_a_device_error(
    noise: bytes, kept: int, proper: bool
) -> None:
    bus = ReplyBus(b"".join(OPENING[:kept]) + noise, proper)
    now = 0.0

    def wait(seconds: float) -> None:
        nonlocal now
        now += seconds

    try:
        lasers = Lasers(bus, VIRTUAL_CHANNELS, lambda: now, wait)  # type: ignore[arg-type]
        for act in (lasers.clear, lasers.arm, lasers.heartbeat, lasers.status, lasers.off):
            act()
        lasers.set_power("red", 1.0)
    except (DeviceError, InputError):  # InputError: the board says that it was built for other lasers
        pass
    assert bus.transfers < 400


def test_a_state_that_nobody_knows_is_said() -> None:
    with pytest.raises(DeviceError, match="unknown state 9"):
        SafetyController(ReplyBus(b"\x09", True)).state()  # type: ignore[arg-type]
