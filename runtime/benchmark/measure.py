"""Measurement of the solver in one run: convergence, time against the transforms alone, deadlines, video, memory.

Geometry: 520 nm, 8 um pitch, 200 mm, an iris of half the panel's band, so that irradiance needs no finer grid than
the panel's. Pictures are scikit-image's. PSNR is of amplitude, by iteration and by time on the solver's own grid. For
the final pattern of each solver it is also through the whole light path on the fine grid, after rounding ("final").
"""

from __future__ import annotations

import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from runtime.lightpath import fft
from runtime.lightpath.ideal_path import ideal_path, single
from runtime.lightpath.light_path import LightPath
from runtime.program.progress import Progress, no_progress, part_of
from runtime.solver import Solver
from runtime.solver.targets import decode_srgb, fit_area

SHAPES = ((1080, 1920), (720, 1280), (540, 960))
PITCH, WAVELENGTH, DISTANCE, IRIS = 8e-6, 520e-9, 0.2, 0.5
PICTURES = ("astronaut", "coffee")
TUNED = {
    "rate": 0.1,
    "betas": (0.9, 0.999),
}  # the best of a search over rates 0.01 to 0.2 and betas, see the guide
SOLVERS: dict[str, tuple[str, dict[str, Any], int]] = {
    "bfgs": ("bfgs", {}, 50),
    "adam": ("adam", {}, 100),
    "adam_tuned": ("adam", TUNED, 100),
    "gerchberg_saxton": ("gerchberg_saxton", {}, 20),
    "double_phase": ("double_phase", {}, 0),
}
LEVELS_DB = (25.0, 27.5, 30.0, 32.5, 35.0, 37.5, 40.0)
ROUNDS = 15
FRAMES, STEP = 8, (1, 3)  # of the video, and pixels that it moves from frame to frame
BORDER = 100  # of the panel's height at 1080 rows: left out of the video's region


def measure(
    shapes: Sequence[tuple[int, int]] = SHAPES, solves: int = 40, progress: Progress = no_progress
) -> dict[str, Any]:
    """Everything that `benchmark --json` prints.

    Parameters
    ----------
    shapes : sequence of (int, int)
        Panel sizes; only the first is measured in full.
    solves : int
        Solves by a deadline.
    progress : callable
        Takes the share that is done, 0 to 1, and the name of what is measured.

    Returns
    -------
    dict
        Keys `machine`, `grid`, `fft_floor_ms`, `iteration_ms`, `psnr_by_iteration`, `latency_ms`, `video`, `scaling`
        and more.
    """
    progress(0, "preparing")
    path = _path(shapes[0])
    pictures = {name: picture(name, shapes[0]) for name in PICTURES}
    first = next(iter(pictures.values()))
    solver = Solver(path)
    solver.rehearse(first)
    floor, pruned, iteration = _against_ffts(solver, first)
    cold = _median(lambda: solver.solve(first, 0))
    progress(0.1, "convergence")
    curves, final, pace = _convergence(path, pictures, part_of(progress, 0.1, 0.7))
    progress(0.7, "deadlines")
    paces = solver.descent.paces
    deadline = paces.start.usual + 5.5 * paces.iteration.usual + paces.rounding.usual
    took = [solver.solve(first, deadline_ms=deadline).milliseconds for _ in range(solves)]
    progress(0.8, "video")
    video = _video(path)
    progress(0.9, "sizes")
    scaling = [{"pixels": int(np.prod(shapes[0])), "iteration_ms": _ms(iteration)}]
    for shape in shapes[1:]:
        smaller = Solver(_path(shape))
        smaller.rehearse(picture(PICTURES[0], shape))
        *_, each = _against_ffts(smaller, picture(PICTURES[0], shape))
        scaling.append({"pixels": int(np.prod(shape)), "iteration_ms": _ms(each)})
    by_ms = {name: _by_ms(curves[name], *pace[name]) for name in curves}
    progress(1, "done")
    return {
        "machine": machine(),
        "grid": {"panel": list(shapes[0]), "padded": list(path.grid.padded), "iris": IRIS},
        "fft_floor_ms": _ms(floor),
        "iteration_ms": _ms(iteration),
        "iteration_over_floor": round(iteration / floor, 3),
        "pruned_fft_ms": _ms(pruned),
        "iteration_over_pruned_fft": round(iteration / pruned, 3),
        "cold_start_over_iteration": round(cold / iteration, 3),
        "psnr_by_iteration": {name: [round(v, 3) for v in curve] for name, curve in curves.items()},
        "psnr_by_ms": by_ms,
        "time_to_psnr": {name: _time_to(curves[name], *pace[name]) for name in curves},
        "final_psnr_db": final,
        "deadline_ms": _ms(deadline),
        "latency_ms": {f"p{q}": _ms(float(np.percentile(took, q))) for q in (50, 95, 99)},
        "deadline_misses": int(sum(t > deadline for t in took)),
        "solves": solves,
        "video": video,
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _RSS_UNIT, 1),
        "scaling": scaling,
    }


_RSS_UNIT = 1e6 / 1024 if sys.platform != "darwin" else 1e6


def machine() -> dict[str, Any]:
    """The machine that the benchmark runs on: keys `processor`, `threads`, `load`, `python`, `numpy`, `fft`."""
    return {
        "processor": _processor(),
        "threads": fft.THREADS,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "fft": "ducc0" if fft.has_ducc() else "scipy",
    }


def picture(name: str, shape: tuple[int, int]) -> np.ndarray:
    """A photograph's green channel as linear irradiance [H, W].

    Raises
    ------
    InputError
        Without scikit-image.
    """
    try:
        import skimage.data
    except ImportError as error:
        raise InputError("the benchmark shows scikit-image's pictures: pip install scikit-image") from error
    return fit_area(decode_srgb(np.asarray(getattr(skimage.data, name)())[..., 1] / 255), shape).astype(
        np.float32
    )


def _path(shape: tuple[int, int]) -> LightPath:
    return single(ideal_path(shape, PITCH, WAVELENGTH, DISTANCE * shape[0] / SHAPES[0][0], IRIS))


def _against_ffts(solver: Solver, target: np.ndarray) -> tuple[float, float, float]:
    """Median times, ms, of an iteration's transforms alone and of the iteration; measured in turns.

    Returns
    -------
    whole : float, ms
        Four two-dimensional transforms of the whole padded grid.
    pruned : float, ms
        The same transforms of only those rows and columns that the iteration transforms.
    iteration : float, ms
        The iteration.
    """
    grid = solver.stacks[0][0].grid
    whole = np.zeros(grid.padded, np.complex64)
    rows = np.zeros((grid.shape[0], grid.padded[1]), np.complex64)
    columns = np.zeros((grid.padded[0], 2 * grid.band[1] + 1), np.complex64)
    solver.solve(target, 1)
    phase, following = solver.descent.best, solver.descent.next_start()

    def whole_transforms() -> None:
        for forward in (True, False, True, False):
            fft.into(whole, whole, (0, 1), forward, fft.THREADS)

    def pruned_transforms() -> None:
        for forward in (True, False, True, False):
            fft.into(rows, rows, 1, forward, fft.THREADS)
            fft.into(columns, columns, 0, forward, fft.THREADS)

    def iteration() -> None:
        solver.objective.look(phase)
        assert solver.method is not None
        solver.method.step(phase, following)

    runs = (whole_transforms, pruned_transforms, iteration)
    times: list[list[float]] = [[], [], []]
    for _ in range(ROUNDS):
        for kept, run in zip(times, runs, strict=True):
            kept.append(_timed(run))
    return statistics.median(times[0]), statistics.median(times[1]), statistics.median(times[2])


def _convergence(
    path: LightPath, pictures: dict[str, np.ndarray], progress: Progress
) -> tuple[dict[str, list[float]], dict[str, float], dict[str, tuple[float, float]]]:
    """By solver: the best PSNR after each iteration, that of the final pattern, and (start, iteration) in ms."""
    curves, final, pace = {}, {}, {}
    for number, (name, (method, options, iterations)) in enumerate(SOLVERS.items()):
        progress(number / len(SOLVERS), name)
        solver = Solver(path, method=method, **options)
        solver.rehearse()
        paces = solver.descent.paces
        curve, ends, times = [], [], []
        for target in pictures.values():
            solution = solver.solve(target, iterations)
            curve.append(np.maximum.accumulate(solution.psnr_db))
            around = paces.start.usual + paces.rounding.usual
            times.append((solution.milliseconds - around) / max(iterations, 1))
            ends.append(solution.quality.psnr_db)
        curves[name] = [float(v) for v in np.mean(curve, 0)]
        final[name] = round(float(np.mean(ends)), 3)
        pace[name] = (around, statistics.median(times))
    return curves, final, pace


def _video(path: LightPath) -> dict[str, Any]:
    """A moving picture: one warm iteration for each frame against ten of a cold one, with and without a border."""
    height, width = path.grid.shape
    whole = picture(PICTURES[0], (height + FRAMES * STEP[0], width + FRAMES * STEP[1]))
    border = BORDER * height // SHAPES[0][0]
    inside = np.zeros((height, width))
    inside[border : height - border, border : width - border] = 1

    def frame(k: int) -> np.ndarray:
        top, left = k * STEP[0], k * STEP[1]
        return np.ascontiguousarray(whole[top : top + height, left : left + width])

    result: dict[str, Any] = {"frames": FRAMES, "pixels_a_frame": list(STEP)}
    for name, region in (("whole_frame", None), ("inside_border", inside)):
        solver = Solver(path, region=region)
        solver.frame(frame(0), 10)
        warm, took = [], []
        for k in range(1, FRAMES + 1):
            solution = solver.frame(frame(k), 1)
            warm.append(solution.quality.psnr_db)
            took.append(solution.milliseconds)
        cold = [Solver(path, region=region).frame(frame(k), 10).quality.psnr_db for k in (1, FRAMES)]
        result[name] = {
            "warm_psnr_db": round(float(np.mean(warm)), 3),
            "cold_psnr_db": round(float(np.mean(cold)), 3),
            "warm_ms": _ms(statistics.median(took)),
        }
    return result


def _by_ms(curve: list[float], start: float, each: float) -> dict[str, float]:
    """PSNR at round times, in ms."""
    marks = [m for k in range(1, 6) for m in (10**k, 2 * 10**k, 5 * 10**k)]
    result: dict[str, float] = {}
    for mark in marks:
        done = int((mark - start) / each) if each > 0 else 0
        if mark >= start and (done < len(curve) or not result):
            result[str(mark)] = round(curve[min(done, len(curve) - 1)], 3)
    return result


def _time_to(curve: list[float], start: float, each: float) -> dict[str, float | None]:
    """Milliseconds until each of the round PSNRs; null: not reached within the iterations."""
    reached = {}
    for level in LEVELS_DB:
        done = next((k for k, psnr in enumerate(curve) if psnr >= level), None)
        reached[f"{level:g}"] = None if done is None else _ms(start + done * each)
    return reached


def _median(run: Callable[[], object], times: int = 7) -> float:
    return statistics.median(_timed(run) for _ in range(times))


def _timed(run: Callable[[], object]) -> float:
    begun = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - begun)


def _ms(milliseconds: float) -> float:
    return round(milliseconds, 3)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
