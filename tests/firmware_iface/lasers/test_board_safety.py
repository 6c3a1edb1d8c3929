"""What the board switches off by itself: its dead-man, key and interlock, ceilings, comparator, heat and power-on."""

from __future__ import annotations

from dataclasses import replace

import pytest

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers
from firmware_iface.lasers.store_dark import main as store_dark
from firmware_iface.virtual.i2c.mcp4728 import Setting
from tests.firmware_iface.lasers.boards import Bench

RED = VIRTUAL_CHANNELS[0]


@pytest.mark.parametrize("silent_s", [0.0995, 0.1005])
def test_the_dead_man(bench: Bench, silent_s: float) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    lasers.heartbeat()
    bench.pass_time(silent_s)
    if silent_s < 0.1:
        assert bench.light_uw > 0
        lasers.heartbeat()
        return
    assert bench.light_uw == 0
    assert bench.seen[-1][0] - (bench.now - silent_s) <= 0.1011
    with pytest.raises(DeviceError, match="heartbeat"):
        lasers.heartbeat()
    bench.pass_time(1)
    assert bench.light_uw == 0, "latched"


def test_the_same_token_again_is_no_heartbeat(bench: Bench) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    bench.pass_time(0.02)
    lasers.board.controller.beat(lasers._heartbeat.token)
    assert bench.light_uw == 0
    with pytest.raises(DeviceError, match="heartbeat"):
        lasers.heartbeat()


def test_a_token_too_soon_is_a_loop_run_wild(bench: Bench) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    bench.pass_time(0.02)
    lasers.heartbeat()
    bench.pass_time(0.003)
    lasers.heartbeat()  # the driver itself never does it
    assert bench.light_uw > 0
    lasers.board.controller.beat(lasers._heartbeat.token + 1)
    assert bench.light_uw == 0


@pytest.mark.parametrize("condition", ["key", "interlock"])
def test_key_and_interlock_latch_and_it_takes_two_acts_to_see_light_again(
    bench: Bench, condition: str
) -> None:
    lasers = bench.armed()
    lasers.board.controller.command(0)  # type: ignore[arg-type]
    with pytest.raises(DeviceError, match="not armed"):
        lasers.set_power("green", 1.0)
    lasers.arm()  # asking too early is no fault
    lasers.set_power("green", 1.0)
    setattr(bench.board, condition, False)
    assert bench.light_uw == 0
    setattr(bench.board, condition, True)
    with pytest.raises(DeviceError, match=f"switched the lasers off: {condition}[.]"):
        lasers.heartbeat()
    with pytest.raises(DeviceError, match=condition):
        lasers.set_power("green", 1.0)
    with pytest.raises(DeviceError, match=rf"latched \({condition}\); find its cause, then clear\(\)"):
        lasers.arm()
    assert bench.light_uw == 0
    lasers.clear()
    with pytest.raises(DeviceError, match="not armed"):
        lasers.set_power("green", 1.0)
    lasers.clear()
    lasers.arm()
    assert bench.light_uw == 0, "armed is dark"
    lasers.set_power("green", 1.0)
    assert bench.light_uw > 0


def test_what_is_missing_is_said(bench: Bench) -> None:
    lasers = bench.open()
    with pytest.raises(DeviceError, match="turn the key on; close the interlock"):
        lasers.arm()
    bench.ready()
    bench.board.celsius = 50
    with pytest.raises(DeviceError, match="cool down"):
        lasers.arm()
    bench.board.celsius = 30
    lasers.arm()
    lasers.trip()
    bench.board.interlock = False  # another matter than the fault, and both are said
    with pytest.raises(
        DeviceError, match=r"latched \(.*host\); find its cause; close the interlock; then clear"
    ):
        lasers.arm()
    with pytest.raises(DeviceError, match="cannot be cleared: close the interlock"):
        lasers.clear()


def test_the_second_arming_word_counts_only_right_after_the_first(bench: Bench) -> None:
    from firmware_iface.lasers.safety_controller import Command, State

    bench.ready()
    controller = (lasers := bench.open()).board.controller
    for between in (lambda: controller.command(Command.OFF), lambda: bench.pass_time(1.001)):
        lasers.heartbeat()
        controller.command(Command.ARM_FIRST)
        between()
        lasers.heartbeat()
        controller.command(Command.ARM_SECOND)
        assert controller.state() is State.OFF
    controller.command(Command.ARM_SECOND)
    assert controller.state() is State.OFF


def test_heat_switches_off(bench: Bench) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    bench.board.celsius = 45.5
    assert bench.light_uw == 0
    with pytest.raises(DeviceError, match="temperature"):
        lasers.heartbeat()


def test_a_knob_turned_up_trips_on_the_photodiode_within_a_tick(bench: Bench) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    began = bench.now
    bench.board.diodes[1].offset_ma = 10.0
    bench.pass_time(0.002)
    assert bench.light_uw == 0 and bench.seen[-1][0] - began <= 0.001 + 1e-9
    with pytest.raises(DeviceError, match="overpower_1"):
        lasers.heartbeat()


def test_the_converters_comparator_trips_too_when_the_controllers_own_ceilings_are_wide(bench: Bench) -> None:
    bench.board.controller.built_for = ((15000, 60000, 9000),) * 3
    bench.ready()
    lasers = bench.open()
    lasers.arm()
    lasers.set_power("red", 1.0)
    for pair in bench.board.controller.ceilings:
        pair[1] = 60000
    bench.board.diodes[0].efficiency = 1.5
    for _ in range(4):  # the converter looks at one photodiode after the other
        bench.pass_time(0.025)
        if bench.light_uw == 0:
            break
        lasers.heartbeat()
    with pytest.raises(DeviceError, match="alert"):
        lasers.heartbeat()


@pytest.mark.parametrize("change", [{"efficiency": 0.7}, {"efficiency": 1.15, "offset_ma": 3.0}])
def test_a_laser_that_drifts_from_its_calibration_is_switched_off(
    bench: Bench, change: dict[str, float]
) -> None:
    lasers = bench.armed()
    lasers.set_power("red", 0.3)
    for name, value in change.items():
        setattr(bench.board.diodes[0], name, value)
    with pytest.raises(DeviceError, match="photodiode"):
        for _ in range(4):
            bench.pass_time(0.025)
            lasers.heartbeat()
    assert bench.light_uw == 0


def test_a_ramp_stops_where_the_photodiode_does_not_follow(bench: Bench) -> None:
    lasers = bench.armed()
    bench.board.break_photodiode(0)
    bench.seen.clear()
    with pytest.raises(DeviceError, match="laser 'red' should make .* V at its photodiode and makes 0.000 V"):
        lasers.set_power("red", 1.0)
    assert bench.light_uw == 0
    assert max(p["red"] for _, p in bench.seen) < 0.1 * 120, "stopped early"


def test_the_ceilings_can_be_written_once_and_only_lowered_from_what_the_board_was_built_for(
    bench: Bench,
) -> None:
    bench.ready()
    with pytest.raises(InputError, match="built for 1.5000 V"):
        Lasers(bench.bus, (replace(RED, full_power_uw=121.0),), lambda: bench.now, bench.pass_time)
    lasers = Lasers(bench.bus, (replace(RED, full_power_uw=60.0),), lambda: bench.now, bench.pass_time)
    for drive_v in (1.0, 1.5):
        with pytest.raises(OSError, match="Remote I/O"):
            lasers.board.controller.set_ceilings(0, drive_v, 1.2)
    assert lasers.board.controller.ceilings_v(0)[0] == pytest.approx(1.2)
    with pytest.raises(DeviceError, match="config"):
        lasers.heartbeat()
    with pytest.raises(DeviceError, match=r"holds ceilings of 1\.2000 .* switch the board off and on"):
        bench.open()
    bench.board.power_cycle()
    bench.open()


def test_lasers_that_are_not_there_get_a_ceiling_of_0(bench: Bench) -> None:
    bench.ready()
    lasers = Lasers(bench.bus, (RED,), lambda: bench.now, bench.pass_time)
    lasers.arm()
    lasers.board.expander.enable(0b111)
    lasers.board.dac.set_code(2, 1800)
    bench.pass_time(0.08)
    assert bench.light_uw == 0


def test_an_eeprom_that_would_light_lasers_is_refused_and_can_be_written_dark(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.board.dac.eeprom = [Setting(True, 0, False, 0), Setting(True, 0, False, 2000)] * 2
    with pytest.raises(DeviceError, match="store_dark"):
        bench.open()
    assert store_dark([]) == 2 and store_dark(["/nowhere"]) == 2
    bench.board.dac._clock = iter(range(1000, 2000)).__next__  # the command waits in real time
    assert store_dark([bench.node]) == 0
    assert capsys.readouterr().out == "the DAC is dark at power-on\n"
    bench.board.dac._clock = lambda: bench.now + 3000
    bench.open()
    bench.board.power_cycle()
    assert [bench.board.dac.volts(k) for k in range(4)] == [0] * 4


def test_power_on_is_dark_even_with_a_bright_eeprom_and_everything_closed(bench: Bench) -> None:
    bench.armed().set_power("red", 1.0)
    bench.board.dac.eeprom = [Setting(True, 0, False, 3000)] * 4
    bench.board.power_cycle()
    bench.pass_time(1)
    assert bench.light_uw == 0
