"""An emulated OAK camera at the level of its link's bytes."""

from .bench import looking_at
from .model import OakModel, pack_raw10

__all__ = ["OakModel", "looking_at", "pack_raw10"]
