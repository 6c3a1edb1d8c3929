"""What is found in one plane is checked in the bundle's others before it replaces anything."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np
import pytest

from runtime.bundle.bundle_folder import Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.calibration.bundle_replacement import replace_bundle
from runtime.calibration.self_calibration import Calibration, calibrate
from runtime.calibration.summary import numbers, sentence_of
from runtime.headset.open_devices import Devices
from tests.runtime.benches import ideal_path
from tests.runtime.calibration.drifting import WAVELENGTH_NM, drifted_bench, headset

pytestmark = pytest.mark.usefixtures("spared_maps")

SHAPE, PLANES_MM = (64, 80), (8.0, 10.5)
OFFSET_MM = 0.18  # of the defect distance


def two_planes(folder: Path) -> Bundle:
    paths = [("green", mm, WAVELENGTH_NM, ideal_path(SHAPE, mm * 1e-3, dtype=np.float32)) for mm in PLANES_MM]
    records, arrays = pack_light_paths(paths)
    write_bundle(folder, arrays, {"paths": records, "distance_mm": PLANES_MM[0]}, {})
    return read_bundle(folder)


def calibrated(
    folder: Path, *defects: str, focus: Callable[[float], float] | None = lambda mm: mm
) -> Calibration:
    """A headset with defects its bundle does not know; `focus` is where its camera really looks."""
    bench = headset(drifted_bench(*defects, shape=SHAPE))

    def opened() -> AbstractContextManager[Devices]:
        move = None if focus is None else lambda mm: bench.move_to_plane(focus(mm))
        return nullcontext(Devices(bench.panel, bench.lasers, bench.camera, {}, move))

    return calibrate(opened, two_planes(folder))


def test_what_is_found_in_one_plane_is_right_in_the_other(tmp_path: Path) -> None:
    found = calibrated(tmp_path / "bundle", "panel_wavefront", "distance")
    (check,) = found.planes
    assert found.verdict == "recalibrated" and found.complete and not found.planes_unchecked
    assert check.plane_mm == PLANES_MM[1] and not check.worse
    assert check.before.excess > 0.05 and check.after.excess < 0.001
    replace_bundle(tmp_path / "bundle", read_bundle(tmp_path / "bundle"), found)
    near, far = (load_light_path(read_bundle(tmp_path / "bundle"), "green", mm) for mm in PLANES_MM)
    np.testing.assert_array_equal(near.source, far.source)
    assert np.std(np.angle(far.source)) > 0.1


def test_nothing_is_replaced_where_the_other_plane_would_get_worse(tmp_path: Path) -> None:
    """The second focus is short by twice the offset: there, the offset found in the first makes it worse."""
    wrong = {PLANES_MM[0]: PLANES_MM[0], PLANES_MM[1]: PLANES_MM[1] - 2 * OFFSET_MM}
    found = calibrated(tmp_path / "bundle", "distance", focus=lambda mm: wrong[mm])
    (check,) = found.planes
    assert found.before.errors.excess > 10 * found.after.errors.excess
    assert check.worse and check.after.excess > check.before.excess
    assert found.verdict == "not_explained" and not found.complete
    said = sentence_of(numbers(found), replaced=False)
    assert "wrong in the one at 10.5 mm" in said and "nothing was replaced" in said


def test_planes_that_the_camera_cannot_be_focused_on_are_named(tmp_path: Path) -> None:
    found = calibrated(tmp_path / "bundle", "panel_wavefront", focus=None)
    assert found.verdict == "recalibrated" and found.planes == ()
    assert numbers(found)["planes_unchecked"] == pytest.approx([PLANES_MM[1]])
    assert "Not checked, as the camera's focus is fixed: 10.5 mm." in sentence_of(numbers(found), True)
