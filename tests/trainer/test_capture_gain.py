"""The light of each capture, measured from the capture itself where the laser drifts."""

from __future__ import annotations

import numpy as np
import torch

from tests.trainer.test_effects import gray, predicted, present, scene_of
from trainer.model.model_stages import stages_for
from trainer.prediction.camera_light import counts, light_on_camera
from trainer.prediction.predict import trace


def test_laser_drift_is_a_switch_and_the_gain_is_measured() -> None:
    drift = present("laser_drift", spread=3.0)
    scene = scene_of(drift)
    truth = predicted(scene, stages_for(scene, ()))
    measured = truth * torch.tensor([1.1, 0.9], dtype=torch.float64)[:, None, None]
    weight = torch.ones_like(truth)
    own = predicted(scene, stages_for(scene, (drift,)), (measured, weight))
    torch.testing.assert_close(own, measured)
    held = predicted(scene, stages_for(scene, (present("laser_drift", spread=0.0),)), (measured, weight))
    torch.testing.assert_close(held, truth)


def test_the_drifting_gain_is_one_of_light_where_counts_are_not_proportional_to_it() -> None:
    bent = present("sensor_response", bend=np.array([-0.9, 0.2]), order=2)
    scene = scene_of(bent)
    light = light_on_camera(scene, stages_for(scene, ()), trace(scene, stages_for(scene, ()), gray()).image)
    brightness = torch.full((2, 1, 1), 400.0, dtype=torch.float64)
    drifting = brightness * torch.tensor([1.3, 0.6], dtype=torch.float64)[:, None, None]
    truth = counts(scene, stages_for(scene, (bent,)), light, drifting, None)
    both = stages_for(scene, (present("laser_drift", spread=3.0), bent))
    found = counts(scene, both, light, brightness, (truth, torch.ones_like(truth)))
    torch.testing.assert_close(found, truth, rtol=1e-4, atol=1e-4)
