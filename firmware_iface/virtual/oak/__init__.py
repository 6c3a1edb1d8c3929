"""An emulated OAK camera at the level of its link's bytes."""

from firmware_iface.virtual.oak.bench_exposure import expose_bench
from firmware_iface.virtual.oak.oak_messages import pack_raw10
from firmware_iface.virtual.oak.oak_model import OakModel

__all__ = ["OakModel", "expose_bench", "pack_raw10"]
