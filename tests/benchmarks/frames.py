"""Several patterns for one picture: PSNR against their number, next to patterns apart and to the published method.

    python tests/benchmarks/frames.py [--shape 120x160] [--iterations 100] [--json] [NAME ...]

8 um, 520 nm, an iris of half the panel's band, the pictures of `hololoop-runtime benchmark`; 1, 2, 4 and 8 patterns a
picture, on a panel of 256 levels and on one of 16. All have the same number of iterations of each pattern.

    together   `solve --frames N`: solved for together, the levels in the loop where there are 16
    rounded    the same without levels in the loop: rounded at the end
    apart      N patterns, each solved on its own from its own start, as they are averaged in the eye
    published  time-multiplexed neural holography (Choi et al. 2022) as published, in torch: all frames from random
               phases, Adam of rate 0.02, each phase through Gumbel-softmax to the panel's levels with the published
               temperatures (5.5 to 2) and score; amplitude of the mean irradiance, its scale in closed form
    tuned      the same from this solver's starts, with the best rate found, 0.1

At 256 levels, `published` and `tuned` round at the end: a softmax over 256 levels a pixel is what nobody runs. The
light path of both is torch's, padded to twice the size. All are judged by what `solve` reports: the mean of the
irradiances of the gray levels, on a grid twice as fine as the panel's.

References: S. Choi, M. Gopakumar, Y. Peng, J. Kim, M. O'Toole and G. Wetzstein 2022, eq. 5 to 8.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from runtime.benchmark.measure import DISTANCE, IRIS, PICTURES, PITCH, WAVELENGTH, picture
from runtime.lightpath.ideal_path import ideal_path, single
from runtime.lightpath.light_path import LightPath
from runtime.solver import DriveRange, Solver, quality, shown

FRAMES, LEVELS = (1, 2, 4, 8), (256, 16)
NOISE = 0.5  # rad, of the starts of `apart` and `tuned`
TAUS, BOOST = (5.5, 2.0), 300.0  # temperatures from the first iteration to the last, and the score's factor
Grays = np.ndarray


def path_of(shape: tuple[int, int], levels: int) -> LightPath:
    """A perfect panel of some levels; a small panel is nearer, so that light spreads over the same share of it."""
    path = single(ideal_path(shape, PITCH, WAVELENGTH, DISTANCE * shape[0] / 1080, IRIS))
    return replace(path, response=path.response[:: 256 // levels])


def starts(path: LightPath, target: np.ndarray, frames: int) -> np.ndarray:
    """Double phase with noise, [N, H, W]."""
    first = Solver(path).solve(target, 0).phase
    noise = np.random.default_rng(1).normal(scale=NOISE, size=(frames, *target.shape))
    noise[0] = 0
    return (first + noise).astype(np.float32)


def together(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> Grays:
    return Solver(path, frames=frames).solve(target, iterations).gray.reshape(frames, *target.shape)


def rounded(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> Grays:
    full = replace(path, response=np.arange(256, dtype=np.float32) * np.float32(2 * math.pi / 256))
    phase = Solver(full, frames=frames).solve(target, iterations).phase.reshape(frames, *target.shape)
    return np.stack([DriveRange(path).gray(p) for p in phase])


def apart(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> Grays:
    solver = Solver(path, grid="fine")
    each = starts(path, target, frames)
    return np.stack([solver.solve(target, iterations, start=s).gray.copy() for s in each])


def published(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> Grays:
    first = np.random.default_rng(1).uniform(-math.pi, math.pi, (frames, *target.shape))
    return _time_multiplexed(path, target, first, iterations, 0.02)


def tuned(path: LightPath, target: np.ndarray, frames: int, iterations: int) -> Grays:
    return _time_multiplexed(path, target, starts(path, target, frames), iterations, 0.1)


def _time_multiplexed(
    path: LightPath, target: np.ndarray, first: np.ndarray, iterations: int, rate: float
) -> Grays:
    """Adam on all frames through Gumbel-softmax quantisation."""
    import torch

    torch.manual_seed(0)
    height, width = target.shape
    distance = DISTANCE * height / 1080
    fy = torch.fft.fftfreq(2 * height, PITCH)[:, None].double()
    fx = torch.fft.fftfreq(2 * width, PITCH)[None, :].double()
    root = torch.sqrt(torch.clamp(1 / WAVELENGTH**2 - fy**2 - fx**2, min=0)) - 1 / WAVELENGTH
    edge = IRIS / (2 * PITCH) * (1 + 1e-9)
    passed = (fy.abs() <= edge) & (fx.abs() <= edge)
    transfer = torch.polar(torch.ones_like(root), 2 * math.pi * distance * root) * passed
    transfer = (transfer * torch.sinc(fy * PITCH) * torch.sinc(fx * PITCH)).to(torch.complex64)
    wanted = torch.tensor(np.sqrt(target / target.mean()))
    levels = torch.tensor(np.asarray(path.response))
    few = len(levels) < 256
    phase = torch.tensor(first, dtype=torch.float32, requires_grad=True)
    optimizer = torch.optim.Adam([phase], lr=rate)

    def quantised(tau: float) -> Any:
        """The sum of the levels with Gumbel-softmax weights, hard forward and soft backward."""
        apart = torch.remainder(phase[..., None] - levels + math.pi, 2 * math.pi) - math.pi
        gate = torch.sigmoid(TAUS[0] / tau * apart / math.pi)
        score = 4 * gate * (1 - gate) * BOOST * TAUS[0] / tau
        weights = torch.nn.functional.gumbel_softmax(score, tau=tau, hard=True)
        return weights @ levels

    for iteration in range(iterations):
        optimizer.zero_grad()
        tau = TAUS[0] * (TAUS[1] / TAUS[0]) ** (iteration / iterations)
        u = quantised(tau) if few else phase
        field = torch.nn.functional.pad(torch.polar(torch.ones_like(u), u), (0, width, 0, height))
        light = torch.fft.ifft2(torch.fft.fft2(field) * transfer)[:, :height, :width].abs().square()
        seen = (light.mean(0) + 1e-8).sqrt()
        scale = ((seen * wanted).sum() / seen.square().sum()).detach()
        torch.nn.functional.mse_loss(scale * seen, wanted).backward()
        optimizer.step()
    found = phase.detach().numpy()
    return np.stack([DriveRange(path).gray(p) for p in found])


NAMES: dict[str, Callable[[LightPath, np.ndarray, int, int], Grays]] = {
    f.__name__: f for f in (together, rounded, apart, published, tuned)
}


def judged(path: LightPath, gray: Grays, target: np.ndarray) -> float:
    """Amplitude PSNR (dB) of the mean of the patterns' irradiances."""
    return quality(np.mean([shown(path, g) for g in gray], axis=0), target).psnr_db


def main() -> None:
    """Run what is named, or all, and print the mean over the pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(NAMES), metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--shape", default="120x160")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    height, width = map(int, args.shape.split("x"))
    targets = [picture(name, (height, width)) for name in PICTURES]
    rows = []
    for levels in LEVELS:
        path = path_of((height, width), levels)
        for name in args.names:
            for frames in FRAMES:
                begun = time.perf_counter()
                found = [NAMES[name](path, t, frames, args.iterations) for t in targets]
                seconds = (time.perf_counter() - begun) / len(targets)
                psnr = [judged(path, g, t) for g, t in zip(found, targets, strict=True)]
                row = {
                    "levels": levels, "name": name, "frames": frames,
                    "psnr_db": round(float(np.mean(psnr)), 2), "seconds": round(seconds, 2),
                }  # fmt: skip
                rows.append(row)
                if not args.json:
                    print(
                        f"{levels:>3} levels  {name:<10} N = {frames}  {row['psnr_db']:>6.2f} dB  {seconds:>6.1f} s",
                        flush=True,
                    )
    if args.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
