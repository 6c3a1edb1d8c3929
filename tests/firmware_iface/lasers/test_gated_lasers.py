"""Lasers that a panel gates to fields: light in their own field alone, the budget's sum, photodiodes that hold."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import smbus2

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, LaserChannel, Lasers
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.recent_codes import RecentCodes

from .boards import Bench

FIELD_S, LIGHT_S = 0.005, 0.003
IN_TURN = GatedLight(duty=0.2, pulse_s=LIGHT_S, frame_s=3 * FIELD_S)


class GatedBench(Bench):
    """A board whose lasers a panel gates in turn, from 1 ms to 4 ms of each field of 5 ms."""

    def __init__(self) -> None:
        super().__init__()
        self.order = (0, 1, 2)  # the laser of each field; 3: none
        self.board.gates = self.gates

    def gates(self) -> int:
        field, into_s = divmod((self.now + 1e-6) % (3 * FIELD_S), FIELD_S)
        return 1 << self.order[int(field)] if 0.001 <= into_s < 0.001 + LIGHT_S else 0

    def open_gated(self, channels: tuple[LaserChannel, ...] = VIRTUAL_CHANNELS) -> Lasers:
        return Lasers(smbus2.SMBus(self.node), channels, lambda: self.now, self.pass_time, IN_TURN)

    def beat(self, lasers: Lasers, seconds: float, unlit: tuple[str, ...] = ()) -> None:
        end = self.now + seconds
        while self.now < end:
            lasers.heartbeat(unlit)
            self.pass_time(0.020)


@pytest.fixture
def bench() -> Iterator[GatedBench]:
    bench = GatedBench()
    bench.ready()
    yield bench
    bench.close()


def test_each_laser_shines_in_its_own_field_alone(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    for channel in lasers.channels:
        lasers.set_power(channel, 1.0)
    bench.seen.clear()
    bench.beat(lasers, 1.0)
    lit = [{name for name, power in light.items() if power} for _, light in bench.seen]
    assert {frozenset(names) for names in lit} == {
        frozenset(), frozenset({"red"}), frozenset({"green"}), frozenset({"blue"})
    }  # fmt: skip
    assert len(bench.seen) == pytest.approx(2 * 1.0 / FIELD_S, rel=0.05)
    powers = {name: max(light[name] for _, light in bench.seen) for name in lasers.channels}
    assert powers == pytest.approx({"red": 120, "green": 100, "blue": 15}, rel=0.01)
    lasers.close()
    assert bench.light_uw == 0


def test_powers_change_without_a_fault_though_photodiodes_lag_by_a_frame(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    for fraction in (0.3, 1.0, 0.2, 0.9, 0.0, 0.5):
        for channel in lasers.channels:
            lasers.set_power(channel, fraction)
            bench.beat(lasers, 0.06)
    lasers.off()
    bench.beat(lasers, 0.3)
    assert lasers.status()["state"] == "armed"


def test_a_laser_that_is_too_bright_in_its_field_trips_within_a_frame(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    lasers.set_power("green", 1.0)
    bench.board.diodes[1].efficiency = 3.0
    began = bench.now
    with pytest.raises(DeviceError):
        bench.beat(lasers, 0.5)
    lit = [at for at, light in bench.seen if light["green"]]
    assert lit[-1] - began < 3 * FIELD_S + 0.002
    assert bench.light_uw == 0 and not bench.board.controller.armed


def test_a_photodiode_that_is_cut_is_missed(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    lasers.set_power("red", 1.0)
    bench.board.break_photodiode(0)
    with pytest.raises(DeviceError, match="photodiode"):
        bench.beat(lasers, 0.5)


def test_a_colour_that_the_picture_has_not_is_dark_and_no_fault(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    for channel in lasers.channels:
        lasers.set_power(channel, 1.0)
    bench.order = (0, 3, 2)
    bench.pass_time(2 * FIELD_S)
    bench.seen.clear()
    bench.beat(lasers, 0.5, unlit=("green",))
    assert not any(light["green"] for _, light in bench.seen)
    lasers.expect({c: [0.001] * 13 for c in lasers.channels})
    bench.order = (0, 1, 2)
    bench.beat(lasers, 0.5)
    assert lasers.status()["state"] == "emit"


def test_all_gates_closed_and_the_lasers_switched_off_is_no_fault(bench: GatedBench) -> None:
    lasers = bench.open_gated()
    lasers.arm()
    lasers.set_power("red", 1.0)
    bench.order = (3, 3, 3)
    bench.pass_time(0.02)
    assert bench.light_uw == 0
    lasers.off()
    bench.beat(lasers, 0.3)


def test_the_budget_is_the_sum_over_the_fields(bench: GatedBench) -> None:
    """Blue at 60 uW is 1.5 of the photochemical limit when it shines all the time, and 0.3 for a fifth of it."""
    bright = (*VIRTUAL_CHANNELS[:2], LaserChannel("blue", 450.0, 60.0, 30.0, 4.0))
    always = Lasers(smbus2.SMBus(bench.node), bright, lambda: bench.now, bench.pass_time)
    always.arm()
    with pytest.raises(InputError, match="Class 1"):
        always.set_power("blue", 1.0)
    always.close()
    bench.pass_time(0.02)
    lasers = bench.open_gated(bright)
    lasers.arm()
    for channel in lasers.channels:
        lasers.set_power(channel, 1.0)
        bench.beat(lasers, 0.04)
    used = lasers.status()
    photochemical = 0.2 * (60 / 39 + 100 / 979.6)
    assert used["class1"]["photochemical"] == pytest.approx(photochemical, rel=1e-3)
    assert used["class1"]["thermal"] == pytest.approx(0.2 * 280 / 390, rel=1e-3)
    assert used["class1_at_full_power"] == pytest.approx(5 * photochemical, rel=1e-3), "as if no gate closed"


def test_the_codes_that_a_photodiode_may_hold() -> None:
    codes = RecentCodes(2, held_s=0.010)
    for k in range(5):
        codes.put(1, 10 * k, 0.004 * k)
    assert codes.now == [0, 40]
    assert codes.bounds(1, 0.016) == (10, 40)  # 20 until 12 ms, 10 until 8 ms; 0 until 4 ms is too old
    assert codes.bounds(1, 0.030) == (40, 40) and codes.bounds(0, 0.016) == (0, 0)
    present = RecentCodes(1, held_s=0.0)
    present.put(0, 7, 0.0)
    assert present.bounds(0, 0.0) == (7, 7)
