"""The benches that `virtual:NAME` names."""

from __future__ import annotations

from dataclasses import replace

from firmware_iface.errors import InputError, nearest
from firmware_iface.virtual.bench_description import (
    BenchDescription,
    ChannelDescription,
    IrisDescription,
    SimulationDescription,
)
from firmware_iface.virtual.defects import CATALOGUE_KINDS, make_defect

_RGB = (
    ChannelDescription("red", 638.0),
    ChannelDescription("green", 520.0),
    ChannelDescription("blue", 450.0),
)


def _benches() -> dict[str, BenchDescription]:
    make = make_defect
    demo = BenchDescription(
        "demo",
        defects=(
            make("zero_order", fill_factor=0.94, surface_amplitude=0.12),
            make("illumination", waist_x_share=1.9, waist_y_share=2.1),
            make("phase_response", gain=1.08, s_curvature=0.12),
        ),
    )
    in_colour = replace(demo, name="colour_demo", channels=_RGB)
    benches = [BenchDescription("ideal"), demo, replace(demo.resized(144, 192, 18.0), name="small_demo")]
    benches += [in_colour, replace(in_colour.resized(144, 192, 18.0), name="small_colour_demo")]
    half_open = replace(in_colour, name="full_size", iris=IrisDescription(half_width=0.5))
    benches += [half_open.resized(1080, 1920, 200.0)]
    benches += [BenchDescription(kind, defects=(make(kind),)) for kind in CATALOGUE_KINDS]
    benches += [
        BenchDescription("pair", defects=(make("phase_response"), make("pupil_aberration"))),
        BenchDescription("triple", defects=(make("crosstalk"), make("illumination"), make("distance"))),
        BenchDescription("colour", channels=_RGB, defects=(make("phase_response"),)),
        BenchDescription(
            "mixed",  # small enough to train a dozen networks on it
            defects=(
                make("zero_order", fill_factor=0.94, surface_amplitude=0.12),
                make("illumination", waist_x_share=1.9, waist_y_share=2.1),
                make("phase_response", gain=1.08, s_curvature=0.12),
                make("stripes", rms=0.1),
                make("fringes", contrast=0.1),
            ),
        ).resized(96, 128, 12.0),
        BenchDescription(
            "planes",
            simulation=SimulationDescription(planes_mm=(24.0, 30.0, 36.0)),
            defects=(make("spatial_coherence"),),
        ),
        BenchDescription("specks", defects=(make("specks"),)),
        BenchDescription("fringes", defects=(make("fringes"),)),
        BenchDescription("stripes", defects=(make("stripes"),)),
        BenchDescription("outside", defects=(make("specks"), make("fringes"))),
        BenchDescription("convention", defects=(make("convention", phase_sign=-1),)),
    ]
    return {b.name: b for b in benches}


def named_benches() -> list[str]:
    """Names that `virtual:NAME` takes."""
    return list(_benches())


def named_bench(name: str) -> BenchDescription:
    """The bench of this name.

    Raises
    ------
    InputError
        For an unknown name; the message suggests the nearest.
    """
    benches = _benches()
    if name not in benches:
        raise InputError(f"there is no virtual bench '{name}'; {nearest(name, benches)}")
    return benches[name]
