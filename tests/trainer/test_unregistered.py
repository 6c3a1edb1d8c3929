"""A camera of other pixels than the panel's, turned, mirrored, in perspective, and looking past the picture."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import in_view
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.diagnosis.comparison import compare
from trainer.diagnosis.diagnosis import Diagnosis, diagnose
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.pool import open_pool
from trainer.model.model import Model

PIXEL_UM = 6.0  # the panel's are 8


def homography(
    panel: tuple[int, int], camera: tuple[int, int], degrees: float, mirrored: bool, tilt: float
) -> np.ndarray:
    """Camera pixels (x, y, 1) to panel pixels, centre on centre up to half a pixel; shapes are (height, width)."""
    a = np.deg2rad(degrees)
    matrix = np.eye(3)
    matrix[:2, :2] = PIXEL_UM / 8 * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    matrix[:2, :2] @= np.diag([-1 if mirrored else 1, 1])
    centre = np.array([(camera[1] - 1) / 2, (camera[0] - 1) / 2])
    matrix[:2, 2] = np.array([(panel[1] - 1) / 2 + 0.3, (panel[0] - 1) / 2 - 0.4]) - matrix[:2, :2] @ centre
    return np.linalg.inv(np.array([[1, 0, 0], [0, 1, 0], [tilt, -tilt / 2, 1]])) @ matrix


def taken(
    folder: Path,
    *defects: str,
    panel: tuple[int, int] = (96, 128),
    camera: tuple[int, int] = (125, 167),
    degrees: float = 1.5,
    mirrored: bool = False,
    tilt: float = 0.0,
) -> CaptureSet:
    """Captures by an unregistered camera whose homography is known exactly."""
    distance = 15 if panel[0] > 100 else 10
    path = bench_file(folder, *defects, width=panel[1], height=panel[0], distance_mm=distance)
    matrix = homography(panel, camera, degrees, mirrored, tilt)
    text = path.read_text()
    for old, new in (
        ("registered = true", f"registered = false\nhomography = {matrix.tolist()}"),
        (
            f"[camera]\nwidth = {panel[1]}\nheight = {panel[0]}",
            f"[camera]\nwidth = {camera[1]}\nheight = {camera[0]}",
        ),
        ("pixel_um = 8", f"pixel_um = {PIXEL_UM}"),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    path.write_text(text)
    acquire_from(str(path), folder / "captures", patterns=5)
    return read_captures(folder / "captures")


def moved(captures: CaptureSet, dx: float, dy: float) -> CaptureSet:
    """The same captures with a stated homography that looks (dx, dy) panel pixels beside the true one."""
    path = captures.folder / "bench.toml"
    matrix = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]]) @ np.array(captures.bench.camera.homography)
    text, count = re.subn(r"homography = .*", f"homography = {matrix.tolist()}", path.read_text())
    assert count == 1
    path.write_text(text)
    return read_captures(captures.folder)


def diagnosed(captures: CaptureSet, *names: str) -> Diagnosis:
    """A diagnosis with these effects alone, to be quick."""
    known = {n: e for n, e in catalogue().items() if n in names}
    with open_pool(1) as pool:
        return diagnose(captures, Model(captures.bench), known, pool, thorough=False)


@pytest.mark.parametrize(
    ("camera", "options"),
    [
        ((167, 209), {}),
        ((167, 209), {"mirrored": True, "tilt": 1e-4}),
        ((167, 209), {"degrees": 92.0}),
        ((250, 300), {}),  # looks more than 30 panel pixels past the picture on every side
    ],
    ids=["turned a little", "mirrored, in perspective", "turned a quarter", "much larger"],
)
def test_a_right_homography_ends_at_the_cameras_noise(
    camera: tuple[int, int], options: dict[str, Any], tmp_path: Path
) -> None:
    captures = taken(tmp_path, panel=(128, 160), camera=camera, **options)
    found = compare(captures, Model(captures.bench))
    # Measured 2e-5 to 6e-5, as with a registered camera of this bench.
    assert abs(found.errors.excess) < 8e-5
    assert abs(found.errors.nrmse / found.errors.noise_nrmse - 1) < 0.04


def test_a_small_panel_ends_where_a_registered_one_does(tmp_path: Path) -> None:
    # The panel's own border costs 1.1e-4 at this size and distance with a registered camera too.
    captures = taken(tmp_path)
    assert compare(captures, Model(captures.bench)).errors.excess < 1.6e-4


@pytest.mark.parametrize(
    ("options", "dx", "dy"),
    [
        pytest.param({}, 0.3, 0.0, marks=pytest.mark.slow),
        ({"mirrored": True}, 0.2, -0.2),
        pytest.param({"mirrored": True}, 3.0, 2.0, marks=pytest.mark.slow),
        ({"degrees": 92.0}, 6.0, -5.0),
    ],
    ids=["0.3 px", "0.3 px, mirrored", "4 px, mirrored", "8 px, turned a quarter"],
)
def test_a_wrong_homography_is_found_as_misregistration(
    options: dict[str, Any], dx: float, dy: float, tmp_path: Path
) -> None:
    captures = taken(tmp_path, **options)
    true = np.array(captures.bench.camera.homography)
    captures = moved(captures, dx, dy)
    assert compare(captures, Model(captures.bench)).errors.excess > 0.1
    found = diagnosed(captures, "misregistration", "panel_wavefront", "ghost", "sensor_blur")
    assert found.best is not None
    assert found.best.effect.name == "misregistration"
    assert found.best.held_out.excess < 1.6e-4
    # In camera pixels: where a pixel looks is where the homography puts the pixel so much further on.
    values = found.best.model.present[0].values
    steps = np.linalg.inv(true[:2, :2]) @ (-dx, -dy)
    assert (values["shift_x"], values["shift_y"]) == pytest.approx(tuple(steps), abs=2e-3)
    assert values["rotation"] == pytest.approx(0, abs=0.05)
    assert values["magnification"] == pytest.approx(0, abs=0.01)


def test_a_ghost_is_found_where_it_is_on_the_panel(tmp_path: Path) -> None:
    captures = taken(tmp_path, 'kind = "ghost"\nshift_x_px = 9.4\nshift_y_px = -5.7', mirrored=True)
    found = diagnosed(captures, "ghost", "misregistration", "stray_light")
    assert found.best is not None
    assert found.best.effect.name == "ghost"
    values = found.best.model.present[0].values
    assert (values["shift_x"], values["shift_y"]) == pytest.approx((9.4, -5.7), abs=0.01)


def test_pixels_far_past_the_picture_say_nothing(tmp_path: Path) -> None:
    captures = taken(tmp_path, camera=(220, 260))
    view = in_view(captures.bench)
    assert view is not None
    assert not view[0].any()
    assert view[110, 130]
    assert 0.5 < view.mean() < 0.95
    nowhere = moved(captures, 500, 0)
    with pytest.raises(InputError, match="no pixel of the camera on the panel"):
        compare(nowhere, Model(nowhere.bench))
