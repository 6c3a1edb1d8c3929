"""How many processes a command uses: --workers and --cluster."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.lightpath.grid import grid_for
from runtime.program.memory import available_bytes
from runtime.program.options import whole
from runtime.program.threads import cores
from trainer.captures.bench_file import Bench, read_bench

# What a process holds at most: by itself, and for each sample of the padded panel, while it tries a wider iris, a broad
# laser line or an extended source. Measured: 7 GB at 1200 x 1920 pixels, 200 mm and 780 nm, of 3168 x 3872 samples.
OWN_BYTES, SAMPLE_BYTES = 400 * 2**20, 560


def worker_options(parser: ArgumentParser, cluster: bool = True) -> None:
    """--workers and --cluster."""
    workers_option(
        parser,
        "processes that fit candidates at the same time (default: one a core, or as many as memory is there for; "
        "1: this process alone)",
    )
    if cluster:
        parser.add_argument(
            "--cluster", metavar="ADDRESS", help="fit on a Dask cluster instead, such as tcp://10.0.0.5:8786"
        )


def workers_option(parser: ArgumentParser, what: str) -> None:
    """--workers."""
    parser.add_argument("--workers", metavar="N", type=whole(1, 4096), default=None, help=what)


def workers_of(args: Namespace) -> int:
    """How many processes to use; with one, this process takes every core.

    Raises
    ------
    InputError
        For several processes, or a cluster, on a GPU.
    """
    on_gpu = getattr(args, "device", "cpu") == "cuda"
    if on_gpu and (args.workers not in (None, 1) or getattr(args, "cluster", None) is not None):
        raise InputError(
            "with --device cuda one process computes on the GPU: leave out --workers and --cluster"
        )
    workers = 1 if on_gpu else int(args.workers or _by_default(getattr(args, "captures", None)))
    if workers == 1:
        use_every_core()
    return workers


def _by_default(folder: Path | None) -> int:
    """One process a core, or as many as memory is there for at the size of the bench whose captures lie in a folder."""
    free = available_bytes()
    if folder is None or free is None:
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


def use_every_core() -> None:
    """Let torch use all of this process's processors: for work that is done in this process."""
    import torch

    torch.set_num_threads(cores())
