"""A virtual headset: devices with a simulated bench behind them, whose defects are hidden."""

from firmware_iface.virtual.bench_description import BenchDescription, read_bench
from firmware_iface.virtual.bench_loading import load_bench
from firmware_iface.virtual.defects import CATALOGUE_KINDS, DEFECT_KINDS, Defect, make_defect
from firmware_iface.virtual.named_benches import named_benches
from firmware_iface.virtual.virtual_headset import (
    VirtualCamera,
    VirtualHeadset,
    VirtualLasers,
    VirtualPanel,
    open_headset,
)

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
