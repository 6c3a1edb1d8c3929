"""The lasers over the emulated board: what is emitted, when, and that whatever goes wrong ends dark."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import smbus2

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers import VIRTUAL_CHANNELS, Lasers, open_lasers
from firmware_iface.lasers.eye_safety import spot_shares
from firmware_iface.virtual.i2c import attach
from tests.firmware_iface.lasers.boards import Bench

RED = VIRTUAL_CHANNELS[0]


def test_power_is_what_was_asked_to_a_step_of_the_dac_and_never_more(bench: Bench) -> None:
    lasers = bench.armed()
    for channel in VIRTUAL_CHANNELS:
        for fraction in (0.1, 0.5, np.float64(1.0)):
            lasers.set_power(channel.name, fraction)
            asked, made = fraction * channel.full_power_uw, bench.board.emitted_uw[channel.name]
            assert asked - 0.025 * channel.slope_uw_per_ma <= made <= asked + 1e-9
            assert lasers.power(channel.name) == fraction
    lasers.off()
    assert bench.light_uw == 0 and lasers.power("red") == 0
    lasers.set_power("blue", 0.2)
    assert bench.light_uw == pytest.approx(3, rel=0.01)


def test_light_rises_over_at_least_50_ms_and_falls_at_once(bench: Bench) -> None:
    lasers = bench.armed()
    bench.seen.clear()
    began = bench.now
    lasers.set_power("red", 1.0)
    assert bench.now - began >= 0.050
    powers = [(t, p["red"]) for t, p in bench.seen]
    for (t1, p1), (t2, p2) in pairwise(powers):
        assert p1 <= p2 <= p1 + 120 * (t2 - t1 + 0.001) / 0.050 + 1e-9
    began = bench.now
    lasers.set_power("red", 0.3)
    assert bench.now == began and bench.light_uw == pytest.approx(36, abs=0.1)


def test_the_controllers_limiter_ramps_even_for_a_host_that_jumps(bench: Bench) -> None:
    lasers = bench.armed()
    bench.seen.clear()
    began = bench.now
    lasers.board.dac.set_code(0, 3000)
    bench.pass_time(0.080)
    full = next(t for t, p in bench.seen if p["red"] == pytest.approx(120))
    assert 0.049 <= full - began <= 0.052


def test_no_code_of_the_dac_passes_the_ceiling(bench: Bench) -> None:
    lasers = bench.armed()
    bench.seen.clear()
    for vref in (0x00, 0x80, 0x90):
        for k in range(3):
            bench.bus.i2c_rdwr(smbus2.i2c_msg.write(0x60, [0x40 | k << 1, vref | 0x0F, 0xFF]))
        for _ in range(4):
            bench.pass_time(0.03)
            lasers.board.controller.beat(lasers._heartbeat.token + 1)
            lasers._heartbeat.token += 1
    for channel in VIRTUAL_CHANNELS:
        assert max(p[channel.name] for _, p in bench.seen) == pytest.approx(channel.full_power_uw)


@pytest.mark.parametrize(
    "kind", ["nack", "timeout", "stall", "short_write", "garbage", "unplug", "late", "hang"]
)
@pytest.mark.parametrize("after", range(0, 12))
def test_any_fault_of_the_bus_ends_dark_within_150_ms_and_is_reported(
    bench: Bench, kind: str, after: int
) -> None:
    """While showing, wherever in the traffic it strikes: four heartbeats' transfers and a change of power."""
    lasers = bench.armed()
    lasers.set_power("green", 0.5)
    lasers.set_power("red", 0.5)
    faults, take = bench.board.bus.faults, bench.board.bus.faults.take
    struck_at: list[float] = []
    reported = False

    def watched(*kinds: str) -> str | None:
        hit = take(*kinds)
        if hit:
            struck_at.append(bench.now)
        return hit

    faults.take = watched  # type: ignore[method-assign]
    if kind == "hang":
        began = bench.now
        bench.board.bus.sleep = lambda s: (bench.pass_time(s), bench.now - began > 0.4 and faults.clear())
    faults.arm(kind, count=None if kind in ("hang", "unplug") else 1, after=after)
    try:
        for _ in range(4):
            bench.pass_time(0.025)
            lasers.heartbeat()
        lasers.set_power("red", 0.6)
    except DeviceError:
        reported = True
    assert struck_at
    assert reported or kind in ("garbage", "late"), (
        "garbage in a write, or lateness within the window, harms nothing"
    )
    assert (bench.light_uw == 0) == reported
    if reported:
        assert lasers.power("red") == 0
        assert bench.seen[-1][0] - struck_at[0] <= 0.150


def test_a_reply_of_garbage_is_never_believed(bench: Bench) -> None:
    """Over many random replies to heartbeats: it is reported and dark, or the reply did not matter."""
    reported = 0
    for _ in range(60):
        lasers = bench.armed()
        lasers.set_power("green", 0.5)
        bench.board.bus.faults.arm("garbage", count=None)
        try:
            for _ in range(3):
                bench.pass_time(0.025)
                lasers.heartbeat()
        except DeviceError:
            reported += 1
            assert bench.light_uw == 0
        bench.board.bus.faults.clear()
        lasers.close()
        bench.board.power_cycle()
    assert reported >= 59, "one in 256 passes the packet error code"


def bright(bench: Bench) -> Lasers:
    """Armed red and green lasers of 300 µW each: together more than a Class 1 point source."""
    bench.board.controller.built_for = ((40000, 40000, 9000),) * 3
    for diode in bench.board.diodes:
        diode.photodiode_v_per_uw, diode.slope_uw_per_ma = 1 / 300, 20.0
    channels = [replace(c, slope_uw_per_ma=20.0, full_power_uw=300.0) for c in VIRTUAL_CHANNELS[:2]]
    bench.ready()
    lasers = Lasers(bench.bus, channels, lambda: bench.now, bench.pass_time)
    lasers.arm()
    return lasers


@pytest.mark.parametrize("act", ["off", "trip", "expect", "heartbeat that fails"])
def test_what_lowers_the_light_in_the_middle_of_a_ramp_is_not_undone_by_its_next_steps(
    bench: Bench, act: str
) -> None:
    lasers = bright(bench)
    flat = spot_shares(np.ones((100, 100)), 1.0)
    lasers.expect({"red": flat, "green": flat})
    lasers.set_power("red", 1.0)
    ramp = lasers.ramp("green", 1.0)
    for _ in range(12):
        next(ramp)
        bench.pass_time(0.005)
    if act == "expect":
        assert lasers.expect(None) == pytest.approx(0.65)
    elif act == "heartbeat that fails":
        bench.board.bus.faults.arm("nack")
        with pytest.raises(DeviceError):
            lasers.heartbeat()
    else:
        getattr(lasers, act)()
    most = 390 if act == "expect" else 0
    for _ in ramp:
        bench.pass_time(0.005)
        assert bench.light_uw <= most
    assert bench.light_uw == pytest.approx(most, rel=0.01)


def test_the_budget_is_kept_across_channels_and_by_prediction(bench: Bench) -> None:
    lasers = bright(bench)
    lasers.set_power("red", 1.0)
    with pytest.raises(InputError, match="1.54 of the Class 1 limit"):
        lasers.set_power("green", 1.0)
    assert bench.light_uw == pytest.approx(300, rel=0.01), "a refusal changes nothing"
    flat = spot_shares(np.ones((100, 100)), 1.0)
    assert lasers.expect({"red": flat, "green": flat}) == 1
    lasers.set_power("green", 1.0)
    assert bench.light_uw == pytest.approx(600, rel=0.01)
    factor = lasers.expect(None)  # the next pattern may be one spot
    assert factor == pytest.approx(390 / 600)
    assert bench.light_uw <= 390
    status = lasers.status()
    assert status["class1"]["worst"] == pytest.approx(1)
    lasers.expect({"red": flat, "green": flat})
    assert lasers.status()["class1_at_full_power"] == pytest.approx(600 / 390), "whatever is predicted"


@pytest.mark.parametrize(
    "shares", [{"red": (1.0,)}, {"red": (2.0,) * 13}, {"pink": (1.0,) * 13}, {"red": (0.0,) * 13}]
)
def test_a_prediction_that_is_none_is_refused(bench: Bench, shares: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(InputError):
        bench.armed().expect(shares)


@pytest.mark.parametrize("fraction", [-0.1, 1.1, float("nan"), "1", True, None])
def test_a_power_that_is_no_fraction_is_refused(bench: Bench, fraction: object) -> None:
    lasers = bench.armed()
    with pytest.raises(InputError, match="give 0 to 1"):
        lasers.set_power("red", fraction)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="there is no laser 'pink'"):
        lasers.set_power("pink", 0.5)


def test_an_exception_and_a_close_end_dark_and_disarmed(bench: Bench) -> None:
    with pytest.raises(ZeroDivisionError), bench.armed() as lasers:
        lasers.set_power("green", 1.0)
        assert bench.light_uw > 0
        1 / 0  # noqa: B018
    assert bench.light_uw == 0 and not bench.board.controller.armed
    lasers.close()
    with pytest.raises(DeviceError, match="closed"):
        lasers.heartbeat()


@pytest.mark.parametrize("after", [0, 1])
def test_an_off_that_noise_garbles_is_noticed(bench: Bench, after: int) -> None:
    """The DAC has no packet error code, so it is read back."""
    lasers = bench.armed()
    lasers.set_power("green", 1.0)
    bench.board.bus.faults.arm("garbage", after=after)
    with pytest.raises(DeviceError, match="DAC"):
        lasers.off()
    assert bench.light_uw == 0 and not bench.board.controller.armed


def test_clearing_while_it_emits_is_an_off_that_the_photodiodes_agree_with(bench: Bench) -> None:
    lasers = bench.armed()
    lasers.set_power("red", 1.0)
    lasers.clear()
    assert bench.light_uw == 0 and lasers.power("red") == 0
    for _ in range(4):
        bench.pass_time(0.025)
        lasers.heartbeat()


def test_every_part_is_switched_off_also_where_others_fail(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    lasers = bench.armed()
    lasers.set_power("green", 1.0)

    def fails(*given: object) -> None:
        raise TypeError("not even an error of the bus")

    monkeypatch.setattr(lasers.board.controller, "command", fails)
    monkeypatch.setattr(lasers.board.dac, "dark", fails)
    lasers.trip()
    assert bench.light_uw == 0 and bench.board.expander.pins() & 0b111 == 0


def test_an_interruption_between_the_steps_of_a_ramp_is_not_swallowed(bench: Bench) -> None:
    lasers = bench.armed()
    steps = 0

    def interrupted(seconds: float) -> None:
        nonlocal steps
        steps += 1
        bench.pass_time(seconds)
        if steps == 5:
            raise KeyboardInterrupt

    lasers._wait = interrupted
    with pytest.raises(KeyboardInterrupt), lasers:
        lasers.set_power("green", 1.0)
    assert bench.light_uw == 0


def test_a_channel_must_be_possible() -> None:
    for wrong in (
        {"wavelength_nm": 800.0},
        {"full_power_uw": 0.0},
        {"full_power_uw": 900.0},
        {"threshold_ma": -1.0},
    ):
        with pytest.raises(InputError, match="'red'"):
            replace(RED, **wrong)
    with pytest.raises(InputError, match="one to three"):
        Lasers(smbus2.SMBus(), [])
    with pytest.raises(InputError, match="names of their own"):
        Lasers(smbus2.SMBus(), [RED, RED])


def test_a_bus_that_is_not_there_is_said() -> None:
    with pytest.raises(InputError, match="/dev/i2c-99 cannot be opened"):
        open_lasers("/dev/i2c-99", VIRTUAL_CHANNELS)


def test_another_part_at_an_address_is_said(bench: Bench) -> None:
    bench.board.thermometer._registers[0xF] = 0x0190
    with pytest.raises(DeviceError, match="TMP117"):
        bench.open()
    del bench.board.bus.parts[0x60]
    with pytest.raises(DeviceError, match="does not answer"):
        bench.open()


def test_two_boards_are_two_boards(bench: Bench) -> None:
    other = Bench()
    first, second = bench.armed(), other.armed()
    first.set_power("red", 1.0)
    assert bench.light_uw > 0 and other.light_uw == 0
    second.close()
    first.heartbeat()
    other.close()
    assert attach(bench.board.bus) != bench.node


def test_a_new_host_goes_on_where_the_last_token_was(bench: Bench) -> None:
    first = bench.armed()
    first._heartbeat.token = 0
    bench.pass_time(0.02)
    first._heartbeat.beat()  # token 1, as a new host's first one would be
    first._closed = True  # the process was killed
    bench.pass_time(0.2)
    second = bench.open()
    second.clear()
    second.arm()
