"""An emulated OAK camera at the level of its link's bytes."""

from firmware_iface.virtual.oak.bench import looking_at
from firmware_iface.virtual.oak.oak_model import OakModel, pack_raw10

__all__ = ["OakModel", "looking_at", "pack_raw10"]
