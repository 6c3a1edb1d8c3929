"""How many processes memory is there for, at the size of a bench."""

from __future__ import annotations

from pathlib import Path

from firmware_iface.errors import InputError
from runtime.lightpath.grid import grid_for
from runtime.program.memory import available_bytes
from runtime.program.threads import cores
from trainer.captures.bench_file import Bench, read_bench

# What a process holds at most: by itself, and for each sample of the padded panel, while it tries a wider iris, a broad
# laser line or an extended source. Measured: 7 GB at 1200 x 1920 pixels, 200 mm and 780 nm, of 3168 x 3872 samples.
OWN_BYTES, SAMPLE_BYTES = 400 * 2**20, 560


def processes_for(folder: Path) -> int:
    """One process a core, or as many as memory is there for, for captures in a folder with their bench.toml."""
    free = available_bytes()
    if free is None:
        return cores()
    try:
        bench = read_bench(folder / "bench.toml")
    except InputError:  # said where the captures are read
        return cores()
    return min(cores(), max(1, free // process_bytes(bench)))


def process_bytes(bench: Bench) -> int:
    """Memory that a process takes at most while it tries effects on captures of a bench."""
    longest = max(channel.wavelength for channel in bench.channels)
    half_width, distance = bench.iris.half_width, 1e-3 * bench.distance_mm
    grid = grid_for(bench.panel.shape, bench.panel.pitch, longest, distance, half_width)
    return OWN_BYTES + SAMPLE_BYTES * grid.padded[0] * grid.padded[1]
