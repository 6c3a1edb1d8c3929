"""Adafruit's CircuitPython drivers, unmodified, against our models: they are not merely our own opinion.

pip install adafruit-circuitpython-{mcp4728,ads1x15,mcp230xx,tmp117}
pytest -m oracle tests/firmware_iface/lasers
"""

from __future__ import annotations

import os
from typing import Any

import pytest
import smbus2

from tests.firmware_iface.lasers.boards import Bench

pytestmark = pytest.mark.oracle
WHY = "Adafruit's CircuitPython drivers are not installed"


class CircuitPythonBus:
    """What CircuitPython calls busio.I2C, over the real smbus2 and so over the emulated adapter."""

    def __init__(self, bus: smbus2.SMBus) -> None:
        self._bus = bus

    def try_lock(self) -> bool:
        return True

    def unlock(self) -> None:
        pass

    def writeto(self, address: int, buffer: Any, *, start: int = 0, end: int | None = None, **_: Any) -> None:
        self._bus.i2c_rdwr(smbus2.i2c_msg.write(address, bytes(buffer[start:end])))

    def readfrom_into(
        self, address: int, buffer: Any, *, start: int = 0, end: int | None = None, **_: Any
    ) -> None:
        end = len(buffer) if end is None else end
        message = smbus2.i2c_msg.read(address, end - start)
        self._bus.i2c_rdwr(message)
        buffer[start:end] = bytes(message)

    def writeto_then_readfrom(
        self, address: int, out: Any, into: Any, *, out_start: int = 0, out_end: int | None = None,
        in_start: int = 0, in_end: int | None = None, **_: Any,
    ) -> None:  # fmt: skip
        in_end = len(into) if in_end is None else in_end
        message = smbus2.i2c_msg.read(address, in_end - in_start)
        self._bus.i2c_rdwr(smbus2.i2c_msg.write(address, bytes(out[out_start:out_end])), message)
        into[in_start:in_end] = bytes(message)


@pytest.fixture
def wires(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> CircuitPythonBus:
    monkeypatch.setattr("time.sleep", bench.pass_time)
    os.environ.setdefault("BLINKA_OS_AGNOSTIC", "1")  # they look for the board they run on
    return CircuitPythonBus(bench.bus)


def test_adafruits_mcp4728(bench: Bench, wires: CircuitPythonBus, monkeypatch: pytest.MonkeyPatch) -> None:
    adafruit = pytest.importorskip("adafruit_mcp4728", reason=WHY)
    monkeypatch.setattr(adafruit, "sleep", bench.pass_time)
    dac = adafruit.MCP4728(wires)
    dac.channel_b.vref = adafruit.Vref.INTERNAL
    dac.channel_b.gain = 2
    dac.channel_b.raw_value = 3000
    dac.channel_c.vref = adafruit.Vref.VDD
    dac.channel_c.normalized_value = 0.5
    assert bench.board.dac.volts(1) == pytest.approx(3.0)
    assert bench.board.dac.volts(2) == pytest.approx(2.5, abs=0.002)
    dac.save_settings()
    bench.pass_time(0.06)
    bench.board.power_cycle()
    again = adafruit.MCP4728(wires)
    kept = again.channel_b
    assert (kept.raw_value, bool(kept.vref), bool(kept.gain)) == (3000, True, True), (
        "its gain is the bit, as read"
    )
    assert bench.board.dac.volts(1) == pytest.approx(3.0)


def test_adafruits_mcp23008(bench: Bench, wires: CircuitPythonBus) -> None:
    pytest.importorskip("adafruit_mcp230xx", reason=WHY)
    from adafruit_mcp230xx.mcp23008 import MCP23008

    expander = MCP23008(wires)
    enable, key = expander.get_pin(1), expander.get_pin(4)
    enable.switch_to_output(value=True)
    key.switch_to_input()
    assert bench.board.expander.pins() & 0b111 == 0b010
    assert not key.value
    bench.board.key = True
    assert key.value
    enable.value = False
    assert bench.board.expander.pins() & 0b111 == 0


def test_adafruits_ads1115(bench: Bench, wires: CircuitPythonBus) -> None:
    pytest.importorskip("adafruit_ads1x15", reason=WHY)
    from adafruit_ads1x15 import ADS1115, AnalogIn
    from adafruit_ads1x15.ads1x15 import Comp_Latch, Mode

    converter = bench.board.converter
    converter._volts = lambda pin: (0.1, 0.7, 1.3, 1.9)[pin]
    adc = ADS1115(wires, gain=2)
    inputs = [AnalogIn(adc, pin) for pin in range(4)]
    bench.board.bus._settle = lambda: (bench.pass_time(0.0005), bench.board.settle())[
        1
    ]  # it polls until done
    for expected, channel in zip((0.1, 0.7, 1.3, 1.9), inputs, strict=True):
        assert channel.voltage == pytest.approx(expected, abs=1e-4)
    assert AnalogIn(adc, 0, 1).voltage == pytest.approx(-0.6, abs=1e-4)
    assert inputs[2].voltage == pytest.approx(1.3, abs=1e-4)  # it stays on this input
    adc.comparator_high_threshold = inputs[0].convert_to_value(1.0)
    adc.comparator_low_threshold = inputs[0].convert_to_value(0.5)
    adc.comparator_latch = Comp_Latch.LATCHING
    adc.comparator_queue_length = 1
    adc.mode = Mode.CONTINUOUS
    bench.pass_time(0.02)
    assert converter.alert
    assert adc.get_last_result() == inputs[0].convert_to_value(1.3)
    converter._volts = lambda pin: 0.1
    bench.pass_time(0.02)
    adc.get_last_result()
    bench.pass_time(0.02)
    assert not converter.alert


def test_adafruits_tmp117(bench: Bench, wires: CircuitPythonBus) -> None:
    adafruit = pytest.importorskip("adafruit_tmp117", reason=WHY)
    thermometer = adafruit.TMP117(wires, 0x49)
    for celsius in (25.0, -40.5, 45.0078125):
        bench.board.celsius = celsius
        assert thermometer.temperature == celsius
    thermometer.high_limit, thermometer.low_limit = 30.0, 10.0
    bench.board.celsius = 35.0
    assert thermometer.alert_status.high_alert
    bench.board.celsius = 5.0
    thermometer._read_status()
    assert thermometer.alert_status.low_alert
    thermometer.alert_mode = adafruit.AlertMode.HYSTERESIS
    for celsius, alert in ((35.0, True), (20.0, True), (9.0, False)):
        bench.board.celsius = celsius
        assert thermometer.alert_status.high_alert is alert
    thermometer.temperature_offset = 2.0
    assert thermometer.temperature == 11.0
