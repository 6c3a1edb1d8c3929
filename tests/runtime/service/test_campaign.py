"""A small part of the fault campaign, and a short run without faults, in every run of the tests."""

from __future__ import annotations

from pathlib import Path

import pytest
import smbus2

from firmware_iface.lasers.i2c_transfers import open_bus
from firmware_iface.virtual.remote_hardware import i2c_bus
from tests.campaigns.fault_kinds import KINDS
from tests.campaigns.faults import campaign, plans, summary
from tests.campaigns.lane import Lane
from tests.campaigns.soak import soak

pytestmark = pytest.mark.usefixtures("real_time")


def test_every_kind_of_fault_is_survived() -> None:
    """Dark where that is required, nothing torn, every frame answered, and every headset recovers."""
    result = campaign(count=68, seed=7, lanes=2, oak=False)
    found = summary(result)
    assert list(found) == [
        "faults",
        "by_kind",
        "dark_required",
        "dark_in_time",
        "worst_dark_ms",
        "torn_frames",
        "wrongly_lit_fields",
        "lost_without_error",
        "recovered",
        "not_recovered",
    ]
    assert found["faults"] == found["recovered"] == sum(found["by_kind"].values()) == 68, result.troubles
    assert set(found["by_kind"]) == {kind.name for kind in KINDS}
    assert found["torn_frames"] == found["lost_without_error"] == found["not_recovered"] == 0
    assert found["wrongly_lit_fields"] == 0 and result.lit_fields > 30
    assert found["dark_required"] > 30
    # a busy machine may delay it by some milliseconds; the table in the README was measured on an idle one
    assert found["dark_in_time"] >= 0.9 * found["dark_required"]
    assert found["worst_dark_ms"] < 900


def test_a_plan_is_fixed_by_its_seed_and_has_all_faults() -> None:
    first = plans(500, 3, 3, slow_first=True)
    assert first == plans(500, 3, 3, slow_first=True) != plans(500, 4, 3, slow_first=True)
    assert sum(map(len, first)) == 500 and len(first[0]) == pytest.approx(100, abs=1)


def test_a_run_without_faults_loses_nothing_and_does_not_grow() -> None:
    found = soak(600, 100.0)
    assert found["shown"] + found["lost"] >= 590 and found["lost_without_error"] == found["torn_frames"] == 0
    # a busy machine may stop everything for longer than a frame may wait
    assert found["lost"] <= 2
    assert all(memory["end"] - memory["settled"] < 3 for memory in found["memory_mb"].values())


def test_a_run_in_three_colours_has_no_light_in_a_wrong_field_and_says_how_long_each_stage_takes() -> None:
    found = soak(150, 50.0, colours=True)
    assert found["lit_fields"] > 3 and found["wrongly_lit_fields"] == found["torn_frames"] == 0
    stages = found["stage_ms"]
    assert set(stages) == {"queue", "solve", "transfer", "total"} and stages["solve"] < stages["total"]


def test_noise_in_the_dacs_memory_keeps_the_light_off_until_it_is_written_dark(tmp_path: Path) -> None:
    """As random bytes on the bus can write it. Opening the lasers refuses until a person has corrected it."""
    lane = Lane(tmp_path, 0)
    try:
        assert lane.light_up()
        with open_bus(i2c_bus(f"virtual:{tmp_path / 'hardware.sock'}")) as bus:
            bus.i2c_rdwr(smbus2.i2c_msg.write(0x60, [0x50, 0x81, 0x00, 0x81, 0x00, 0x81, 0x00, 0x81, 0x00]))
        lane.remote.break_part("lasers", "nack")
        assert lane.light_up()
        assert lane.stored == 1
    finally:
        lane.close()
