"""An emulated OAK camera at the level of its link's bytes."""

from .model import OakModel, pack_raw10

__all__ = ["OakModel", "pack_raw10"]
