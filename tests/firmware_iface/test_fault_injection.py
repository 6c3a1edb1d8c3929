"""The fault script that all byte-level models share."""

from __future__ import annotations

import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual.fault_injection import KINDS, Faults


def strikes(faults: Faults, transfers: int, *kinds: str) -> list[str | None]:
    return [faults.take(*kinds) for _ in range(transfers)]


def test_a_fault_strikes_as_often_as_armed_and_after_the_transfers_it_spares() -> None:
    faults = Faults()
    faults.arm("stall", count=2, after=1)
    assert strikes(faults, 5, "stall") == [None, "stall", "stall", None, None]
    assert faults.struck == {"stall": 2}


def test_without_a_count_it_stays_until_cleared() -> None:
    faults = Faults()
    faults.arm("unplug")
    assert strikes(faults, 50, "unplug") == ["unplug"] * 50 and faults.standing("unplug")
    faults.clear("unplug")
    assert not faults.standing("unplug") and faults.take("unplug") is None


def test_a_transfer_suffers_one_fault_of_those_it_can_and_the_other_waits() -> None:
    faults = Faults()
    faults.arm("short_write")
    faults.arm("stall")
    assert strikes(faults, 3, "stall") == ["stall", None, None]  # a read is never a short write
    assert faults.take("stall", "short_write") == "short_write"
    faults.arm("stall")
    faults.arm("garbage")
    assert strikes(faults, 3, "stall", "garbage") == ["stall", "garbage", None]


def test_looking_does_not_use_a_fault_up() -> None:
    faults = Faults()
    faults.arm("hang")
    assert faults.standing("hang") and faults.standing("hang")
    assert faults.take("hang") == "hang" and not faults.standing("hang")


def test_garbage_is_of_the_same_length_never_the_truth_and_the_same_for_a_seed() -> None:
    data = bytes([0])
    faults = Faults(seed=3)
    assert all(faults.garbled(data) != data and len(faults.garbled(data)) == 1 for _ in range(2000))
    assert Faults(7).garbled(bytes(64)) == Faults(7).garbled(bytes(64)) != Faults(8).garbled(bytes(64))
    assert faults.garbled(b"") == b""


@pytest.mark.parametrize(("kind", "count", "after"), [("stal", 1, 0), ("stall", 0, 0), ("stall", 1, -1)])
def test_a_fault_that_cannot_be_is_refused(kind: str, count: int, after: int) -> None:
    with pytest.raises(InputError, match="stall"):
        Faults().arm(kind, count, after)


def test_every_kind_is_explained() -> None:
    assert all(len(text) > 10 for text in KINDS.values())


def test_an_end_counts_only_after_the_fault_was_due() -> None:
    faults = Faults()
    faults.arm("unplug", after=1)
    faults.clear()
    assert faults.ended["unplug"] == 0
    faults.arm("unplug")
    faults.clear()
    faults.arm("hang", count=2)
    strikes(faults, 2, "hang")
    assert faults.ended == {"unplug": 1, "hang": 1} and faults.struck == {"hang": 2}
