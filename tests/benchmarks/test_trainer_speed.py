"""How fast the trainer is: `pytest tests/benchmarks -s` prints the table of trainer/larger_work.md.

Nothing here fails for being slow.

Figures are medians, and ratios within this one run.
"""

from __future__ import annotations

import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.addition import add_from
from trainer.diagnosis.screen import screen_batches
from trainer.effects import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.predictor import evaluate_captures
from trainer.model.model import Model, absent
from trainer.model.model_stages import scene_for, stages_for
from trainer.prediction.camera_light import light_on_camera
from trainer.prediction.predict import trace

HOLOLOOP = Path(sys.executable).with_name("hololoop-trainer")
ROWS: list[tuple[str, str]] = []


@pytest.fixture(scope="module", autouse=True)
def table():
    """Prints what was measured as a Markdown table when all is done."""
    torch.set_num_threads(1)
    yield
    print("\n\n| measured | result |\n| --- | --- |")
    for what, result in ROWS:
        print(f"| {what} | {result} |")


def median_seconds(run: Callable[[], object], times: int = 7) -> float:
    """Median wall time of a call after one warm-up."""
    run()
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


@pytest.mark.parametrize(("name", "hidden"), [("zero_order", "one effect"), ("demo", "three effects")])
def test_explain_sixteen_captures(name, hidden, tmp_path):
    captures = tmp_path / "captures"
    acquire_from(f"virtual:{name}", captures, patterns=15)
    start = time.perf_counter()
    command = [HOLOLOOP, "explain", captures, "--out", tmp_path / "model.toml", "--json"]
    subprocess.run([str(c) for c in command], check=True, capture_output=True)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    ROWS.append((f"explain, 16 captures of 240 x 320, {hidden} hidden", f"{seconds:.0f} s"))
    ROWS.append((f"largest process of that, {hidden}", f"{peak:.2f} GiB"))


def test_screen_against_fits(tmp_path):
    captures = tmp_path / "captures"
    acquire_from("virtual:zero_order", captures, patterns=15)
    known = catalogue()
    rows = read_captures(captures)
    parts = capture_roles(rows)
    model = with_gains(rows, Model(rows.bench), parts.fitted)
    screened, fitted = load(rows, parts.screened), load(rows, parts.fitted)
    screen = median_seconds(lambda: screen_batches(screened, model, tuple(known.values())), 3)

    three = [absent(known[name], rows.bench) for name in ("zero_order", "illumination", "pupil_aberration")]

    def fits() -> None:
        for one in three:
            fit(model.having(one), [one.effect.name], fitted, 8)

    def additions() -> None:
        for one in three:
            add_from(parts, model, one)

    ROWS.append(
        (
            f"screening all {len(known)} effects / fitting three at their lowest order",
            f"{screen / median_seconds(fits, 3):.2f}",
        )
    )
    ROWS.append(
        (
            f"screening all {len(known)} effects / fitting three as add does",
            f"{screen / median_seconds(additions, 3):.2f}",
        )
    )


def test_forward_over_its_ffts(tmp_path):
    bench = read_captures_bench(tmp_path)
    model = Model(bench)
    scene = scene_for(model, "green", bench.distance_mm)
    stages = stages_for(scene, ())
    gray = torch.randint(0, 256, (1, *bench.panel.shape))
    grid = scene.grid
    field = torch.zeros((1, *grid.shape), dtype=torch.complex64)
    band = (2 * grid.band[0] + 1, 2 * grid.band[1] + 1)
    rows = torch.zeros((1, grid.shape[0], band[1]), dtype=torch.complex64)
    spectrum = torch.zeros((1, *band), dtype=torch.complex64)
    columns = torch.zeros((1, band[0], grid.image_shape[1]), dtype=torch.complex64)
    image = torch.zeros((1, *grid.image_shape))

    def ffts() -> None:
        torch.fft.fft(field, n=grid.padded[1], dim=-1)
        torch.fft.fft(rows, n=grid.padded[0], dim=-2)
        torch.fft.ifft(spectrum, n=2 * grid.padded[1], dim=-1)
        torch.fft.ifft(columns, n=2 * grid.padded[0], dim=-2)
        torch.fft.irfft2(torch.fft.rfft2(image), s=grid.image_shape)

    with torch.no_grad():
        whole = median_seconds(lambda: light_on_camera(scene, stages, trace(scene, stages, gray).image), 31)
        floor = median_seconds(ffts, 31)
    ROWS.append(("one forward of the light path, 240 x 320, over its FFTs alone", f"{whole / floor:.2f}"))


def read_captures_bench(folder: Path):
    """The bench of a small set, for its geometry at 240 x 320."""
    path = bench_file(folder, width=320, height=240, distance_mm=30)
    acquire_from(str(path), folder / "bench", patterns=2)
    return read_captures(folder / "bench").bench


def test_growth(tmp_path):
    def seconds(side: int, count: int) -> float:
        path = Path(tempfile.mkdtemp(dir=tmp_path))
        spec = bench_file(path, 'kind = "zero_order"', width=side, height=side, distance_mm=10)
        acquire_from(str(spec), path / "captures", patterns=count - 1)
        rows = read_captures(path / "captures")
        model = fit(Model(rows.bench), [], load(rows, rows.captures[:1])).model
        return median_seconds(lambda: evaluate_captures(rows, rows.captures, model), 3)

    by_count = {n: seconds(128, n) for n in (8, 16, 32, 64)}
    by_side = {s: seconds(s, 8) for s in (128, 256, 512, 1024)}
    captures_power = np.polyfit(np.log(list(by_count)), np.log(list(by_count.values())), 1)[0]
    work = [s * s * math.log(s * s) for s in by_side]
    pixels_power = np.polyfit(np.log(work), np.log(list(by_side.values())), 1)[0]
    ROWS.append(("time to judge a set grows as captures to the power (8 to 64)", f"{captures_power:.2f}"))
    ROWS.append(("... as pixels x log(pixels) to the power (128² to 1024²)", f"{pixels_power:.2f}"))
    milliseconds = ", ".join(f"{s}²: {1e3 * t / 8:.0f} ms" for s, t in by_side.items())
    ROWS.append(("... a capture", milliseconds))
