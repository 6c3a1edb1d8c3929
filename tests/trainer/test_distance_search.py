"""The search for the distance at which captures fit their patterns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.trainer.hidden import LARGER, bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.conventions import Sample
from trainer.captures.distance_search import best_distance
from trainer.captures.held_out import capture_roles
from trainer.effects.evidence import Evidence
from trainer.effects.starts import distance_starts
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model
from trainer.prediction.predict import bare_irradiance
from trainer.prediction.scene import scene_at

UNIT_MM = 1e3 * 8e-6**2 / 520e-9
WEAK_RESPONSE = 'kind = "phase_response"\ngain = 0.6'


def captured(folder: Path, *defects: str, **sizes: Any) -> CaptureSet:
    bench = bench_file(folder, *defects, **{**LARGER, **sizes})
    acquire_from(str(bench), folder / "captures", patterns=4, seed=1)
    return read_captures(folder / "captures")


def searched(captures: CaptureSet) -> tuple[float, float, list[float]]:
    """The distance found, the correlation there, and every distance at which a prediction was made.

    No prediction takes a grid of more than four times the panel's sides.
    """
    (batch,) = load(captures, captures.captures[:2])
    samples = [
        Sample(i, g.numpy().astype(np.uint8), s.numpy(), m.numpy() > 0, batch.channel, batch.plane_mm)
        for i, g, s, m in zip(batch.ids, batch.gray, batch.signal, batch.mask, strict=True)
    ]
    asked = []

    def predict(bench: Bench, gray: np.ndarray, channel: str, plane_mm: float) -> np.ndarray:
        asked.append(plane_mm)
        scene = scene_at(bench, channel, plane_mm, "angular_spectrum", 1.0, torch.float32)
        assert max(scene.grid.padded) < 4 * max(scene.grid.shape)
        return bare_irradiance(scene, gray)

    found = best_distance(captures.bench, samples, predict)
    assert found is not None
    return found.distance_mm, found.correlation, asked


@pytest.mark.parametrize("offset_mm", [0.0, 0.5, 6.0, -8.0])
def test_the_distance_is_found_within_the_depth_of_focus(tmp_path: Path, offset_mm: float) -> None:
    distance_mm, correlation, _ = searched(captured(tmp_path, f'kind = "distance"\noffset_mm = {offset_mm}'))
    assert distance_mm == pytest.approx(15 + offset_mm, abs=2 * UNIT_MM)
    assert correlation > 0.8


def test_far_away_coarse_pictures_are_searched_near_the_stated_distance_first(tmp_path: Path) -> None:
    far = 'kind = "distance"\noffset_mm = 7.0'
    shown = {"width": 256, "height": 192, "distance_mm": 60}
    distance_mm, correlation, asked = searched(captured(tmp_path, far, WEAK_RESPONSE, **shown))
    assert distance_mm == pytest.approx(67, abs=4 * UNIT_MM)
    assert correlation < 0.5
    assert len(asked) < 70  # a search of fine pictures takes 80 to 146
    assert max(asked) < 2.5 * 60


def test_where_strong_faults_hide_the_picture_the_search_stays_near_the_right_distance(
    tmp_path: Path,
) -> None:
    distance_mm, correlation, asked = searched(captured(tmp_path, WEAK_RESPONSE))
    assert distance_mm == pytest.approx(15, abs=4 * UNIT_MM)
    assert correlation < 0.5  # they do hide it
    assert max(abs(d - 15) for d in asked) < 25 * UNIT_MM


def test_nothing_is_searched_for_a_model_that_explains_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searches: list[Sequence[Any]] = []

    def noted(*given: Any, **options: Any) -> None:
        searches.append(given)

    monkeypatch.setattr("trainer.effects.starts.best_distance", noted)
    for name, offset_mm in (("in focus", 0.0), ("out of focus", 0.5)):
        folder = tmp_path / name
        folder.mkdir()
        captures = captured(folder, f'kind = "distance"\noffset_mm = {offset_mm}')
        roles = capture_roles(captures)
        model = with_gains(captures, Model(captures.bench), roles.fitted)
        (batch,) = load(captures, roles.screened)
        predictor = Predictor(model, batch)
        starts = distance_starts([Evidence(predictor.scene, batch, predictor.predict(model))])
        assert starts == [{"offset": 0.0}]
        assert len(searches) == (offset_mm != 0)
    smoothed = batch.smoothed(4.0)  # of which a model out of focus predicts nearly all
    predictor = Predictor(model, smoothed)
    assert smoothed.errors(predictor.predict(model)).nrmse ** 2 < 0.05
    distance_starts([Evidence(predictor.scene, smoothed, predictor.predict(model))])
    assert len(searches) == 2
