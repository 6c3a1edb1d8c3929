"""A virtual headset: devices with a simulated bench behind them that has hidden defects.

The simulation is in `bench_optics`, `simulated_drive`, `simulated_panel`, `rough_surface`, `iris_opening`,
`simulated_sensor`, `camera_motion` and `subpixel_propagation`. Hidden defects are defined in `defects` and
`further_defects`, and combined to benches in `named_benches`.
`virtual_headset` is opened in Python; `emulated_hardware` answers the real vendor libraries, byte by byte
(`i2c`, `usb`, `oak`). Faults of emulated devices are in `fault_injection`.
"""

from firmware_iface.virtual.bench_description import BenchDescription, read_bench
from firmware_iface.virtual.bench_loading import load_bench
from firmware_iface.virtual.defect_kind import Defect
from firmware_iface.virtual.defects import CATALOGUE_KINDS, DEFECT_KINDS, make_defect
from firmware_iface.virtual.named_benches import named_benches
from firmware_iface.virtual.virtual_devices import VirtualCamera, VirtualLasers, VirtualPanel
from firmware_iface.virtual.virtual_headset import VirtualHeadset, open_headset

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
