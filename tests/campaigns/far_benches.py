"""Benches on which several strong effects hide one another, drawn at random, and what `explain` finds of them.

    python -m tests.campaigns.far_benches                  # seeds 1 to 8: about twenty minutes of one core
    python -m tests.campaigns.far_benches --seeds 9-16 --json

Each shows ten patterns of bright spots (traps), of 33,000 to 92,000 pixels at 520 to 780 nm, to an
unregistered camera of 8 to 12 bits that sees a part of the panel, turned by up to 60 mrad. Four to seven of the effects
that most benches have are hidden in it, at a random strength, and up to two others at their usual one.

What one plane cannot tell is counted as missed and as not there: the extent of the source is a blur of the camera, and
dust may be taken up by the maps of beam and wavefront.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from trainer.captures.acquire import acquire_captures
from trainer.captures.capture_set import read_captures
from trainer.captures.open_bench import open_bench
from trainer.captures.patterns import Pattern
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.pool import open_pool
from trainer.model.model import Model

OTHERS = (
    "sensor_blur",
    "vignetting",
    "stray_light",
    "ghost",
    "crosstalk",
    "specks",
    "fixed_pattern",
    "sensor_response",
    "spatial_coherence",
    "phase_nonuniformity",
)
PATTERNS = 10
LEVELS = 256


@dataclass(frozen=True)
class Bench:
    """A bench that was drawn: its file's text, its hidden effects, and what its patterns need to know.

    Attributes
    ----------
    text : str
    hidden : list of str
    shape : (int, int)
        Of the panel.
    pitch_m, wavelength_m, distance_m : float
    """

    text: str
    hidden: list[str]
    shape: tuple[int, int]
    pitch_m: float
    wavelength_m: float
    distance_m: float


@dataclass(frozen=True)
class Found:
    """What `explain` found on one bench; `before` and `after` are the held-out excess."""

    seed: int
    before: float
    after: float
    verdict: str
    right: list[str]
    missed: list[str]
    not_there: list[str]
    seconds: float


def drawn(seed: int) -> Bench:
    """The bench of a seed."""
    r = random.Random(seed)
    within = r.uniform
    scale = r.choice([0.12, 0.15, 0.2])
    height, width = (int(n * scale) // 2 * 2 for n in (1200, 1920))
    distance_mm, pitch_um = 200 * scale * within(0.7, 1.3), r.choice([8.0, 8.0, 6.4])
    wavelength_nm = r.choice([780.0, 638.0, 520.0])
    columns, rows = int(width * within(0.55, 1.1)), int(height * within(0.55, 1.1))
    size = min(width / columns, height / rows) * within(0.7, 0.95)  # of a camera pixel, in panel pixels
    turn = within(-0.06, 0.06)
    c, s = size * math.cos(turn), size * math.sin(turn)
    x, y = width / 2 - 0.5 + within(-5, 5), height / 2 - 0.5 + within(-5, 5)
    half = (columns - 1) / 2, (rows - 1) / 2
    view = [c, -s, x - c * half[0] + s * half[1], s, c, y - s * half[0] - c * half[1], 0, 0, 1]
    bits = r.choice([8, 10, 12])
    strengths: dict[str, dict[str, float]] = {
        "distance": {"offset_mm": distance_mm * within(-0.05, 0.05)},
        "illumination": {
            "waist_x_share": within(0.6, 1.3),
            "waist_y_share": within(0.6, 1.3),
            "centre_x_share": within(-0.15, 0.15),
            "centre_y_share": within(-0.15, 0.15),
        },
        "phase_response": {"gain": within(0.45, 1.2), "reference_nm": wavelength_nm},
        "panel_wavefront": {"peak_to_valley_nm": within(200, 1200)},
        "zero_order": {},
        "misregistration": {
            "shift_x_px": within(-6, 6),
            "shift_y_px": within(-6, 6),
            "rotation_mrad": within(-15, 15),
            "scale": within(0.98, 1.02),
            "distortion_px": within(0, 0.6),
        },
        "laser_drift": {},
    }
    hidden = r.sample(list(strengths), r.choice([4, 5, 6, 7])) + r.sample(OTHERS, r.choice([0, 1, 2]))
    tables: list[tuple[str, dict[str, Any]]] = [
        ("[panel]", {"width": width, "height": height, "pitch_um": pitch_um}),
        ("[[channel]]", {"name": "one", "wavelength_nm": wavelength_nm}),
        ("[propagation]", {"distance_mm": distance_mm}),
        ("[iris]", {"shape": r.choice(["square", "circle"]), "half_width": r.choice([0.6, 0.8, 1.0])}),
        (
            "[camera]",
            {
                "registered": False,
                "width": columns,
                "height": rows,
                "pixel_um": pitch_um * size,
                "homography": view,
                "bit_depth": bits,
                "black_level": 2**bits * 0.016,
                "full_well_e": r.choice([4000, 10500]),
            },
        ),
        ("[simulation]", {"signal_share": r.choice([0.13, 0.2])}),
        *(("[[defect]]", {"kind": name, **strengths.get(name, {})}) for name in hidden),
    ]
    lines = ["schema = 1", 'name = "far"']
    for heading, values in tables:
        lines += [heading, *(f"{key} = {json.dumps(value)}" for key, value in values.items())]
    nanometre, micrometre, millimetre = 1e-9, 1e-6, 1e-3
    return Bench(
        "\n".join(lines) + "\n",
        hidden,
        (height, width),
        pitch_um * micrometre,
        wavelength_nm * nanometre,
        distance_mm * millimetre,
    )


def traps(bench: Bench, seed: int) -> list[Pattern]:
    """Patterns of 4 to 24 spots about the plane, each the phase of the sum of its spots' lenses."""
    rng = np.random.default_rng(seed)
    y, x = (bench.pitch_m * (np.arange(n) - (n - 1) / 2) for n in bench.shape)
    extent_y, extent_x = (bench.pitch_m * n for n in bench.shape)
    found = []
    for _ in range(PATTERNS):
        field = np.zeros(bench.shape, complex)
        for _ in range(int(rng.integers(4, 25))):
            at_x, at_y = extent_x * rng.uniform(-0.38, 0.38), extent_y * rng.uniform(-0.38, 0.38)
            focus = bench.distance_m * (1 + rng.uniform(-0.03, 0.03))
            squared = (y[:, None] - at_y) ** 2 + (x - at_x) ** 2
            field += np.exp(1j * (rng.uniform(0, 2 * np.pi) - np.pi / (bench.wavelength_m * focus) * squared))
        turns = np.mod(np.angle(field) / (2 * np.pi), 1)
        found.append(Pattern("traps", (np.rint(LEVELS * turns) % LEVELS).astype(np.uint8)))
    return found


def measure(seed: int, folder: Path) -> Found:
    """Draw a bench, take captures of it and explain them."""
    bench = drawn(seed)
    file = folder / "bench.toml"
    file.write_text(bench.text, encoding="utf-8")
    shown = traps(bench, seed)
    with open_bench(str(file), seed, None) as opened:
        acquire_captures(opened.headset, opened.bench, folder / "captures", PATTERNS, choose=lambda *_: shown)
    captures = read_captures(folder / "captures")
    began = time.monotonic()
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), catalogue(), pool)
    names = found.model.names
    return Found(
        seed,
        found.steps[0].held_out.excess,
        found.steps[-1].held_out.excess,
        found.diagnosis.verdict,
        [n for n in bench.hidden if n in names],
        [n for n in bench.hidden if n not in names],
        [n for n in names if n not in bench.hidden],
        time.monotonic() - began,
    )


def row(found: Found) -> str:
    """A row of the table."""
    cells = (
        str(found.seed),
        ", ".join(found.right),
        ", ".join(found.missed) or "–",
        ", ".join(found.not_there) or "–",
        f"{found.before:.2f}",
        f"{found.after:.4f}, `{found.verdict}`",
        f"{found.seconds:.0f} s",
    )
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Measure, and print a Markdown table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", default="1-8", metavar="FIRST-LAST", help="of the benches (default: 1-8)")
    parser.add_argument("--json", action="store_true", help="a line of JSON for each bench")
    args = parser.parse_args()
    first, _, last = args.seeds.partition("-")
    torch.set_num_threads(1)
    if not args.json:
        print("| seed | found | missed | not there | ideal | end | time |")
        print("| ---: | --- | --- | --- | ---: | ---: | ---: |")
    for seed in range(int(first), int(last or first) + 1):
        with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
            found = measure(seed, Path(folder))
        print(json.dumps(asdict(found)) if args.json else row(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
