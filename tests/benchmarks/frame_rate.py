"""How many pictures in three colours the service's solver makes, by cores, and what more cores would give.

    python -m tests.benchmarks.frame_rate [--shape 1080x1920] [--seconds 20] [--json]

A video that pans over a photograph, a pattern for each of three colours, as the service asks for them: the first
pattern of every picture, for an iris of half the panel's band and an open one. One core of this machine, two, four and
so on, and a GPU where CuPy finds one, have their turns, frame by frame, so that other work slows all of them alike.
Times are medians; the first pictures are left out, of which one starts cold, and at which a GPU's code is compiled.

From the times t(k) = a + b / k of k cores (Amdahl 1967) follow the share that no core adds to, and the rate of more
cores. The latter is what the measured scaling gives, not a measurement: memory that is shared gives less.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import suppress
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.benchmark.measure import DISTANCE, PITCH, WAVELENGTH, picture
from runtime.lightpath import fft
from runtime.lightpath.ideal_path import ideal_path, single
from runtime.program.large_blocks import keep_large_blocks
from runtime.service.frame_solver import PatternSolver
from runtime.solver.array_backend import Backend
from runtime.solver.chosen_backend import backend

COLOURS = ("red", "green", "blue")
IRISES = {"half": 0.5, "open": 1.0}  # half-width, as a share of the panel's band
PAN = (0, 2)  # pixels a frame
LEFT_OUT = 2  # pictures
MORE = (4, 8, 16)  # cores
GPU = "gpu"


def machines() -> dict[int | str, Backend]:
    """What may compute: powers of two of this machine's cores, all of them, and the GPU."""
    counts = sorted({*(2**k for k in range(fft.THREADS.bit_length())), fft.THREADS})
    found: dict[int | str, Backend] = {k: Backend(k) for k in counts}
    with suppress(InputError):  # without CuPy or a GPU
        found[GPU] = backend("cupy")
    return found


def times(shape: tuple[int, int], iris: float, seconds: float) -> dict[int | str, list[float]]:
    """Times (s) of a picture's first patterns by cores, the first pictures left out."""
    path = single(ideal_path(shape, PITCH, WAVELENGTH, DISTANCE * shape[0] / 1080, iris))
    solvers = {
        k: PatternSolver(dict.fromkeys(COLOURS, path), grid="panel", on=b) for k, b in machines().items()
    }
    content = np.stack([picture("astronaut", shape) * light for light in (1.0, 0.7, 0.4)])
    found: dict[int | str, list[float]] = {k: [] for k in solvers}
    end, frame = time.monotonic() + seconds, 0
    while time.monotonic() < end or frame < LEFT_OUT + 2:
        target = np.roll(content, (PAN[0] * frame, PAN[1] * frame), (1, 2))
        for k, solver in solvers.items():
            begun = time.perf_counter()
            next(solver.patterns(target, time.monotonic_ns()))
            if frame >= LEFT_OUT:
                found[k].append(time.perf_counter() - begun)
        frame += 1
    return found


def scaling(medians: dict[int, float]) -> tuple[float, float]:
    """The a and b (s) of a + b / k, by least squares."""
    sides = np.array([[1, 1 / k] for k in medians])
    (a, b), *_ = np.linalg.lstsq(sides, np.array(list(medians.values())), rcond=None)
    return float(a), float(b)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", default="1080x1920")
    parser.add_argument("--seconds", type=float, default=20.0, help="for each iris")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    keep_large_blocks()
    height, width = map(int, args.shape.split("x"))
    rows = []
    for name, iris in IRISES.items():
        found = times((height, width), iris, args.seconds)
        medians = {k: float(np.median(each)) for k, each in found.items()}
        rates = {k: 1 / t for k, t in medians.items()}
        row: dict[str, Any] = {"iris": name, "frames": len(found[1]), "pictures_per_s": rates}
        by_cores = {k: t for k, t in medians.items() if isinstance(k, int)}
        if len(by_cores) > 1:
            a, b = scaling(by_cores)
            row["alone_share"] = max(a, 0.0) / medians[1]
            row["expected_per_s"] = {k: 1 / (max(a, 0.0) + b / k) for k in MORE if k > max(by_cores)}
        rows.append(row)
        if not args.json:
            measured = ", ".join(f"{rate:.2f} with {k}" for k, rate in rates.items())
            print(f"iris {name}: pictures a second, cores: {measured}", flush=True)
            if row.get("expected_per_s"):
                more = ", ".join(f"{rate:.1f} with {k}" for k, rate in row["expected_per_s"].items())
                print(f"    {row['alone_share']:.2f} of one core's time is not shared out; expected: {more}")
    if args.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
