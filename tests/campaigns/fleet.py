"""Two hundred small capture sets in one run on a Dask cluster, with a worker killed and the run interrupted on the way.

    python -m tests.campaigns.fleet                            # 20 headsets, each 10 times: some minutes on two cores
    python -m tests.campaigns.fleet --headsets 12 --sessions 2 --json

The headsets are simulated, of 96 x 80 pixels, with a distance and a phase's gain that drift together, over headsets
and from session to session, and a leak that drifts for itself. One model is fitted again to each set (`fleet --model`).
When a quarter is done, one of the cluster's two workers is killed; when half is done, the run gets Ctrl-C, and the same
command is started again. The campaign fails (exit 1) unless every set is finished, nothing that was finished before the
interruption was done again, and what drifts together is found, and nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from tests.trainer.made_fleet import START, defects_of, set_of_bench, start_model
from trainer.fleet.fleet_table import read_table
from trainer.fleet.set_result import SetResult

TRUTH = {frozenset(("distance", "phase_response"))}
ROOT = Path(__file__).resolve().parents[2]


def made(folder: Path, headsets: int, sessions: int) -> tuple[list[Path], list[float]]:
    """The sets, and the distance's true offset of each, mm."""
    rng = np.random.default_rng(0)
    tasks, offsets = [], []
    for h, own in enumerate(own_causes(headsets, rng)):
        for s in range(sessions):
            cause, other = own + rng.uniform(-0.4, 0.4, 2)
            offsets.append(round(0.1 + 0.08 * cause, 4))
            tasks.append((folder, f"unit-{h:02d}", h * sessions + s, cause, other, s))
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(_made, tasks)), offsets


def own_causes(headsets: int, rng: np.random.Generator) -> np.ndarray:
    """Two causes for each headset, [headsets, 2], evenly spread, that have nothing to do with each other.

    Of twenty drawn at random, two that have not would correlate by more than 0.4 in one fleet of thirteen.
    """
    one = np.linspace(-0.6, 0.6, headsets)
    while True:
        other = rng.permutation(one)
        if abs(np.corrcoef(one, other)[0, 1]) < 0.05:
            return np.stack([one, other], axis=1)


def _made(task: tuple[Path, str, int, float, float, int]) -> Path:
    folder, headset, seed, cause, other, session = task
    taken = START + timedelta(weeks=session)
    return set_of_bench(folder, headset, seed, *defects_of(cause, other), patterns=3, taken=taken)


class Run:
    """`fleet` in a process of its own."""

    def __init__(self, words: Sequence[str], table: Path) -> None:
        self.table = table
        command = [sys.executable, "-m", "trainer.cli", "fleet", *words, "--json"]
        # A campaign in a shell's background ignores Ctrl-C, and so would what it starts.
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, text=True, preexec_fn=_heeds_ctrl_c
        )

    def until(self, count: int) -> None:
        """Wait until that many sets are in the table, or the process ends."""
        while self.process.poll() is None and len(self.rows()) < count:
            time.sleep(0.5)

    def rows(self) -> list[SetResult]:
        """What is in the table."""
        return read_table(self.table)[0] if self.table.exists() else []

    def ended(self) -> tuple[int, dict[str, Any]]:
        """Exit code, and what it printed."""
        out, _ = self.process.communicate()
        return self.process.returncode, json.loads(out) if out.strip() else {}


def _heeds_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def campaign(folder: Path, headsets: int, sessions: int) -> dict[str, Any]:
    """Run it; what went wrong is in `troubles`."""
    from distributed import LocalCluster

    begin = time.monotonic()
    sets, offsets = made(folder, headsets, sessions)
    model = start_model(folder / "start.toml", sets[0])
    making_s = time.monotonic() - begin
    table, page = folder / "fleet.parquet", folder / "fleet.html"
    troubles = []
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", processes=True) as cluster:
        words = [*map(str, sets), "--model", str(model), "--cluster", cluster.scheduler_address]
        words += ["--out", str(table), "--report", str(page)]
        begin = time.monotonic()
        first = Run(words, table)
        first.until(len(sets) // 4)
        killed_at = len(first.rows())
        os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        first.until(len(sets) // 2)
        first.process.send_signal(signal.SIGINT)
        code, _ = first.ended()
        if code != 130:
            troubles.append(f"after Ctrl-C the exit code was {code}")
        before = {r.facts.folder: r for r in first.rows() if r.failed is None}
        code, found = Run(words, table).ended()
        run_s = time.monotonic() - begin
    if code != 0:
        return {"troubles": [*troubles, f"the second run ended with exit code {code}"]}
    after = {r.facts.folder: r for r in read_table(table)[0]}
    again = sum(after[name].seconds != r.seconds for name, r in before.items())
    together = {
        over: [p for p in found["drift"][over]["pairs"] if p["together"]] for over in ("headsets", "time")
    }
    if found["finished"] != len(sets) or found["failed"]:
        troubles.append(f"{found['finished']} of {len(sets)} sets are finished; failed: {found['failed']}")
    if again or found["taken_up"] != len(before):
        troubles.append(f"{again} of {len(before)} sets were done again")
    for over, pairs in together.items():
        enough = found["drift"][over]["count"] >= found["drift"][over]["needed"]
        if enough and {frozenset(p[k]["effect"] for k in ("first", "second")) for p in pairs} != TRUTH:
            troubles.append(f"over {over} these were found to drift together: {pairs}")
    fitted = [n.value for s in sets for n in after[str(s)].numbers if n.effect == "distance"]
    return {
        "sets": len(sets),
        "making_s": making_s,
        "run_s": run_s,
        "sets_a_minute": 60 * len(sets) / run_s,
        "done_when_killed": killed_at,
        "done_when_interrupted": len(before),
        "done_again": again,
        "failed": len(found["failed"]),
        "verdicts": found["verdicts"],
        "worst_distance_error_um": 1e3 * max(abs(a - b) for a, b in zip(fitted, offsets, strict=True)),
        "correlations": {
            over: {
                " and ".join((p["first"]["effect"], p["second"]["effect"])): [p["correlation"], *p["ci95"]]
            }
            for over, pairs in ((o, found["drift"][o]["pairs"]) for o in together)
            for p in pairs[:1]
        },
        "table_kib": table.stat().st_size / 1024,
        "page": str(page),
        "troubles": troubles,
    }


def main() -> int:
    """Run the campaign and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--headsets", type=int, default=20, help="headsets (default 20)")
    parser.add_argument("--sessions", type=int, default=10, help="sets of each (default 10)")
    parser.add_argument("--keep", type=Path, help="a folder for the sets, the table and the page")
    parser.add_argument("--json", action="store_true", help="one object on stdout")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        found = campaign(folder, args.headsets, args.sessions)
    if args.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            print(f"{name:24s} {value}")
    return 1 if found["troubles"] else 0


if __name__ == "__main__":
    sys.exit(main())
