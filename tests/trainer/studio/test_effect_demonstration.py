"""What the catalogue shows of each effect: nothing where it is absent, more where it is more, and sound physics."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.effects import Parameter, Sensor, catalogue, effect
from trainer.studio.effect_demonstration import (
    CAPTURES,
    EffectPicture,
    demonstrate,
    demonstration_bench,
    differs_by_capture,
    numbers_of,
    orders_of,
)

KNOWN = {name: one for name, one in catalogue().items() if one.source == "built in"}
PHASE_OR_BLUR = (  # move light about in the picture, and neither add nor remove any
    "panel_wavefront",
    "distance",
    "pupil_aberration",
    "temporal_coherence",
    "spatial_coherence",
    "sensor_blur",
)


def shown(name: str, share: float = 1.0, by_eye: bool = False, capture: int = 0) -> EffectPicture:
    """The picture at a share of the way from absent to the example."""
    one = KNOWN[name]
    order = orders_of(one)[0]
    numbers = [n.absent + share * (n.example - n.absent) for n in numbers_of(one, order)]
    return demonstrate(one, numbers, order, by_eye=by_eye, capture=capture)


def rms(picture: EffectPicture) -> float:
    return float(np.sqrt(np.mean(picture.difference.astype(np.float64) ** 2)))


@pytest.mark.parametrize("name", KNOWN)
def test_an_absent_effect_makes_no_difference_at_any_order(name: str) -> None:
    for order in orders_of(KNOWN[name]):
        picture = demonstrate(KNOWN[name], [n.absent for n in numbers_of(KNOWN[name], order)], order)
        assert np.abs(picture.difference).max() < 1e-5 * picture.ideal.max()
        assert picture.light == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("name", KNOWN)
def test_more_of_an_effect_makes_more_of_a_difference(name: str) -> None:
    sizes = [rms(shown(name, share)) for share in (0.25, 0.5, 1.0)]
    assert sizes[0] > 0
    assert sizes == sorted(sizes)
    assert shown(name).nrmse > 0.02, "the example is easy to see"


@pytest.mark.parametrize("name", KNOWN)
def test_the_eye_sees_what_acts_on_the_display_and_nothing_else(name: str) -> None:
    camera, eye = shown(name), shown(name, by_eye=True)
    if KNOWN[name].acts_on == "camera":
        assert not eye.difference.any()
        assert camera.difference.any()
    else:
        np.testing.assert_allclose(eye.with_effect, camera.with_effect, atol=1e-3 * eye.ideal.max())


@pytest.mark.parametrize("name", PHASE_OR_BLUR)
def test_what_only_moves_light_conserves_it(name: str) -> None:
    assert shown(name).light == pytest.approx(1, abs=0.03)


def test_what_adds_or_takes_light_does_so() -> None:
    assert shown("iris").light < 0.99
    assert shown("stray_light").light > 1.05
    ghost = KNOWN["ghost"]
    amplitude = next(n for n in numbers_of(ghost, 0) if n.parameter == "amplitude").example
    assert shown("ghost").light == pytest.approx(1 + amplitude, abs=0.03)


def test_a_shift_of_the_registration_moves_the_picture_by_that_much() -> None:
    one = KNOWN["misregistration"]
    numbers = numbers_of(one, 1)
    picture = demonstrate(one, [2.0 if n.parameter == "shift_x" else n.absent for n in numbers], 1)
    inner = picture.with_effect[10:-10, 10:-10]
    np.testing.assert_allclose(inner, picture.ideal[10:-10, 12:-8], atol=0.02 * picture.ideal.max())


def test_captures_of_a_drifting_laser_differ_by_its_spread() -> None:
    assert [name for name, one in KNOWN.items() if differs_by_capture(one)] == ["laser_drift", "frame_motion"]
    example = numbers_of(KNOWN["laser_drift"], 0)[0].example
    gains = [shown("laser_drift", capture=k).light for k in range(CAPTURES)]
    assert np.mean(gains) == pytest.approx(1, abs=1e-4)
    assert 100 * np.std(gains) == pytest.approx(example, rel=1e-3)


@pytest.mark.parametrize("name", KNOWN)
def test_sliders_have_physical_ranges(name: str) -> None:
    for order in orders_of(KNOWN[name]):
        numbers = numbers_of(KNOWN[name], order)
        assert len({n.label for n in numbers}) == len(numbers)
        for n in numbers:
            parameter = KNOWN[name].parameter(n.parameter)
            assert parameter.low <= n.low < n.high <= parameter.high
            assert n.low <= n.absent <= n.high and n.low <= n.example <= n.high
            assert 0 < n.step <= (n.high - n.low) / 50


def test_an_effect_of_a_users_own_needs_nothing_more() -> None:
    @effect(stage="sensor", acts_on="camera", parameters=[Parameter("share", "1", scale=0.02, low=0, high=1)])
    def haze(sensor: Sensor, share: object) -> Sensor:
        """A share of full scale is added.

        As from a lamp.

        References
        ----------
        A paper,
        on two lines.

        Another one.
        """
        return sensor.brightened(share * sensor.full_scale)  # type: ignore[operator]

    assert (haze.about, haze.description) == ("A share of full scale is added.", "As from a lamp.")
    assert haze.references == ("A paper, on two lines.", "Another one.")
    assert haze.formula == ""
    (number,) = numbers_of(haze, 0)
    assert (number.low, number.high, number.example) == (0, 0.4, 0.2)
    picture = demonstrate(haze, [0.1])
    added = 0.1 * demonstration_bench().camera.full_scale
    np.testing.assert_allclose(picture.difference, added, rtol=1e-4)
