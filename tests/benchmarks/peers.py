"""The solver against what people use today: the same picture, in turn, each in a process of its own.

    python -m venv bench && bench/bin/pip install torch==2.13.0 -e '.[bench]' -c constraints.txt
    bench/bin/python tests/benchmarks/peers.py [--shape 1080x1920] [--iterations 100] [--json] [NAME ...]

1080 x 1920, 8 um, 520 nm, 200 mm, an iris of half the panel's band, 256 gray levels, scikit-image's astronaut.

    hololoop         this solver, 20 iterations
    hololoop_longer  this solver, 80 iterations
    adam_published   torch, autograd, Adam as neural-holography publishes it (rate 8e-3, learned scale of rate 2e-3),
                     zero-padded to twice the size, from the same double phase
    adam_tuned       the same loop with the best rate and betas found (0.1; 0.9, 0.999), scale in closed form
    adam_random      adam_published from a random phase, as it is published
    odak             odak's own propagation and optimiser settings (Adam, rate 0.1, random phase), with the iris
    torchoptics      its Field, propagated by its angular spectrum; Adam, rate 0.1; it has no iris

slmsuite's Gerchberg-Saxton makes far-field spots and pictures through a lens and has no distance, so it does not
apply here. All are judged by `judge`, which shares no code with any of them: the panel drawn on 2 x 2 sub-pixels,
padded to twice its size, with and without the iris, and the better of the two counts.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PITCH, WAVELENGTH, DISTANCE, IRIS, LEVELS = 8e-6, 520e-9, 0.2, 0.5, 256
Solved = tuple[np.ndarray, float, int]  # phase (rad), seconds, iterations


def target_for(shape: tuple[int, int]) -> np.ndarray:
    """Linear irradiance [H, W]."""
    from runtime.benchmark.measure import picture

    return picture("astronaut", shape)


def distance_for(shape: tuple[int, int]) -> float:
    """Smaller panels are nearer, so that light spreads over the same share of them."""
    return DISTANCE * shape[0] / 1080


def double_phase(target: np.ndarray, distance: float) -> np.ndarray:
    """The start that all who take one begin from."""
    from runtime.lightpath.ideal_path import ideal_path, single
    from runtime.solver import solve

    path = single(ideal_path(target.shape, PITCH, WAVELENGTH, distance, IRIS))
    return solve(path, target, 0).phase.copy()


def hololoop(target: np.ndarray, distance: float, iterations: int, most: int = 20) -> Solved:
    from runtime.lightpath.ideal_path import ideal_path, single
    from runtime.solver import Solver

    solver = Solver(single(ideal_path(target.shape, PITCH, WAVELENGTH, distance, IRIS)))
    solver.rehearse(target)
    solution = solver.solve(target, min(iterations, most))
    return solution.phase, solution.milliseconds / 1e3, solution.iterations


def hololoop_longer(target: np.ndarray, distance: float, iterations: int) -> Solved:
    return hololoop(target, distance, iterations, 80)


def _torch_adam(
    target: np.ndarray,
    start: np.ndarray,
    distance: float,
    iterations: int,
    rate: float,
    betas: tuple[float, float],
    learned: bool,
) -> Solved:
    """Phase retrieval as it is usually written in torch: padded to twice the size, gradients by autograd."""
    import torch

    height, width = target.shape
    fy = torch.fft.fftfreq(2 * height, PITCH)[:, None].double()
    fx = torch.fft.fftfreq(2 * width, PITCH)[None, :].double()
    root = torch.sqrt(torch.clamp(1 / WAVELENGTH**2 - fy**2 - fx**2, min=0)) - 1 / WAVELENGTH
    edge = IRIS / (2 * PITCH)
    passed = (fy.abs() <= edge) & (fx.abs() <= edge)
    transfer = (torch.polar(torch.ones_like(root), 2 * math.pi * distance * root) * passed).to(
        torch.complex64
    )
    amplitude = torch.tensor(np.sqrt(target))
    amplitude = amplitude / amplitude.square().mean().sqrt()
    phase = torch.tensor(start, dtype=torch.float32, requires_grad=True)

    def amplitude_seen() -> Any:
        field = torch.nn.functional.pad(torch.polar(torch.ones_like(phase), phase), (0, width, 0, height))
        return torch.fft.ifft2(torch.fft.fft2(field) * transfer)[:height, :width].abs()

    def best_scale(seen: Any) -> Any:
        return ((seen * amplitude).sum() / seen.square().sum()).detach()

    scale = best_scale(amplitude_seen()).requires_grad_(
        learned
    )  # learned from its best value at the start on
    parameters: list[dict[str, Any]] = [{"params": [phase], "lr": rate, "betas": betas}]
    if learned:
        parameters.append({"params": [scale], "lr": 2e-3})
    optimizer = torch.optim.Adam(parameters)

    def once() -> None:
        optimizer.zero_grad()
        seen = amplitude_seen()
        s = scale if learned else best_scale(seen)
        torch.nn.functional.mse_loss(s * seen, amplitude).backward()
        optimizer.step()

    begun = time.perf_counter()
    for _ in range(iterations):
        once()
    return phase.detach().numpy(), time.perf_counter() - begun, iterations


def adam_published(target: np.ndarray, distance: float, iterations: int) -> Solved:
    return _torch_adam(target, double_phase(target, distance), distance, iterations, 8e-3, (0.9, 0.999), True)


def adam_tuned(target: np.ndarray, distance: float, iterations: int) -> Solved:
    return _torch_adam(target, double_phase(target, distance), distance, iterations, 0.1, (0.9, 0.999), False)


def adam_random(target: np.ndarray, distance: float, iterations: int) -> Solved:
    start = np.random.default_rng(0).uniform(-np.pi, np.pi, target.shape)
    return _torch_adam(target, start, distance, iterations, 8e-3, (0.9, 0.999), True)


def odak(target: np.ndarray, distance: float, iterations: int) -> Solved:
    """odak.learn.wave.stochastic_gradient_descent with the iris that its propagation takes and it does not pass on."""
    import torch
    from odak.learn.wave import calculate_amplitude, generate_complex_field, propagate_beam, wavenumber

    torch.manual_seed(0)
    height, width = target.shape
    fy, fx = torch.linspace(-1, 1, 2 * height)[:, None], torch.linspace(-1, 1, 2 * width)[None, :]
    iris = ((fy.abs() <= IRIS) & (fx.abs() <= IRIS)).float()
    wanted = torch.tensor(target / target.max())
    phase = torch.randn_like(wanted, requires_grad=True)
    optimizer = torch.optim.Adam([phase], lr=0.1)
    begun = time.perf_counter()
    for _ in range(iterations):
        optimizer.zero_grad()
        seen = propagate_beam(
            generate_complex_field(1.0, phase), wavenumber(WAVELENGTH), distance, PITCH, WAVELENGTH,
            "Bandlimited Angular Spectrum", zero_padding=[True, False, True], aperture=iris,
        )  # fmt: skip
        torch.nn.functional.mse_loss(calculate_amplitude(seen) ** 2, wanted).backward()
        optimizer.step()
    return phase.detach().numpy(), time.perf_counter() - begun, iterations


def torchoptics(target: np.ndarray, distance: float, iterations: int) -> Solved:
    import torch
    from torchoptics import Field

    torch.manual_seed(0)
    amplitude = torch.tensor(np.sqrt(target), dtype=torch.double)
    amplitude = amplitude / amplitude.square().mean().sqrt()
    phase = torch.zeros_like(amplitude, requires_grad=True)
    optimizer = torch.optim.Adam([phase], lr=0.1)
    begun = time.perf_counter()
    for _ in range(iterations):
        optimizer.zero_grad()
        field = Field(torch.exp(1j * phase), WAVELENGTH, spacing=PITCH)
        seen = field.propagate_to_z(distance, propagation_method="ASM").intensity().sqrt()
        scale = ((seen * amplitude).sum() / seen.square().sum()).detach()
        torch.nn.functional.mse_loss(scale * seen, amplitude).backward()
        optimizer.step()
    return phase.detach().numpy(), time.perf_counter() - begun, iterations


PEERS: dict[str, Callable[[np.ndarray, float, int], Solved]] = {
    f.__name__: f
    for f in (hololoop, hololoop_longer, adam_published, adam_tuned, adam_random, odak, torchoptics)
}


def judge(phase: np.ndarray, target: np.ndarray, distance: float, iris: bool) -> float:
    """Amplitude PSNR (dB) of what pixels integrate of a pattern's light, after rounding to gray levels."""
    from scipy import fft

    gray = np.rint(phase * LEVELS / (2 * np.pi)) % LEVELS
    height, width = target.shape
    field = np.zeros((4 * height, 4 * width), np.complex64)
    field[: 2 * height, : 2 * width] = np.kron(np.exp(2j * np.pi * gray / LEVELS), np.ones((2, 2)))
    fy = fft.fftfreq(4 * height, PITCH / 2)[:, None]
    fx = fft.fftfreq(4 * width, PITCH / 2)[None, :]
    square = (np.sinc(fy * PITCH / 2) * np.sinc(fx * PITCH / 2)).astype(np.float32)
    edge = (IRIS if iris else 1) / (2 * PITCH) * (1 + 1e-9)
    turns = distance * (np.sqrt(np.maximum(1 / WAVELENGTH**2 - fy**2 - fx**2, 0)) - 1 / WAVELENGTH)
    transfer = np.exp(2j * np.pi * turns).astype(np.complex64) * square
    transfer *= (np.abs(fy) <= edge) & (np.abs(fx) <= edge)
    field = fft.fft2(field, overwrite_x=True, workers=2)
    field *= transfer
    light = np.abs(fft.ifft2(field, overwrite_x=True, workers=2)) ** 2
    light = fft.ifft2(fft.fft2(light, workers=2) * square, workers=2).real[: 2 * height, : 2 * width]
    seen = np.sqrt(np.maximum(light.reshape(height, 2, width, 2).mean((1, 3)), 0)).astype(float)
    wanted = np.sqrt(target.astype(float))
    error = seen * (np.vdot(seen, wanted) / np.vdot(seen, seen)) - wanted
    return float(20 * np.log10(wanted.max() / np.sqrt(np.mean(error**2))))


def run_one(name: str, shape: tuple[int, int], iterations: int, out: Path) -> None:
    """In the child: solve, and leave phase and times in a file."""
    phase, seconds, done = PEERS[name](target_for(shape), distance_for(shape), iterations)
    np.savez(out, phase=phase, seconds=seconds, iterations=done)


def main() -> None:
    """Run the peers that are named, or all, and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(PEERS), metavar="NAME", help=", ".join(PEERS))
    parser.add_argument("--shape", default="1080x1920")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    height, width = map(int, args.shape.split("x"))
    shape = (height, width)
    if args.child:
        run_one(args.names[0], shape, args.iterations, args.child)
        return
    target, rows = target_for(shape), []
    for name in args.names:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder, "solved.npz")
            command = [sys.executable, str(Path(__file__).resolve()), name, "--shape", args.shape]
            command += ["--child", str(out), "--iterations", str(args.iterations)]
            # In a folder of its own: odak leaves a log where it runs.
            done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
            if done.returncode:
                print(f"{name}: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
                continue
            solved = np.load(out)
            seen = [judge(solved["phase"], target, distance_for(shape), iris) for iris in (True, False)]
            seconds, count = float(solved["seconds"]), int(solved["iterations"])
            rows.append(
                {
                    "name": name, "iterations": count, "seconds": round(seconds, 3),
                    "ms_per_iteration": round(1e3 * seconds / max(count, 1), 1), "psnr_db": round(max(seen), 2),
                }
            )  # fmt: skip
        if not args.json:
            row = rows[-1]
            print(
                f"{name:<16} {row['iterations']:>4} iterations  {row['seconds']:>8.2f} s  "
                f"{row['ms_per_iteration']:>7.1f} ms each  {row['psnr_db']:>6.2f} dB",
                flush=True,
            )
    if args.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
