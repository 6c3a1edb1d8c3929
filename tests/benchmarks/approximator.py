"""The compact approximator against the transforms of a solver's iteration, in turns: medians and best, ms.

    python tests/benchmarks/approximator.py [--shape 1080x1920] [--rounds 30] [--json]

One colour, the network that `hololoop-trainer train` makes by default, with weights disturbed so that nothing folds
away. "gradient" is one run of approximator_gradient.onnx: forward, loss, gradients over irradiance and over the
adapters. The transforms are the four of the solver's padded grid (`hololoop-runtime benchmark`).
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np
import safetensors.numpy
import torch

from runtime.benchmark.measure import DISTANCE, IRIS, PITCH, WAVELENGTH
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT
from runtime.lightpath import fft
from runtime.lightpath.grid import grid_for
from runtime.networks.onnx_approximator import Approximator
from trainer.networks.approximator import Approximator as Network
from trainer.networks.approximator import Architecture
from trainer.networks.onnx_files import onnx_files


def approximator(shape: tuple[int, int]) -> Approximator:
    """D for a panel, with light and a target."""
    torch.manual_seed(0)
    network = Network(Architecture("compact", 8, shape, planes=1))
    with torch.no_grad():
        for weights in network.parameters():
            weights += 0.02 * torch.randn_like(weights)
    files = onnx_files(network)
    adapters = safetensors.numpy.load(files[ADAPTERS])
    d = Approximator((1, *shape), files[APPROXIMATOR], files[GRADIENT], adapters)
    rng = np.random.default_rng(0)
    for array in (d.irradiance, d.target):
        array[...] = rng.exponential(size=array.shape)
    return d


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", default="1080x1920")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    height, width = map(int, args.shape.split("x"))
    d = approximator((height, width))
    whole = np.zeros(grid_for((height, width), PITCH, WAVELENGTH, DISTANCE, IRIS).padded, np.complex64)

    def transforms() -> None:
        for forward in (True, False, True, False):
            fft.into(whole, whole, (0, 1), forward, fft.THREADS)

    runs = {"forward": d.correct, "gradient": d.look, "transforms": transforms}
    took: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(args.rounds + 1):  # the first touches memory for the first time
        for name, run in runs.items():
            begun = time.perf_counter()
            run()
            if number:
                took[name].append(1e3 * (time.perf_counter() - begun))
    found = {
        n: {"median_ms": round(statistics.median(t), 1), "best_ms": round(min(t), 1)} for n, t in took.items()
    }
    if args.json:
        print(json.dumps(found))
        return
    for name, row in found.items():
        print(f"{name:<12} median {row['median_ms']:>7} ms   best {row['best_ms']:>7} ms")


if __name__ == "__main__":
    main()
