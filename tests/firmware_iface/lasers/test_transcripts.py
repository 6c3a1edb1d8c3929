"""What each driver puts on the wires, byte by byte, as the parts' data sheets (and our own page) have it."""

from __future__ import annotations

import pytest

from firmware_iface.lasers.ads1115 import Ads1115
from firmware_iface.lasers.mcp4728 import Mcp4728, Output
from firmware_iface.lasers.mcp23008 import Mcp23008
from firmware_iface.lasers.safety_controller import (
    Command,
    Fault,
    Input,
    SafetyController,
    State,
    packet_error_code,
)
from firmware_iface.lasers.tmp117 import Tmp117
from tests.firmware_iface.lasers.boards import Bench


def test_the_dac(bench: Bench) -> None:
    dac = Mcp4728(bench.bus)
    with bench.recorded() as wires:
        dac.set_code(2, 0xABC)
        now, at_power_on = dac.read()
        dac.dark()
        dac.store_dark()
    assert wires == [
        "60 W 44 8a bc",  # multi-write to C; internal reference, on, gain 1
        "60 R c0 a0 00 c0 a0 00 d0 a0 00 d0 a0 00 e0 8a bc e0 a0 00 f0 a0 00 f0 a0 00",
        "60 W 00 00 00 00 00 00 00 00",  # fast write
        "60 W 50 e0 00 e0 00 e0 00 e0 00",  # sequential write from A, off
    ]
    assert now[2] == Output(code=0xABC, powered=True, fine=True)
    assert at_power_on[2].dark and now[0].dark
    assert bench.board.dac.volts(2) == 0


def test_the_dacs_codes_are_volts(bench: Bench) -> None:
    Mcp4728(bench.bus).set_code(1, 3000)
    assert bench.board.dac.volts(1) == pytest.approx(1.5)


def test_the_expander(bench: Bench) -> None:
    expander = Mcp23008(bench.bus)
    bench.board.key = True
    with bench.recorded() as wires:
        expander.enable(0b101)
    assert wires == ["20 W 0a 05", "20 W 00 f8"]  # levels before directions: no glitch
    assert bench.board.expander.pins() == 0b0101_0101


def test_the_converter(bench: Bench) -> None:
    converter = Ads1115(bench.bus)
    with bench.recorded() as wires:
        converter.trip_above(1.2)
        converter.select(2)
        bench.pass_time(0.002)
        volts = converter.volts()
    assert wires == ["48 W 03 4b 00", "48 W 02 00 00", "48 W 01 64 e4", "48 W 00", "48 R 00 00"]
    assert volts == 0


def test_the_thermometer(bench: Bench) -> None:
    thermometer = Tmp117(bench.bus)
    bench.board.celsius = -40.5
    with bench.recorded() as wires:
        identity, celsius = thermometer.identity(), thermometer.celsius()
        thermometer.limit(45, -1)
    assert wires == [
        "49 W 0f",
        "49 R 01 17",
        "49 W 00",
        "49 R eb c0",
        "49 W 02 16 80",
        "49 W 03 ff 80",
        "49 W 01 02 30",
    ]
    assert (identity, celsius) == (0x117, -40.5)


def test_the_safety_controller(bench: Bench) -> None:
    controller = SafetyController(bench.bus)
    with bench.recorded() as wires:
        controller.check_identity()
        controller.set_ceilings(1, 1.3, 1.2)
        assert controller.ceilings_v(1) == pytest.approx((1.3, 1.2))
        controller.beat(7)
        controller.command(Command.ARM_FIRST)
        controller.command(Command.FAULT)
        assert (controller.state(), controller.faults()) == (State.FAULT, Fault.HOST)
        assert controller.inputs() == Input.HEARTBEAT | Input.DARK | Input.COOL | Input.QUIET
    assert wires == [
        "36 W 00", "36 R 4c 42",
        "36 W 01", "36 R 01 cd",
        "36 W 11 c8 32 af",
        "36 W 19 e0 2e ac",
        "36 W 11", "36 R c8 32 c4",
        "36 W 19", "36 R e0 2e 26",
        "36 W 06 07 54",
        "36 W 05 a5 0c",
        "36 W 05 f0 a0",
        "36 W 02", "36 R 03 7e",
        "36 W 03", "36 R 00 04 48",
        "36 W 04", "36 R 3c be",
    ]  # fmt: skip


def test_the_packet_error_code_is_crc_8() -> None:
    assert packet_error_code(b"123456789") == 0xF4  # the check value that catalogues of CRCs give
