"""Results that are kept: how many, how large, and for how long."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from trainer import kept_results
from trainer.kept_results import forgotten_afterwards, kept_by_device, kept_for_same

KB = 1024


@dataclass(frozen=True)
class Pair:
    """Two views of one tensor's memory."""

    whole: Tensor
    half: Tensor


def made_of(size: int) -> Tensor:
    return torch.zeros(size, dtype=torch.uint8)


def test_the_oldest_go_where_all_are_too_many_or_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_results, "MOST_BYTES", 10 * KB)
    sizes = []

    @kept_by_device(3)
    def result(name: str, size: int) -> Tensor:
        sizes.append((name, size))
        return made_of(size)

    for name in "abc":
        result(name, 3 * KB)
    result("a", 3 * KB)  # the one that was used last
    assert len(sizes) == 3
    result("d", 1)  # four are too many: without b
    result("a", 3 * KB), result("c", 3 * KB), result("d", 1)
    assert len(sizes) == 4
    result("e", 5 * KB)  # 11 KB are too much: without a
    result("c", 3 * KB), result("d", 1), result("e", 5 * KB)
    assert len(sizes) == 5
    result("a", 3 * KB)
    assert len(sizes) == 6
    large = result("f", 20 * KB)  # the only one that is kept, as it was made last
    assert result("f", 20 * KB) is large and len(sizes) == 7
    result("a", 3 * KB)
    assert len(sizes) == 8


def test_memory_that_parts_of_a_result_share_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_results, "MOST_BYTES", 5 * KB)
    made = []

    @kept_by_device(8)
    def pair(name: str) -> tuple[Pair, Tensor]:
        made.append(name)
        whole = made_of(2 * KB)
        return Pair(whole, whole[KB:]), torch.zeros((), dtype=torch.uint8).expand(100 * KB)

    first = pair("a")
    pair("b")
    assert pair("a") is first and made == ["a", "b"]


def test_what_a_block_makes_is_kept_to_its_end() -> None:
    made = []

    @kept_by_device(8)
    def result(name: str) -> Tensor:
        made.append(name)
        return made_of(1)

    before = result("before")
    with forgotten_afterwards():
        inside = result("inside")
        assert result("inside") is inside and result("before") is before
        elsewhere = threading.Thread(target=result, args=("of another thread",))
        elsewhere.start()
        elsewhere.join()
    assert result("before") is before
    result("of another thread")
    assert made == ["before", "inside", "of another thread"]
    result("inside")
    assert made[3:] == ["inside"]


def test_results_for_the_same_objects_are_bounded_and_forgotten_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kept_results, "MOST_BYTES", 3 * KB)
    made = []

    @kept_for_same(4)
    def result(of: list[int]) -> Tensor:
        made.append(of)
        return made_of(of[0])

    first, second = [2 * KB], [2 * KB]
    with torch.no_grad():
        result(first)
        result(second)
        result(second)
        assert len(made) == 2
        result(first)
        assert len(made) == 3
        with forgotten_afterwards():
            third = [1]
            result(third), result(third)
            assert len(made) == 4
        result(third)
        assert len(made) == 5
    result(first)
    result(first)  # with derivatives, none is kept
    assert len(made) == 7


def test_numbers_among_the_objects_are_compared_by_value() -> None:
    made = []

    @kept_for_same(4)
    def result(of: list[int], size: int) -> Tensor:
        made.append(size)
        return made_of(size)

    first = [0]
    with torch.no_grad():
        for size in ("1000", "1000", "1001"):
            result(first, int(size))  # another object each time
    assert made == [1000, 1001]
