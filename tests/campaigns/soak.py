"""A long run without faults: `python -m tests.campaigns.soak --frames 100000 [--json]`.

One program shows pictures without pause. The report: frames shown, late and lost, latency from End to the
panel, and the memory of each process over time.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from runtime.service.client import LostFrame
from tests.campaigns.lane import Lane

SETTLED = 0.1  # of the frames, before memory counts
SAMPLES = 50


def memory_mb(pid: int) -> float:
    """Private memory of a process, MB."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Private_Dirty:"):
            return int(line.split()[1]) / 1024
    return 0.0


def soak(frames: int, refresh_hz: float) -> dict[str, Any]:
    """Show `frames` frames; the results."""
    latency_ms: list[float] = []
    grown: dict[str, list[tuple[int, float]]] = {"service": [], "solver": [], "camera": []}
    late = lost = 0
    with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
        lane = Lane(Path(folder), 0, refresh_hz=refresh_hz)
        try:
            lane.light_up()
            sent: dict[int, float] = {}
            began = time.monotonic()
            for k in range(frames):
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
                if k % max(1, frames // SAMPLES) == 0:
                    pids = {
                        "service": lane.service.pid,
                        "solver": lane.child("solver"),
                        "camera": lane.child("camera"),
                    }
                    for name, pid in pids.items():
                        grown[name].append((k, memory_mb(pid)))
            seconds = time.monotonic() - began
            unanswered = lane.unanswered()
            torn = lane.torn()
        finally:
            lane.close()
    quantiles = np.percentile(latency_ms, [50, 95, 99, 99.9, 100])
    return {
        "frames": frames,
        "seconds": round(seconds, 1),
        "shown": len(latency_ms),
        "late": late,
        "lost": lost,
        "lost_without_error": unanswered,
        "torn_frames": torn,
        "latency_ms": dict(
            zip(("p50", "p95", "p99", "p99_9", "worst"), quantiles.round(2).tolist(), strict=True)
        ),
        "memory_mb": {name: _growth(samples, frames) for name, samples in grown.items()},
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
        "--json", action="store_true", help="print one JSON object on stdout and nothing else"
    )
    args = parser.parse_args()
    found = soak(args.frames, args.refresh_hz)
    if args.json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"{key}: {value}")
    return 0 if found["lost"] == found["lost_without_error"] == found["torn_frames"] == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
