"""Captures of a headset that shows colours in turn: each colour in its own field, with the light that was asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.bench_description import ChannelDescription
from runtime.headset.colour_fields import gated, open_colours
from runtime.headset.open_devices import Devices
from runtime.service.shared_memory import crc32
from tests.campaigns.headset import COLOURS, SHAPE, hardware, write_configuration
from tests.runtime.calibration.drifting import devices

pytestmark = pytest.mark.usefixtures("real_time")  # an emulated headset needs its share of the cores

FIELD_MS, LIGHT_MS = 5.556, 2.778  # of a virtual panel: a field, and the longest light in it


def headset_in_colour(noisy: bool = True, fields: int = 3) -> tuple[VirtualHeadset, Devices]:
    channels = tuple(ChannelDescription(name, nm) for name, nm in COLOURS.items())
    bench = BenchDescription(channels=channels).resized(*SHAPE, 6.0)
    if not noisy:
        bench = replace(bench, camera=replace(bench.camera, read_noise_e=0.5, full_well_e=1e6))
    headset = VirtualHeadset(bench, seed=3)
    return headset, gated(devices(headset), tuple(COLOURS), fields)


def pattern(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


def test_one_laser_is_on_and_only_in_its_own_field() -> None:
    headset, lit = headset_in_colour()
    for number, colour in enumerate(COLOURS):
        lit.light(colour)
        assert all(headset.lasers.power(c) == 0 for c in COLOURS), "until its field is displayed"
        lit.panel.show(pattern(number))
        assert [headset.lasers.power(c) for c in COLOURS] == [float(c == colour) for c in COLOURS]
        assert [f.lasers for f in headset.panel.fields] == [(1 << k) * (k == number) for k in range(3)]
        assert all((f.gray == pattern(number)).all() for f in headset.panel.fields)


def test_each_colours_pattern_is_in_its_own_field_and_further_fields_are_dark() -> None:
    headset, lit = headset_in_colour(fields=4)
    grays = np.stack([pattern(k) for k in range(3)])
    lit.light_all(["red", "blue"])
    lit.panel.show_colours(grays)
    shown = headset.panel.fields
    assert [f.lasers for f in shown] == [1, 0, 4, 0]
    assert all((f.gray == gray).all() for f, gray in zip(shown, grays, strict=False))


def test_a_colour_shows_its_pattern_in_all_of_its_fields() -> None:
    """Seven fields are two for each of three colours, and one that is dark: twice the light of one in a frame."""
    headset, lit = headset_in_colour(noisy=False, fields=7)
    grays = np.stack([pattern(k) for k in range(3)])
    lit.light_all(["red", "blue"])
    lit.panel.show_colours(grays)
    assert [f.lasers for f in headset.panel.fields] == [1, 0, 4, 1, 0, 4, 0]
    assert all((f.gray == grays[k % 3]).all() for k, f in enumerate(headset.panel.fields[:6]))
    for asked_ms, frames in ((2 * LIGHT_MS, 1), (3.0, 1), (2 * LIGHT_MS + 0.1, 2)):
        lit.camera.exposure_ms = asked_ms
        assert lit.camera.exposure_ms == pytest.approx(asked_ms, rel=2e-3)
        assert headset.camera.exposure_ms == pytest.approx(7 * frames * FIELD_MS)
        lit.light("green")
        lit.panel.show(pattern(1))
        black = headset.description.camera.black_level
        expected = (headset.expected_counts(pattern(1), "green") - black) * asked_ms / 10
        assert (lit.camera.capture() - float(black)).mean() == pytest.approx(expected.mean(), rel=5e-3)


@pytest.mark.parametrize(
    ("asked_ms", "frames"), [(0.3, 1), (LIGHT_MS, 1), (3 * LIGHT_MS, 3), (20.0, 8), (1000.0, 360)]
)
def test_a_picture_is_of_whole_frames_and_has_the_light_that_was_asked(asked_ms: float, frames: int) -> None:
    """As much as in one colour for this time: the same electrons, so the same noise."""
    headset, lit = headset_in_colour(noisy=False)
    lit.camera.exposure_ms = asked_ms
    assert lit.camera.exposure_ms == pytest.approx(asked_ms, rel=2e-3)
    assert headset.camera.exposure_ms == pytest.approx(3 * frames * FIELD_MS)
    if asked_ms > 20:
        return  # it saturates
    lit.light("green")
    lit.panel.show(pattern(1))
    black = headset.description.camera.black_level
    expected = (headset.expected_counts(pattern(1), "green") - black) * asked_ms / 10
    counts = lit.camera.capture() - float(black)
    assert counts.mean() == pytest.approx(expected.mean(), rel=5e-3)
    assert np.abs(counts - expected).max() < max(1.0, 0.03 * expected.max())  # whole counts


def test_a_frame_that_is_a_cameras_longest_exposure_but_for_rounding_is_taken() -> None:
    headset, lit = headset_in_colour()
    headset.camera.longest_exposure_ms = 16.6667
    lit.camera.exposure_ms = 1.0
    assert headset.camera.exposure_ms == 16.6667
    with pytest.raises(InputError, match="out of range"):
        lit.camera.exposure_ms = LIGHT_MS + 0.1


def test_what_has_no_field_or_no_laser_is_refused() -> None:
    headset, lit = headset_in_colour()
    with pytest.raises(InputError, match="'infrared' has no field"):
        lit.light("infrared")
    with pytest.raises(InputError, match="2 fields and there are 3 colours"):
        gated(devices(headset), tuple(COLOURS), 2)
    with pytest.raises(InputError, match="no laser 'infrared'"):
        gated(devices(headset), ("red", "infrared"), 3)


@pytest.mark.parametrize("patterns", [1, 2])
def test_through_the_drivers_no_light_is_in_another_colours_field(tmp_path: Path, patterns: int) -> None:
    """On emulated hardware, whose panel records what was on it whenever a light output was open."""
    file = write_configuration(tmp_path, colours=True, patterns=patterns)
    grays = {colour: pattern(k) for k, colour in enumerate(COLOURS)}
    truth = VirtualHeadset(BenchDescription(
        channels=tuple(ChannelDescription(name, nm) for name, nm in COLOURS.items())
    ).resized(*SHAPE, 6.0))  # fmt: skip
    black = truth.description.camera.black_level
    with hardware(tmp_path) as remote:
        with open_colours(str(file), tuple(COLOURS)) as lit:
            for colour in (*COLOURS, "red"):
                lit.light(colour)
                lit.panel.show(grays[colour])
                expected = truth.expected_counts(grays[colour], colour) - black
                lit.camera.exposure_ms = 10 * 0.4 * 2**truth.description.camera.bit_depth / expected.max()
                lit.panel.show(grays[colour])
                counts = np.mean([lit.camera.capture().astype(float) - black for _ in range(4)], axis=0)
                light = (
                    expected * 0.5 * lit.camera.exposure_ms / 10
                )  # at the configuration's half of full power
                assert counts.mean() == pytest.approx(light.mean(), rel=0.03)
                assert np.corrcoef(counts.ravel(), light.ravel())[0, 1] > 0.99
        own = {(crc32(grays[colour]), 1 << k) for k, colour in enumerate(COLOURS)}
        assert remote.lit() == own
        assert remote.light()[-1][1] == 0 and not math.isclose(max(p for _, p in remote.light()), 0)
