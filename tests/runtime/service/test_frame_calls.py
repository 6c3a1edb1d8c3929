"""Frame calls: any sequence of them keeps the rules of wait, begin and end."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.service.frame_calls import FrameCalls, OrderError

CALLS = st.lists(
    st.tuples(st.sampled_from(["wait", "begin", "end", "settle"]), st.integers(0, 4), st.integers(0, 2)),
    max_size=40,
)


def test_a_frame_goes_through_wait_begin_and_end() -> None:
    calls = FrameCalls()
    assert calls.wait() == 1
    calls.begin(1)
    assert calls.wait() == 2  # the next may be waited for while one is drawn
    calls.end(1, 0)
    calls.begin(2)
    with pytest.raises(OrderError, match="slot 0"):
        calls.end(2, 0)  # the first frame still has it
    assert calls.settle(1) == 0
    calls.end(2, 0)


def test_a_frame_that_was_begun_and_not_ended_is_discarded() -> None:
    calls = FrameCalls()
    calls.begin(calls.wait())
    calls.begin(calls.wait())
    with pytest.raises(OrderError):
        calls.end(1, 0)
    calls.end(2, 0)


@given(CALLS)
def test_no_sequence_of_calls_breaks_the_rules(sequence: list[tuple[str, int, int]]) -> None:
    """Against a plain record of what happened."""
    calls = FrameCalls()
    waited: list[int] = []
    begun: list[int] = []
    ended: dict[int, int] = {}
    for call, frame, slot in sequence:
        if call == "wait":
            allowed = not waited or waited[-1] in begun
            try:
                waited.append(calls.wait())
                assert allowed and waited == list(range(1, len(waited) + 1))
            except OrderError:
                assert not allowed
        elif call == "begin":
            allowed = waited[-1:] == [frame] and frame not in begun
            try:
                calls.begin(frame)
                assert allowed
                begun.append(frame)
            except OrderError:
                assert not allowed
        elif call == "end":
            allowed = begun[-1:] == [frame] and frame not in ended and slot not in calls.slots.values()
            try:
                calls.end(frame, slot)
                assert allowed
                ended[frame] = slot
            except OrderError:
                assert not allowed
        elif frame in calls.slots:
            assert calls.settle(frame) == ended[frame]
