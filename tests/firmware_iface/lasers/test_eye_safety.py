"""The Class 1 arithmetic: published values, and that no picture escapes between two sizes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import (
    ALL_IN_ONE_SPOT,
    SIZES_MRAD,
    exposure,
    photochemical_limit_uw,
    spot_shares,
    thermal_limit_uw,
)

NM = {"red": 638.0, "green": 520.0, "blue": 450.0}


@pytest.mark.parametrize(
    ("nm", "uw"), [(450, 39), (462, 68), (473, 112), (488, 224), (520, 390), (532, 390), (638, 390)]
)
def test_point_source_limits_over_30000_s(nm: float, uw: float) -> None:
    assert min(thermal_limit_uw(), photochemical_limit_uw(nm)) == pytest.approx(uw, rel=0.01)


@pytest.mark.parametrize(
    ("mrad", "mw"), [(1.5, 0.39), (5, 1.29), (10, 2.5), (50, 9.9), (100, 14.8), (500, 14.8)]
)
def test_extended_sources_bear_more(mrad: float, mw: float) -> None:
    assert thermal_limit_uw(mrad) == pytest.approx(1e3 * mw, rel=0.01)


def test_wavelengths_add_and_the_hazards_do_not() -> None:
    found = exposure({"red": 130.0, "green": 130.0, "blue": 13.0}, NM)
    assert found.thermal == pytest.approx(273 / 390)
    assert found.photochemical == pytest.approx(13 / 39 + 130 / 979.6, rel=1e-3)
    assert found.worst == found.thermal


def test_one_bright_spot_counts_whole_and_a_spread_picture_by_its_brightest_squares() -> None:
    picture = np.zeros((200, 200))
    picture[77, 31] = 5.0
    assert spot_shares(picture, 0.5) == ALL_IN_ONE_SPOT
    flat = spot_shares(np.ones((200, 200)), 0.5)  # 100 mrad across
    assert flat[0] == pytest.approx((4 / 200) ** 2)  # 3 pixels, and one for where they begin
    assert flat[-1] == 1
    assert exposure({"red": 390.0}, NM, {"red": flat}).thermal < 0.1 < exposure({"red": 390.0}, NM).thermal


def test_a_dark_prediction_promises_nothing() -> None:
    assert spot_shares(np.zeros((4, 4)), 1.0) == ALL_IN_ONE_SPOT


@given(st.integers(0, 2**32 - 1), st.floats(1.5, 100.0), st.floats(0.3, 20.0))
def test_no_disc_of_any_size_exceeds_its_limit_when_the_budget_is_kept(
    seed: int, mrad: float, pitch: float
) -> None:
    """Against a direct search: light within a disc anywhere, over the limit for a source of its size."""
    rng = np.random.default_rng(seed)
    picture = rng.random((24, 24)) ** rng.integers(1, 30)
    used = exposure({"red": 1.0}, NM, {"red": spot_shares(picture, pitch)}).thermal
    y, x = np.mgrid[:24, :24]
    cy, cx = rng.uniform(0, 23, 2)
    inside = np.hypot(y - cy, x - cx) * pitch <= mrad / 2
    assert picture[inside].sum() / picture.sum() / thermal_limit_uw(mrad) <= used * (1 + 1e-9)


def test_the_hot_spots_of_all_colours_are_taken_to_coincide() -> None:
    shares = {"red": (0.5,) * len(SIZES_MRAD), "green": (0.25,) * len(SIZES_MRAD)}
    found = exposure({"red": 200.0, "green": 200.0}, NM, shares)
    assert found.thermal == pytest.approx((100 + 50) / 390)


@pytest.mark.parametrize(
    ("picture", "pitch"),
    [(np.ones(3), 1.0), (-np.ones((2, 2)), 1.0), (np.full((2, 2), np.nan), 1.0), (np.ones((2, 2)), 0)],
)
def test_what_is_no_picture_is_refused(picture: np.ndarray, pitch: float) -> None:
    with pytest.raises(InputError):
        spot_shares(picture, pitch)
