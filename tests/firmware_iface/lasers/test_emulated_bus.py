"""The emulated adapter behaves, to the real smbus2, as the kernel's does; the models as their data sheets say."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

import pytest
import smbus2

from firmware_iface.virtual.i2c import attach, detach
from firmware_iface.virtual.i2c.mcp4728 import Setting
from tests.firmware_iface.lasers.boards import Bench


def test_smbus2_computes_the_same_packet_error_code_in_the_kernel_as_the_driver(bench: Bench) -> None:
    bench.bus.enable_pec()
    assert bench.bus.read_byte_data(0x36, 0x00) == 0x4C
    bench.bus.write_word_data(0x36, 0x10, 12345)
    assert bench.bus.read_word_data(0x36, 0x10) == 12345
    assert bench.board.controller.faults == 0


def test_a_packet_error_code_refuses_all_but_one_random_reply_in_256(bench: Bench) -> None:
    bench.bus.enable_pec()
    bench.board.bus.faults.arm("garbage", count=None)
    refused = 0
    for _ in range(2000):
        try:
            bench.bus.read_byte(0x36)
        except OSError as error:
            assert error.errno == errno.EBADMSG
            refused += 1
    assert 1980 <= refused < 2000


def test_every_smbus_call_is_composed_as_by_the_kernel(bench: Bench) -> None:
    with bench.recorded() as wires:
        bench.bus.write_quick(0x20)
        bench.bus.write_byte(0x20, 0x09)
        bench.bus.read_byte(0x20)
        bench.bus.write_i2c_block_data(0x20, 0x00, [0xF0, 0x01])
        assert bench.bus.read_i2c_block_data(0x20, 0x00, 3) == [0xF0, 0x01, 0x00]
        assert bench.bus.read_word_data(0x20, 0x00) == 0x01F0
        bench.bus.process_call(0x20, 0x03, 0x0201)
        bench.bus.write_block_data(0x20, 0x03, [5])
    assert wires == [
        "20 W",
        "20 W 09",
        "20 R 40",  # the pin of the silent ALERT is high
        "20 W 00 f0 01",
        "20 W 00", "20 R f0 01 00",
        "20 W 00", "20 R f0 01",
        "20 W 03 01 02", "20 R 00 00",
        "20 W 03 01 05",
    ]  # fmt: skip
    with pytest.raises(OSError) as raised:
        bench.bus.read_block_data(0x20, 0x00)
    assert raised.value.errno == errno.EOPNOTSUPP


@pytest.mark.parametrize(
    ("kind", "number"),
    [
        ("nack", errno.ENXIO),
        ("unplug", errno.ENXIO),
        ("timeout", errno.ETIMEDOUT),
        ("stall", errno.EAGAIN),
        ("short_write", errno.EREMOTEIO),
    ],
)
def test_faults_are_the_errors_that_adapters_give(bench: Bench, kind: str, number: int) -> None:
    bench.board.bus.faults.arm(kind)
    with pytest.raises(OSError) as raised:
        bench.bus.write_byte_data(0x20, 0x0A, 1)
    assert raised.value.errno == number
    bench.board.bus.faults.clear()
    bench.bus.write_byte_data(0x20, 0x0A, 1)


def test_what_is_late_comes_late_and_what_hangs_ends_in_a_timeout(bench: Bench) -> None:
    began = bench.now
    bench.board.bus.faults.arm("late")
    assert bench.bus.read_byte_data(0x20, 0) == 0xFF
    assert bench.now - began == pytest.approx(0.25)
    bench.board.bus.faults.arm("hang", count=None)
    bench.board.bus.sleep = lambda seconds: bench.board.bus.faults.clear()
    with pytest.raises(TimeoutError):
        bench.bus.read_byte_data(0x20, 0)


def test_an_absent_address_is_not_acknowledged(bench: Bench) -> None:
    with pytest.raises(OSError) as raised:
        bench.bus.read_byte_data(0x55, 0)
    assert raised.value.errno == errno.ENXIO


def test_other_files_still_reach_the_real_ioctl(bench: Bench) -> None:
    with pytest.raises(OSError) as raised:
        smbus2.SMBus("/dev/null")
    assert raised.value.errno == errno.ENOTTY


def test_a_removed_node_answers_nothing(bench: Bench) -> None:
    node = attach(bench.board.bus)
    with smbus2.SMBus(node) as bus:
        detach(node)
        assert not os.path.exists(node)
        with pytest.raises(OSError) as raised:
            bus.read_byte_data(0x20, 0)
        assert raised.value.errno == errno.ENODEV


def test_a_node_leaves_no_file_behind_a_process_that_is_killed(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    node = attach(bench.board.bus)
    with smbus2.SMBus(node) as bus:
        assert bus.read_byte_data(0x20, 0) == bench.bus.read_byte_data(0x20, 0)
    assert list(tmp_path.iterdir()) == []  # which is all that a killed process leaves
    detach(node)


def write(bench: Bench, address: int, *data: int) -> None:
    bench.bus.i2c_rdwr(smbus2.i2c_msg.write(address, data))


def word(bench: Bench, register: int) -> int:
    return int.from_bytes(bytes(bench.bus.read_i2c_block_data(0x48, register, 2)), "big")


def test_the_dac_ignores_commands_while_it_writes_its_eeprom_and_wakes_up_as_that_says(bench: Bench) -> None:
    dac = bench.board.dac
    write(bench, 0x60, 0x5A, 0x88, 0x00)  # single write: B, internal reference, code 0x800, kept
    write(bench, 0x60, 0x40, 0x8F, 0xFF)
    assert dac.volts(0) == 0, "busy for 50 ms"
    bench.pass_time(0.051)
    write(bench, 0x60, 0x40, 0x9F, 0xFF)
    assert dac.volts(0) == pytest.approx(4.095)
    bench.board.power_cycle()
    assert (dac.volts(0), dac.volts(1)) == (0, pytest.approx(1.024))
    assert dac.eeprom[1] == Setting(internal=True, code=0x800)


def test_the_dacs_other_commands(bench: Bench) -> None:
    dac = bench.board.dac
    write(bench, 0x60, 0x08, 0x00, 0x08, 0x00)  # fast write: A and B to half, which powers them
    assert dac.volts(0) == pytest.approx(1.024)
    write(bench, 0x60, 0xC8)  # gain of two for A
    write(bench, 0x60, 0x87)  # supply as A's reference
    assert (dac.volts(0), dac.volts(1)) == (2.5, pytest.approx(1.024))
    write(bench, 0x60, 0xA8, 0x00)  # A to 100 kΩ
    assert dac.volts(0) == 0
    write(bench, 0x00, 0x09)  # general call: wake up
    assert dac.volts(0) == 2.5
    write(bench, 0x00, 0x06)  # general call: reset
    assert dac.volts(0) == 0


def test_the_comparator_latches_until_the_conversion_is_read(bench: Bench) -> None:
    lasers = bench.armed()
    converter = bench.board.converter
    lasers.board.converter.trip_above(0.1)
    lasers.board.converter.select(0)
    lasers.board.dac.set_code(0, 3000)
    bench.pass_time(0.05)
    assert converter.alert and bench.light_uw == 0, "the safety controller followed ALERT"
    bench.pass_time(0.01)
    assert converter.alert, "latched, though it is dark"
    lasers.board.converter.volts()
    bench.pass_time(0.01)
    assert not converter.alert


def test_the_comparator_counts_and_releases_as_configured(bench: Bench) -> None:
    converter = bench.board.converter
    volts = [1.0]
    converter._volts = lambda pin: volts[0] if pin == 1 else 0.25
    write(bench, 0x48, 3, 0x20, 0x00)
    write(bench, 0x48, 2, 0x10, 0x00)
    write(bench, 0x48, 1, 0x54, 0xE2)  # input 1, ±2.048 V, continuous, 860 a second, not latching, after four
    bench.pass_time(3.5 / 860)
    assert not converter.alert
    bench.pass_time(1.5 / 860)
    assert converter.alert
    volts[0] = 0.4  # between the thresholds
    bench.pass_time(0.01)
    assert converter.alert
    volts[0] = 0.1
    bench.pass_time(0.01)
    assert not converter.alert


def test_single_shots_and_differences_and_clipping(bench: Bench) -> None:
    converter = bench.board.converter
    converter._volts = lambda pin: (0.5, 0.2, 0.0, 3.0)[pin]
    write(bench, 0x48, 1, 0x85, 0x83)  # AIN0 - AIN1, ±2.048 V, one conversion at 128 a second
    assert word(bench, 1) >> 15 == 0, "busy"
    bench.pass_time(0.01)
    assert word(bench, 1) >> 15 == 1
    assert word(bench, 0) == round(0.3 / 2.048 * 32768)
    write(bench, 0x48, 1, 0xF5, 0x83)  # AIN3, beyond the range
    bench.pass_time(0.01)
    assert word(bench, 0) == 0x7FFF


def test_the_thermometer_holds_its_alert_between_the_limits(bench: Bench) -> None:
    lasers = bench.open()
    lasers.board.thermometer.limit(45, 40)
    for celsius, alert in ((44, False), (46, True), (42, True), (39, False), (42, False)):
        bench.board.celsius = celsius
        assert bench.board.thermometer.alert is alert, celsius
