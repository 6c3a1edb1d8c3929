"""A long run without faults: `python -m tests.campaigns.soak --frames 100000 [--json]`.

One program shows pictures without pause. The report: frames shown, late and lost, latency from End to the
panel, the mean time of each stage, light in a wrong field, and the memory of each process over time.

    python -m tests.campaigns.soak --size 1080x1920 --colours --refresh-hz 2 --solve-ms 400 --seconds 150

is a headset of full size that shows three colours in turn. Its camera gives one picture again and again. With
`--display` in place of `--size`, frames go to a panel of that size over a display link: without `--colours` it mirrors
a screen.

    python -m tests.campaigns.soak --size 1080x1920 --refine --refresh-hz 2 --solve-ms 400 --seconds 150

refines one picture all the while, whose frames are to be as punctual as without `--refine`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import socket
import sys
import tempfile
import time
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.camera.view import View
from runtime.service.client import LostFrame, RefusedError
from tests.campaigns import screen, still_camera
from tests.campaigns.headset import SHAPE, write_configuration
from tests.campaigns.lane import STALE_MS, Lane

STAGE = re.compile(r'hololoop_frame_stage_seconds_(sum|count)\{stage="(\w+)"\} (\S+)')
LIGHT_WITHIN_S = 60.0
SETTLED = 0.1  # of the frames, before memory counts
SAMPLES = 50
CAPTURES = 1000  # of a refinement at most


def memory_mb(pid: int) -> float:
    """Private memory of a process, MB."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Private_Dirty:"):
            return int(line.split()[1]) / 1024
    return 0.0


def cpu_s(pid: int) -> float:
    """Processor time of a process so far, s; what it takes does not depend on other work of the machine."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def stage_ms(port: int) -> dict[str, float]:
    """Mean time of a frame in each stage so far, from the service's metrics, ms."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
        found = {(stage, what): float(value) for what, stage, value in STAGE.findall(answer.read().decode())}
    counts = {stage: count for (stage, what), count in found.items() if what == "count"}
    return {stage: round(1000 * found[stage, "sum"] / max(count, 1), 2) for stage, count in counts.items()}


def soak(
    frames: int,
    refresh_hz: float,
    shape: tuple[int, int] = SHAPE,
    colours: bool = False,
    solve_ms: float | None = None,
    seconds: float | None = None,
    refined: bool = False,
    display: bool = False,
) -> dict[str, Any]:
    """Show `frames` frames, or for a time; the results.

    Parameters
    ----------
    frames : int
    refresh_hz : float, Hz
        Of pictures.
    shape : (int, int)
        (H, W), pixels of the panel.
    colours : bool
        Whether three colours are shown in turn.
    solve_ms : float or None, ms
        Time for the patterns of a picture; None: a third of a period, 3 at most.
    seconds : float or None, s
        Ends after this time, however many frames were shown.
    refined : bool
        Whether all frames are of one picture that is refined again and again, with a network that was never trained.
    display : bool
        Whether frames go over a display link, which is not looked at: of torn frames and lit fields nothing is known.
    """
    solve_ms = solve_ms or min(3.0, 300 / refresh_hz)
    stale_ms = max(STALE_MS, 2 * solve_ms, 2000 / refresh_hz)  # lit until the next pattern is there
    began_load = os.getloadavg()[0]
    latency_ms: list[float] = []
    grown: dict[str, list[tuple[int, float]]] = {"service": [], "solver": [], "camera": []}
    late = lost = 0
    with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        file = write_configuration(
            Path(folder),
            refresh_hz,
            solve_ms,
            stale_ms,
            colours=colours,
            shape=shape,
            metrics_port=port,
            display=display,
        )
        if refined:
            add_network(file.parent / "bundle", shape)
        lane = Lane(Path(folder), 0, file=file)
        lane.pictures = lane.pictures[:1] if refined else lane.pictures
        lane.remote.set_to("gated", not display)
        try:
            lit_up = lane.light_up(LIGHT_WITHIN_S)
            refining = False
            used = {name: cpu_s(pid) for name, pid in processes(lane).items()}
            sent: dict[int, float] = {}
            began = time.monotonic()
            k = 0
            while (done := max(k / frames, (time.monotonic() - began) / (seconds or math.inf))) < 1:
                refining = refining and lane.client.refined is None
                if refined and not refining:
                    with suppress(RefusedError):
                        lane.client.refine(CAPTURES)
                        refining = True
                lane.frame()
                sent[lane.latest] = time.monotonic()
                for outcome in lane.outcomes:
                    at = sent.pop(outcome.frame, None)
                    if isinstance(outcome, LostFrame):
                        lost += 1
                        print(f"frame {outcome.frame}: {outcome.text}", file=sys.stderr)
                    elif at is not None:
                        late += outcome.flags & 1
                        latency_ms.append((outcome.display_ns * 1e-9 - at) * 1e3)
                if done >= len(grown["service"]) / SAMPLES:
                    for name, pid in processes(lane).items():
                        grown[name].append((k, memory_mb(pid)))
                k += 1
            took_s = time.monotonic() - began
            frames, emitting = k, lane.lit()
            used = {name: cpu_s(pid) - used[name] for name, pid in processes(lane).items()}
            unanswered = lane.unanswered()
            torn = None if display else lane.torn()
            stages = stage_ms(port)
            lit_fields, wrongly_lit = (None, None) if display else (lane.lit_fields(), lane.wrongly_lit())
            log = (Path(folder) / "service.log").read_text()
            learned = log.count('"predicted"')
            if not emitting:
                print(log, end="", file=sys.stderr)
        finally:
            lane.close()
    quantiles = np.percentile(latency_ms or [-1.0], [50, 95, 99, 99.9, 100])  # -1: nothing was shown
    return {
        "frames": frames,
        "seconds": round(took_s, 1),
        "shown": len(latency_ms),
        "frames_per_s": round(len(latency_ms) / took_s, 2),
        "lit": lit_up and emitting,
        "lit_fields": lit_fields,
        "wrongly_lit_fields": wrongly_lit,
        "load": [round(began_load, 1), round(os.getloadavg()[0], 1)],
        "late": late,
        "lost": lost,
        "lost_without_error": unanswered,
        "refinement_captures": learned,
        "torn_frames": torn,
        "latency_ms": dict(
            zip(("p50", "p95", "p99", "p99_9", "worst"), quantiles.round(2).tolist(), strict=True)
        ),
        "stage_ms": stages,
        "cpu_ms_a_frame": {name: round(1000 * s / max(1, len(latency_ms)), 1) for name, s in used.items()},
        "memory_mb": {name: _growth(samples, frames) for name, samples in grown.items()},
    }


def add_network(bundle: Path, shape: tuple[int, int]) -> None:
    """Put a compact network that was never trained in a bundle of one colour, and where the still camera looks."""
    import torch

    from trainer.networks.approximator import Approximator, Architecture
    from trainer.networks.onnx_files import onnx_files

    torch.manual_seed(0)
    networks = onnx_files(Approximator(Architecture("compact", 8, shape, 1)))
    found = read_bundle(bundle)
    down, right = ((n - 1) / (seen - 1) for n, seen in zip(shape, still_camera.SHAPE, strict=True))
    view = View(still_camera.SHAPE, (right, 0, 0, 0, down, 0, 0, 0, 1))
    described = {**found.description, "camera": {"view": view.as_json()}}
    write_bundle(bundle, found.arrays, described, {}, networks=networks, replace=True)


def processes(lane: Lane) -> dict[str, int]:
    """The numbers of the service's processes, by name."""
    return {
        "service": lane.service.pid,
        "solver": lane.child("solver"),
        "camera": lane.child("camera"),
    }


def _growth(samples: list[tuple[int, float]], frames: int) -> dict[str, float]:
    """Memory after settling, at the end, and its trend."""
    settled = [(k, mb) for k, mb in samples if k >= SETTLED * frames] or samples
    slope = np.polyfit(*zip(*settled, strict=True), 1)[0] if len(settled) > 2 else 0.0
    return {
        "settled": round(settled[0][1], 1),
        "end": round(settled[-1][1], 1),
        "per_100000_frames": round(float(slope) * 1e5, 2),
    }


def main() -> int:
    """Run the soak; exit 0 where no frame was lost or torn."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.soak", description=__doc__)
    parser.add_argument("--frames", type=int, default=100000, help="frames to show (default 100000)")
    parser.add_argument("--refresh-hz", type=float, default=400.0, help="frames a second (default 400)")
    parser.add_argument(
        "--size", type=_size, default=SHAPE, metavar="HxW", help="pixels of the panel (default 24x32)"
    )
    parser.add_argument("--colours", action="store_true", help="three colours in turn")
    parser.add_argument(
        "--refine",
        action="store_true",
        help="refine one picture all the while (one colour, needs the trainer)",
    )
    parser.add_argument("--display", action="store_true", help="a panel of 1080x1920 at a display link")
    parser.add_argument("--solve-ms", type=float, help="time for a picture's patterns")
    parser.add_argument("--seconds", type=float, help="end after so long")
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout and nothing else"
    )
    args = parser.parse_args()
    found = soak(
        args.frames,
        args.refresh_hz,
        screen.SHAPE if args.display else args.size,
        args.colours,
        args.solve_ms,
        args.seconds,
        args.refine,
        args.display,
    )
    if args.json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"{key}: {value}")
    faults = ("lost", "lost_without_error", "torn_frames", "wrongly_lit_fields")
    return 1 if any(found[fault] for fault in faults) else 0


def _size(text: str) -> tuple[int, int]:
    """(H, W) of "HxW"."""
    height, width = text.lower().split("x")
    return int(height), int(width)


if __name__ == "__main__":
    sys.exit(main())
