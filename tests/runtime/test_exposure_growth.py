"""The longest exposure up to which a camera's brightest pixels grow with the light."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from firmware_iface.errors import InputError
from runtime.headset.exposure_growth import while_growing

SHORTEST_MS = 0.02


def chosen(counts: Callable[[float], float], exposure_ms: float = 10.0) -> float:
    """The exposure for a camera that counts so much, share of full scale, at a light of exposure / 10 ms."""
    return while_growing(exposure_ms, SHORTEST_MS, lambda ms: counts(ms / 10))


def test_straight_and_evenly_bent_responses_keep_their_exposure() -> None:
    assert chosen(lambda light: 0.9 * light) == 10.0
    assert chosen(lambda light: 0.9 * light ** (1 / 2.2)) == 10.0
    assert chosen(lambda light: 0.9 * light + 0.001) == 10.0


@pytest.mark.parametrize("full", [0.7, 0.3, 0.1])
def test_a_pixel_that_is_full_is_exposed_until_it_just_is(full: float) -> None:
    found = chosen(lambda light: 0.9 * min(light, full)) / 10
    assert 0.8 * full < found < 1.6 * full


def test_dark_pictures_keep_their_exposure() -> None:
    assert chosen(lambda light: 0.01) == 10.0


def test_a_camera_that_counts_alike_whatever_its_exposure_is_named() -> None:
    with pytest.raises(InputError, match="switch off its automatic exposure"):
        chosen(lambda light: 0.6)
