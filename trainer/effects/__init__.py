"""Named physical effects, and how to define one."""

from trainer.effects.catalogue import Catalogue, catalogue, find_effect
from trainer.effects.definition import STAGES, Effect, Parameter, effect

__all__ = ["STAGES", "Catalogue", "Effect", "Parameter", "catalogue", "effect", "find_effect"]
