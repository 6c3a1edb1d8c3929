"""An iris that is open much farther than bench.toml says: the model gets room for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trainer.hidden import captured, ran, with_few_effects, without_probes
from tests.trainer.test_effects import bench, present
from trainer.model.model import Model
from trainer.model.model_stages import scene_for


def test_the_band_has_room_for_an_iris_wherever_it_is() -> None:
    stated = bench().iris.half_width
    for half, centre in ((stated, 0.0), (1.4 * stated, 0.0), (stated, 0.5), (0.5 * stated, 0.3), (1.9, 0.0)):
        model = Model(bench(), (present("iris", half_width=half, centre_x=centre),))
        share = scene_for(model, "green", 9.0).grid.band_share
        assert share >= min(half + centre, 1.9)
        assert share < 1.5 * max(half + centre, stated) + 0.1


def test_an_iris_that_is_open_nearly_twice_as_far_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with_few_effects(monkeypatch, "iris", "sensor_blur", "spatial_coherence", "laser_drift")
    without_probes(monkeypatch)
    captures = captured(
        capsys,
        tmp_path,
        'kind = "iris"\nhalf_width = 0.87\ncentre_x_share = 0.05',
        options=("--patterns", 4),
        iris=("square", 0.5),
    )
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "iris"]
    assert found["verdict"] == "complete"
    parameters = found["effects"][0]["parameters"]
    assert parameters["half_width_share"]["value"] == pytest.approx(0.87, abs=0.01)
    assert parameters["centre_x_share"]["value"] == pytest.approx(0.05, abs=0.01)
