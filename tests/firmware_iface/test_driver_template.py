"""The tests that a new driver starts from; copied together with firmware_iface/driver_template.py."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.driver_template import Thermometer, parse_temperature
from firmware_iface.errors import DeviceError, DeviceGoneError
from firmware_iface.virtual.usb import UsbModel, VirtualUsb
from firmware_iface.virtual.usb.usb_model import (
    Stall,
    configuration_descriptor,
    device_descriptor,
    interface_descriptor,
)

from .usb_transcript import Transcript


class ThermometerModel(UsbModel):
    """The device, written from its documentation: request 1 gives i16 0.01 °C and its complement."""

    def __init__(self, temperature_c: float) -> None:
        self.temperature_c = temperature_c
        super().__init__(
            device_descriptor(0x1209, 0x0002),
            configuration_descriptor(interface_descriptor(0, 0xFF)),
            ("hololoop", "thermometer", "T1"),
        )

    def on_control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        if (kind, request) != (0xC0, 1):
            raise Stall
        hundredths = round(100 * self.temperature_c)
        return struct.pack("<hh", hundredths, ~hundredths)


def test_the_bytes_of_opening_and_reading() -> None:
    bus = Transcript(ThermometerModel(-1.5))
    assert Thermometer(bus).temperature_c() == -1.5
    assert bus.lines == ["c0 01 0000 < 6a ff 95 00"]


@pytest.mark.parametrize("kind", ["stall", "garbage", "timeout", "hang", "late"])
def test_each_fault_is_one_sentence_and_passes(kind: str) -> None:
    model = ThermometerModel(30.25)
    thermometer = Thermometer(VirtualUsb(model), timeout_s=0.02)
    model.faults.arm(kind)
    with pytest.raises(DeviceError, match=r"the thermometer.*; .*\."):
        thermometer.temperature_c()
    model.faults.clear()
    assert thermometer.temperature_c() == 30.25


def test_unplugged_and_replugged() -> None:
    model = ThermometerModel(20)
    thermometer = Thermometer(VirtualUsb(model))
    model.faults.arm("unplug")
    for _ in range(2):
        with pytest.raises(DeviceGoneError):
            thermometer.status()
    model.faults.clear()
    assert thermometer.status() == {"temperature_c": 20}


@given(st.binary(max_size=8))
def test_any_reply_is_a_temperature_or_refused(reply: bytes) -> None:
    try:
        hundredths = round(100 * parse_temperature(reply))
        assert reply == struct.pack("<hh", hundredths, ~hundredths)
    except ValueError as error:
        assert "garbled" in str(error)
