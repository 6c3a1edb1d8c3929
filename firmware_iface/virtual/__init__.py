"""A virtual headset: devices with a simulated bench behind them, whose defects are hidden."""

from firmware_iface.virtual.defects import CATALOGUE_KINDS, DEFECT_KINDS, Defect, make_defect
from firmware_iface.virtual.description import BenchDescription, load_bench, read_bench
from firmware_iface.virtual.headset import (
    VirtualCamera,
    VirtualHeadset,
    VirtualLasers,
    VirtualPanel,
    open_headset,
)
from firmware_iface.virtual.named import named_benches

__all__ = [
    "CATALOGUE_KINDS",
    "DEFECT_KINDS",
    "BenchDescription",
    "Defect",
    "VirtualCamera",
    "VirtualHeadset",
    "VirtualLasers",
    "VirtualPanel",
    "load_bench",
    "make_defect",
    "named_benches",
    "open_headset",
    "read_bench",
]
