"""Gradients of the simulated bench, by which the best pattern that it can show is found."""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface import InputError
from firmware_iface.virtual import VirtualHeadset, make_defect
from firmware_iface.virtual.bench_optics import BenchOptics
from tests.firmware_iface.small_bench import (
    LINEAR,
    NARROW,
    H,
    W,
    Z,
    quiet,
    small,
)


@pytest.mark.parametrize("interferes", [True, False])
def test_the_gradient_agrees_with_finite_differences(interferes):
    optics = BenchOptics(
        small(
            make_defect("crosstalk"),
            make_defect("zero_order"),
            make_defect("phase_response"),
            make_defect("amplitude_modulation", fall=0.6),
            make_defect("polarisation_leak", amplitude=0.4, interferes=interferes),
            make_defect("phase_ripple", offset_rad=0.3),
            make_defect("drivers"),
            make_defect("coherent_ghost"),
            make_defect("source_lines"),
            make_defect("convention", phase_sign=-1, mirror_x=False),
        )
    )
    rng = np.random.default_rng(9)
    gray = rng.uniform(20, 230, (H, W))
    light, pullback = optics.irradiance_and_pullback(gray, "green", Z)
    weights = rng.standard_normal(light.shape).astype(np.float32)
    gradient = pullback(weights)
    for direction in (np.sign(gradient), np.where(gray > 128, 1.0, -0.5) * np.sign(gradient)):

        def value(t, direction=direction):
            moved = optics.irradiance(gray + t * direction, "green", Z)
            return float((moved * weights).sum(dtype=np.float64))

        slope = (value(0.05) - value(-0.05)) / 0.1
        assert slope == pytest.approx((gradient * direction).sum(), rel=2e-3)


def test_the_gradient_of_the_amplitude_alone_is_right():
    """Of light that no phase changes: the total of a beam that clears the iris."""
    optics = BenchOptics(small(NARROW, make_defect("amplitude_modulation")))
    gray = np.full((H, W), 120.0)
    light, pullback = optics.irradiance_and_pullback(gray, "green", Z)
    gradient = pullback(np.ones_like(light)).sum()
    slope = (
        optics.irradiance(gray + 2, "green", Z).sum() - optics.irradiance(gray - 2, "green", Z).sum()
    ) / 4
    assert gradient == pytest.approx(slope, rel=1e-3) and gradient < 0


def test_a_slow_panel_cannot_be_differentiated():
    headset = quiet(make_defect("slow_response"))
    with pytest.raises(InputError, match=r"slow_response.*take the defect out"):
        headset.oracle_pattern(np.ones((H, W)), "green", iterations=1)


def test_the_oracle_allows_for_what_the_drive_does():
    y, x = np.mgrid[0:H, 0:W]
    target = 0.2 + 0.8 * (np.hypot(x - W / 2, y - H / 2) < 12)
    kinds = ("amplitude_modulation", "polarisation_leak", "drivers")
    true = VirtualHeadset(small(*map(make_defect, kinds)))

    def error(gray):
        a, b = np.sqrt(np.clip(true.true_irradiance(gray, "green"), 0, None)), np.sqrt(target)
        return ((a * (a * b).sum() / (a * a).sum() - b) ** 2).mean()

    found = {
        name: error(one.oracle_pattern(target, "green", iterations=40))
        for name, one in (("true", true), ("ideal", VirtualHeadset(small())))
    }
    assert found["true"] < 0.7 * found["ideal"]


def test_a_kink_in_the_phase_response_has_its_slopes():
    kink = make_defect("phase_response", gain=1.0, kink=0.1, kink_at=0.25, **LINEAR)
    drive = BenchOptics(small(kink)).drive("green")
    gray = np.arange(256.0)[None, :]
    turned = drive.turned(gray)[0]
    assert turned[64] == pytest.approx(0.25 + 0.1)
    assert np.diff(turned)[[10, 200]] * 256 == pytest.approx([1 + 0.4, 1 - 0.1 / 0.75])
    assert drive.slope(gray)[0, [10, 200]] * 128 / np.pi == pytest.approx([1 + 0.4, 1 - 0.1 / 0.75], rel=1e-5)
