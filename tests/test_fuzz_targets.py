"""The fuzzing campaign's targets on a few random inputs each, so that they are not found broken when they are needed.

Coverage-guided and for long: python -m tests.campaigns.fuzz
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.campaigns.fuzz import TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_are_taken_or_refused(name: str) -> None:
    target = TARGETS[name]()

    @given(st.binary(max_size=200))
    @settings(max_examples=30)
    def tried(data: bytes) -> None:
        target(data)

    tried()
