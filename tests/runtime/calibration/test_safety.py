"""Lasers are off after a calibration, also after an error; and they are on only where pictures need them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset
from runtime.bundle.bundle_folder import read_bundle
from runtime.calibration.self_calibration import calibrate
from tests.runtime.calibration.drifting import drifted_bench, headset, ideal_bundle, opened


def failing_at(device: VirtualHeadset, capture: int, error: BaseException) -> VirtualHeadset:
    """A headset whose camera raises at one capture."""
    whole = device.camera.capture

    def take() -> Any:
        if device.captures == capture:
            raise error
        return whole()

    device.camera.capture = take  # type: ignore[method-assign]
    return device


@pytest.mark.parametrize("capture", [1, 3, 5, 20])
@pytest.mark.parametrize("error", [OSError("unplugged"), KeyboardInterrupt()])
def test_lasers_are_off_after_an_error(tmp_path: Path, capture: int, error: BaseException) -> None:
    bundle = read_bundle(ideal_bundle(tmp_path / "bundle", (64, 80)))
    device = failing_at(headset(drifted_bench(shape=(64, 80))), capture, error)
    with pytest.raises(type(error)):
        calibrate(opened(device), bundle)
    assert device.lasers.power("green") == 0


def test_a_dark_bench_is_said_and_left_dark(tmp_path: Path) -> None:
    device = headset(drifted_bench(shape=(64, 80)))
    bundle = read_bundle(ideal_bundle(tmp_path / "bundle", (64, 80)))
    device.lasers.set_power = lambda channel, fraction: None  # type: ignore[method-assign]
    with pytest.raises(InputError, match="sees no light"):
        calibrate(opened(device), bundle)


def test_lasers_are_on_only_for_pictures_that_need_them(tmp_path: Path) -> None:
    """The first pictures are dark ones, and no laser is ever above the power that was asked for."""
    device = headset(drifted_bench(shape=(64, 80)))
    bundle = read_bundle(ideal_bundle(tmp_path / "bundle", (64, 80)))
    seen: list[float] = []
    whole = device.camera.capture

    def take() -> np.ndarray:
        seen.append(device.lasers.power("green"))
        if len(seen) == 12:
            raise RuntimeError("enough")
        return whole()

    device.camera.capture = take  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="enough"):
        calibrate(opened(device), bundle)
    assert seen[:2] == [0, 0] and set(seen[2:]) == {1.0}
