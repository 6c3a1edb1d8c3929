"""What has no name is learned at the stage that the probes name, and is a part of the model from then on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import InputError
from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.diagnosis import Diagnosis, diagnose
from trainer.diagnosis.error_budget import error_budget
from trainer.diagnosis.learned_rest import LearnedRest, learn_rest
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import evaluate_captures
from trainer.model.bundle_export import acting_on_display
from trainer.model.model import Model
from trainer.model.model_file import read_model, write_model

FRINGES = 'kind = "fringes"\ncontrast = 0.22\nperiod_px = 17\nangle_deg = 33\nchirp = 0.0'


def learned(
    folder: Path, defect: str, *names: str, thresholds: Thresholds | None = None
) -> tuple[CaptureSet, Diagnosis, LearnedRest]:
    """A bench's captures, diagnosed with these effects alone, and what is learned of the rest."""
    acquire_from(str(bench_file(folder, defect)), folder / "captures", patterns=8)
    captures = read_captures(folder / "captures")
    known = {name: catalogue()[name] for name in names}
    with open_pool(1) as pool:
        found = diagnose(captures, Model(captures.bench), known, pool, thresholds)
        assert found.verdict == "outside_catalogue"
        return captures, found, learn_rest(capture_roles(captures), found.model, found, pool)


def test_fringes_are_learned_at_the_sensor_and_stay_off_the_headset(tmp_path: Path) -> None:
    # One stage is enough here: the second test goes on as far as it gets.
    enough = Thresholds(complete_share=0.05)
    captures, found, rest = learned(tmp_path, FRINGES, "crosstalk", thresholds=enough)
    assert rest.steps[0][0] == found.stage == "sensor"
    assert rest.steps[-1][1].excess < 0.05 * found.held_out.excess
    assert "Learned at the sensor" in rest.sentence
    assert rest.model.history[-1]["added"].startswith("learned_")

    budget = error_budget(captures, rest.model)
    assert abs(budget.named_physics) < 1e-9 and budget.network > 0.9 * found.held_out.excess

    write_model(tmp_path / "model.toml", rest.model)
    again = read_model(tmp_path / "model.toml", catalogue())
    held_out = capture_roles(captures).held_out
    np.testing.assert_allclose(
        evaluate_captures(captures, held_out, again).excess, rest.steps[-1][1].excess, rtol=1e-3
    )
    assert "sensor" not in acting_on_display(again).learned

    text = (tmp_path / "model.toml").read_text()
    (tmp_path / "broken.toml").write_text(text.replace('"learned.sensor.gain"', '"learned.sensor.bend"'))
    with pytest.raises(InputError, match="learned.sensor.gain is not an array of"):
        read_model(tmp_path / "broken.toml", catalogue())


def test_an_aberration_without_a_name_is_learned_at_the_pupil_and_goes_to_the_headset(tmp_path: Path) -> None:
    _, found, rest = learned(tmp_path, 'kind = "pupil_aberration"', "crosstalk")
    assert rest.steps[0][0] == "pupil"
    assert rest.steps[-1][1].excess < 0.2 * found.held_out.excess
    assert "pupil" in acting_on_display(rest.model).learned
    assert rest.at_floor == ("too little to explain" in rest.sentence)
