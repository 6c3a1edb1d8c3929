"""Named physical effects, and how to define one."""

from trainer.effects.definition import STAGES, Effect, Parameter, effect
from trainer.effects.effect_catalogue import Catalogue, catalogue, find_effect

__all__ = ["STAGES", "Catalogue", "Effect", "Parameter", "catalogue", "effect", "find_effect"]
