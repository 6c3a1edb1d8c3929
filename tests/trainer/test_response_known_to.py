"""A bent response of the camera is known up to the brightest light that it was fitted to, and then goes straight on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from tests.trainer.hidden import bench_file
from tests.trainer.test_effects import present, scene_of
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import Batch, load
from trainer.captures.capture_set import read_captures
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import Predictor, excess_on
from trainer.model.model import Model, absent
from trainer.model.model_file import read_model, write_model
from trainer.model.model_stages import stages_for
from trainer.prediction.stages import Sensor

BEND = np.array([-0.8, -2.0])


def sensor(known_to: float | None = None) -> Sensor:
    bent = present("sensor_response", bend=BEND, order=2)
    return replace(stages_for(scene_of(bent), (bent,)).sensor, response_known_to=known_to)


def counts(camera: Sensor, *shares: float) -> np.ndarray:
    light = torch.tensor(shares, dtype=torch.float64) * camera.full_scale
    return (camera.responded(light) / camera.full_scale).numpy()


def test_what_is_known_stays_as_it_is_and_the_rest_goes_on_as_the_last_fifth_does() -> None:
    whole, known = sensor(), sensor(0.4)
    inside = np.linspace(-0.05, 0.4, 40)
    np.testing.assert_allclose(counts(known, *inside), counts(whole, *inside), rtol=1e-12)
    first, last = counts(whole, 0.32, 0.4)
    np.testing.assert_allclose(
        counts(known, 0.5, 2.4), [last + (last - first) / 0.08 * further for further in (0.1, 2.0)], rtol=1e-9
    )


def test_more_light_never_gives_fewer_counts() -> None:
    whole, known = sensor(), sensor(0.5)
    falling = counts(whole, 0.4, 0.5)
    assert falling[1] < falling[0]
    assert counts(known, 0.9) == pytest.approx(falling[1])


def knee(share: torch.Tensor) -> torch.Tensor:
    """Pixels that fill up: counts of light, both as shares of full scale."""
    return share / (1 + (share / 0.4) ** 2) ** 0.5


def test_light_that_is_brighter_than_any_fitted_is_predicted_as_full(tmp_path: Path) -> None:
    acquire_from(str(bench_file(tmp_path)), tmp_path / "set", patterns=4)
    captures = read_captures(tmp_path / "set")
    (seen,) = load(captures, captures.captures)
    ideal = with_gains(captures, Model(captures.bench), captures.captures)
    full = captures.bench.camera.full_scale
    light = Predictor(ideal, seen).predict(ideal) / full

    def at(exposure: float) -> Batch:
        share = exposure * light
        return replace(
            seen,
            signal=knee(share) * full,
            exposure=exposure * seen.exposure,
            mask=torch.ones_like(seen.mask),
        )

    model = Model(captures.bench).having(absent(catalogue()["sensor_response"], captures.bench, 6))
    found = fit(model, model.names, [at(0.8)], iterations=30).model
    without = replace(found, response_known_to=None)
    assert found.response_known_to is not None
    assert excess_on(found, [at(0.8)]) == pytest.approx(excess_on(without, [at(0.8)]), abs=1e-9)
    # The noise that is expected, of which these counts have none, makes an excess of about -0.001.
    for exposure, least in ((1.6, 2e-3), (2.4, 0.03)):
        assert excess_on(found, [at(exposure)]) < 2e-4
        assert excess_on(without, [at(exposure)]) > least


@pytest.mark.parametrize("value", ["0", "-1", "inf", '"far"'])
def test_a_share_that_is_none_is_refused(value: str, tmp_path: Path) -> None:
    write_model(tmp_path / "m.toml", replace(Model(scene_of().bench), response_known_to=0.5))
    text = (tmp_path / "m.toml").read_text(encoding="utf-8")
    assert "known_to = 0.5" in text
    (tmp_path / "m.toml").write_text(text.replace("known_to = 0.5", f"known_to = {value}"), encoding="utf-8")
    with pytest.raises(InputError, match=r"camera_response.known_to .* above 0"):
        read_model(tmp_path / "m.toml", catalogue())
