"""Named physical effects, and all that an effect of your own needs: `from trainer.effects import Parameter, effect`."""

from trainer.captures.capture_table import Moment
from trainer.effects.definition import STAGES, Effect, Parameter, effect
from trainer.effects.discs import discs
from trainer.effects.effect_catalogue import Catalogue, catalogue, find_effect
from trainer.effects.evidence import Evidence
from trainer.effects.pull import Wave, pull, waves
from trainer.prediction.scene import bare_stages
from trainer.prediction.stages import Drive, Panel, Pupil, Sensor

__all__ = [
    "STAGES",
    "Catalogue",
    "Drive",
    "Effect",
    "Evidence",
    "Moment",
    "Panel",
    "Parameter",
    "Pupil",
    "Sensor",
    "Wave",
    "bare_stages",
    "catalogue",
    "discs",
    "effect",
    "find_effect",
    "pull",
    "waves",
]
