"""The Class 1 arithmetic: published values, and that no picture escapes between two sizes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.errors import InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import (
    ALL_IN_ONE_SPOT,
    SIZES_MRAD,
    GatedLight,
    exposure,
    largest_pulsed_mrad,
    photochemical_limit_uw,
    pulse_limit_uw,
    spot_shares,
    thermal_limit_uw,
)
from firmware_iface.lasers.pattern_power import LightBudget

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


def test_fields_in_turn_use_their_sum_over_the_frame() -> None:
    """Each laser at the limit of a point source would be three times too much at once, and is just allowed in turn."""
    full = {"red": 390.0, "green": 390.0, "blue": 0.0, "more": 390.0}
    nm = NM | {"more": 600.5}
    assert exposure(full, nm).thermal == pytest.approx(3)
    in_turn = GatedLight(duty=1 / 3, pulse_s=0.005, frame_s=0.015)
    assert exposure(full, nm, gated=in_turn).thermal == pytest.approx(1)
    found = exposure({"red": 130.0, "green": 130.0, "blue": 13.0}, NM, gated=GatedLight(1 / 6, 0.002, 0.012))
    assert found.thermal == pytest.approx(273 / 390 / 6)
    assert found.photochemical == pytest.approx((13 / 39 + 130 / 979.6) / 6, rel=1e-3)


@pytest.mark.parametrize(
    ("mrad", "pulse_s", "mw"),
    [
        (1.5, 0.25, 0.99),  # the limit of 1 mW for a quarter of a second
        (1.5, 0.004, 2.783),  # 7e-4 t^-0.25
        (5.0, 0.004, 2.783 * 5 / 1.5),
        (10.0, 0.004, 0.2 * 2.783 * 10 / 1.5),
        (100.0, 0.004, 0.2 * 2.783 * 12.649 / 1.5),  # as large as 200 t^0.5 mrad at most
        (1.5, 6e-6, 14.14),
        (1.5, 1e-9, 0.4 * 14.80),  # counts as 5 us, of more than 600 in a train
    ],
)
def test_a_pulse_has_a_limit_of_its_own(mrad: float, pulse_s: float, mw: float) -> None:
    assert pulse_limit_uw(mrad, pulse_s) == pytest.approx(1e3 * mw, rel=1e-3)
    assert largest_pulsed_mrad(0.004) == pytest.approx(12.649, rel=1e-3)


def test_a_short_bright_pulse_is_limited_by_itself_and_not_by_the_mean() -> None:
    rare = GatedLight(duty=0.004, pulse_s=0.004, frame_s=1.0)
    found = exposure({"red": 3000.0}, NM, gated=rare)
    # a source of 6.1 mrad bears the least: 0.2 * 6.1 / 1.5 of what a point bears
    assert found.worst == found.thermal == pytest.approx(3.0 / 2.783 / (0.2 * SIZES_MRAD[4] / 1.5), rel=1e-3)
    spread = exposure({"red": 3000.0}, NM, {"red": (0.02,) * len(SIZES_MRAD)}, rare)
    assert spread.thermal < found.thermal


@pytest.mark.parametrize(("duty", "pulse_s", "frame_s"), [(0, 1, 1), (1.1, 1, 1), (0.5, 0, 1), (0.5, 2, 1)])
def test_gated_light_that_cannot_be_is_refused(duty: float, pulse_s: float, frame_s: float) -> None:
    with pytest.raises(InputError, match="within the frame"):
        GatedLight(duty, pulse_s, frame_s)


def test_several_pulses_in_a_frame_are_also_one_pulse_of_all_their_light() -> None:
    """2 mW fit a pulse of 4 ms a second, and not two: as one of 8 ms they may have 1.898 mW.

    A source of 6.08 mrad bears the least: 0.2 * 6.08 / 1.5 of the 2.783 mW and 2.341 mW of a point.
    """
    once = GatedLight(duty=0.004, pulse_s=0.004, frame_s=1.0)
    twice = GatedLight(duty=0.008, pulse_s=0.004, frame_s=1.0, pulses=2)
    assert exposure({"red": 2000.0}, NM, gated=once).worst == pytest.approx(2.0 / 2.257, rel=1e-3)
    assert exposure({"red": 2000.0}, NM, gated=twice).worst == pytest.approx(2.0 / 1.898, rel=1e-3)
    channels = [LaserChannel("red", 638.0, 2000.0, 45.0, 60.0)]
    LightBudget(channels, once).check({"red": 1.0})
    with pytest.raises(InputError, match=r"1\.05 of the Class 1 limit"):
        LightBudget(channels, twice).check({"red": 1.0})


def test_the_mean_of_several_pulses_is_of_all_of_them() -> None:
    """Four pulses of 2 ms in 16 ms are half of the time: 780 uW make the 390 uW of a point, and one a quarter."""
    each = {"duty": 0.125, "pulse_s": 0.002, "frame_s": 0.016}
    four = GatedLight(**{**each, "duty": 0.5}, pulses=4)
    assert exposure({"red": 780.0}, NM, gated=four).thermal == pytest.approx(1)
    one = exposure({"red": 780.0}, NM, gated=GatedLight(**each))
    assert one.thermal == pytest.approx(780 / 2684, rel=1e-3), (
        "its mean is 0.25, and a pulse may have 2.684 mW"
    )
    assert exposure({"blue": 78.0}, NM, gated=four).photochemical == pytest.approx(1)
    with pytest.raises(InputError, match="share of all pulses"):
        GatedLight(**each, pulses=4)
    with pytest.raises(InputError, match="within the frame"):
        GatedLight(duty=1.0, pulse_s=0.002, frame_s=0.016, pulses=9)


def test_some_of_a_frames_pulses_can_be_worse_than_one_and_than_all() -> None:
    """Large sources, 0.3 ms: one pulse may have 3.545 mW, two 2.981, three 3.233, four 3.050."""
    spread = (1e-6,) * 5 + (1.0,) * (len(SIZES_MRAD) - 5)
    found = [
        exposure({"red": 3000.0}, NM, {"red": spread}, GatedLight(n * 0.0003, 0.0003, 1.0, n)).thermal
        for n in (1, 2, 3, 4)
    ]
    assert found[0] == pytest.approx(3.0 / 3.545, rel=1e-3)
    assert found[1] == found[2] == found[3] == pytest.approx(3.0 / 2.981, rel=1e-3)
    assert max(3.0 / 3.545, 3.0 / 3.050) < 1 < found[3]


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 3), st.floats(0.001, 0.02))
def test_no_time_of_any_length_has_more_light_than_its_limit_when_the_budget_is_kept(
    seed: int, patterns: int, colours: int, field_s: float
) -> None:
    """Against the standard's rule for any part of a train: its mean power keeps the limit of its duration."""
    rng = np.random.default_rng(seed)
    shares = np.maximum.accumulate(rng.random(len(SIZES_MRAD)) ** rng.integers(1, 12))
    pulse_s, frame_s = field_s / 2, patterns * colours * field_s
    gated = GatedLight(patterns * pulse_s / frame_s, pulse_s, frame_s, patterns)
    power_uw = 1 / exposure({"red": 1.0}, NM, {"red": shares}, gated).thermal
    for count in {*range(1, 40), *np.geomspace(40, 30 / field_s, 30).astype(int).tolist()}:
        lasts_s = (count - 1) * colours * field_s + pulse_s
        mean_uw = power_uw * count * pulse_s / lasts_s
        for share, mrad in zip(shares, SIZES_MRAD, strict=True):
            if mrad <= largest_pulsed_mrad(lasts_s):
                longest = 10 * 10 ** ((mrad - 1.5) / 98.5)
                limit_uw = 700 * min(lasts_s, longest) ** -0.25 * mrad / 1.5
                assert share * mean_uw <= 1.01 * limit_uw, (count, mrad)
