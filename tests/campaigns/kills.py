"""kill -9 of any process at any moment: `python -m tests.campaigns.kills --count N --seed S [--json]`.

The service, its solver, its camera process, and a program that replaces the bundle again and again, as a calibration
does. A victim is killed while the headset starts, arms, ramps or shows, at a random moment. After each kill,
the light must be out within 150 ms and the bundle whole; at the end the headset must return to light.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import read_bundle
from tests.campaigns.faults import DARK_WITHIN_S, PATIENCE_S
from tests.campaigns.headset import ENVIRONMENT
from tests.campaigns.lane import Lane

VICTIMS = ("service", "solver", "camera", "calibration")
LONGEST_S = 0.8  # from one kill to the next: a start takes about half of it
REPLACING = """
import ctypes, sys
from runtime.bundle.bundle_folder import read_bundle, write_bundle
ctypes.CDLL(None).prctl(1, 9)
while True:
    bundle = read_bundle(sys.argv[1])
    write_bundle(sys.argv[1], bundle.arrays, bundle.description, bundle.provenance, replace=True)
"""


def replacing(folder: Path) -> subprocess.Popen[bytes]:
    """A process that replaces the bundle in a folder without end."""
    return subprocess.Popen([sys.executable, "-c", REPLACING, str(folder / "bundle")], env=ENVIRONMENT)


def is_whole(bundle: Path) -> bool:
    """Whether a bundle verifies; one that is replaced while it is read is read again."""
    for _ in range(3):
        with suppress(InputError):
            read_bundle(bundle)
            return True
    return False


def live(lane: Lane, until_s: float) -> None:
    """Return to light and show pictures, as far as the service allows."""
    while time.monotonic() < until_s:
        try:
            lane.light_up(within_s=0.05)
            lane.frame()
        except (OSError, InputError):
            with suppress(OSError, InputError):
                lane.reconnect(within_s=0.05)
            time.sleep(0.01)


def kills(count: int, seed: int) -> dict[str, Any]:
    """Kill `count` processes; the results."""
    rng = random.Random(seed)
    victims: Counter[str] = Counter()
    lit = dark_in_time = whole = 0
    worst_s = 0.0
    with tempfile.TemporaryDirectory(prefix="hololoop-") as folder:
        lane = Lane(Path(folder), seed)
        calibration = replacing(lane.folder)
        try:
            for _ in range(count):
                live(lane, time.monotonic() + rng.uniform(0, LONGEST_S))
                victim = rng.choice(VICTIMS)
                victims[victim] += 1
                was_lit, at = lane.lit(), time.monotonic()
                if victim == "calibration":
                    calibration.kill()
                    calibration.wait()
                elif victim == "service":
                    lane.end_service(signal.SIGKILL)
                else:
                    lane.signal_child(victim, signal.SIGKILL)
                whole += is_whole(lane.folder / "bundle")
                if was_lit and victim != "calibration":
                    lit += 1
                    dark = lane.dark_since(at)
                    while dark is None and time.monotonic() < at + PATIENCE_S:
                        time.sleep(0.002)
                        dark = lane.dark_since(at)
                    took = PATIENCE_S if dark is None else dark - at
                    dark_in_time += took <= DARK_WITHIN_S
                    worst_s = max(worst_s, took)
                if calibration.poll() is not None:
                    calibration = replacing(lane.folder)
                if lane.service.poll() is not None:
                    lane.service = lane.start_service()
            lane.reconnect()
            recovered = lane.light_up()
        finally:
            calibration.kill()
            calibration.wait()
            lane.close()
    return {
        "kills": count,
        "by_process": dict(victims),
        "dark_required": lit,
        "dark_in_time": dark_in_time,
        "worst_dark_ms": round(1e3 * worst_s, 1),
        "bundles_whole": whole,
        "recovered": recovered,
    }


def main() -> int:
    """Run it; exit 0 where every guarantee was kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.kills", description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="kills (default 500)")
    parser.add_argument("--seed", type=int, default=0, help="of victims and moments (default 0)")
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout and nothing else"
    )
    args = parser.parse_args()
    found = kills(args.count, args.seed)
    if args.json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"{key}: {value}")
    kept = found["dark_in_time"] == found["dark_required"] and found["bundles_whole"] == found["kills"]
    return 0 if kept and found["recovered"] else 1


if __name__ == "__main__":
    sys.exit(main())
