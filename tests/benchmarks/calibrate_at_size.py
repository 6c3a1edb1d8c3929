"""A whole calibration at full size: its time by parts, its memory, and how near the wavefront comes to the hidden one.

    python -m tests.benchmarks.calibrate_at_size [--shape 1080x1920] [--distance 30] [--colours 1] [--json]

What `hololoop-runtime calibrate` does, from reading the bundle to exchanging it, on a simulated headset with four
hidden faults at once: wavefront, beam, distance and phase response. The bundle knows none of them.

The simulated headset is a process of its own, so that neither its memory nor its processor time is counted here; the
time that the calibration waits for its pictures is stated apart, since a camera takes them in the time of an exposure.
The clock starts when the first pattern is shown; the patterns are solved before that. Run it on a machine that does
nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.virtual import BenchDescription, make_defect
from firmware_iface.virtual.bench_description import ChannelDescription
from firmware_iface.virtual.bench_process import bench_process
from firmware_iface.virtual.simulated_panel import panel_path_nm
from firmware_iface.virtual.virtual_devices import VirtualCamera, VirtualLasers, VirtualPanel
from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.calibration.bundle_replacement import replace_bundle
from runtime.calibration.self_calibration import calibrate
from runtime.calibration.summary import numbers
from runtime.headset.open_devices import Devices
from runtime.lightpath.ideal_path import ideal_path, single
from runtime.program.large_blocks import keep_large_blocks
from runtime.program.threads import share_cores
from tests.runtime.calibration.drifting import without_tilt

COLOURS = {"green": 520.0, "red": 638.0, "blue": 450.0}
HIDDEN = ("panel_wavefront", "illumination", "distance", "phase_response")
PITCH, IRIS = 8e-6, 1.0


def bench_of(shape: tuple[int, int], distance_mm: float, colours: list[str]) -> BenchDescription:
    """The headset as it is."""
    bench = BenchDescription(defects=tuple(map(make_defect, HIDDEN))).resized(*shape, distance_mm)
    return replace(bench, channels=tuple(ChannelDescription(c, COLOURS[c]) for c in colours))


def write_ideal(folder: Path, shape: tuple[int, int], distance_mm: float, colours: list[str]) -> None:
    """The bundle, which takes the headset for perfect."""
    paths = []
    for name in colours:
        nm = COLOURS[name]
        path = single(ideal_path(shape, PITCH, nm * 1e-9, distance_mm * 1e-3, IRIS))
        paths.append((name, distance_mm, nm, path))
    records, arrays = pack_light_paths(paths)
    write_bundle(folder, arrays, {"paths": records, "distance_mm": distance_mm}, {"bench": "ideal"})


class TimedPictures:
    """The pictures of a simulated headset in another process, and how long they were waited for.

    Attributes
    ----------
    waited_s : float, s
    first_s : float, s
        When the first was asked for.
    """

    def __init__(self, bench: BenchDescription, panel: VirtualPanel, lasers: VirtualLasers) -> None:
        self._expose, self._panel, self._lasers = bench_process(bench, 1), panel, lasers
        self.waited_s, self.first_s = 0.0, 0.0
        self.camera = VirtualCamera(
            (bench.camera.height, bench.camera.width), bench.camera.bit_depth, self._take
        )

    def _take(self) -> np.ndarray:
        begun = time.perf_counter()
        self.first_s = self.first_s or begun
        power = {c: self._lasers.power(c) for c in self._lasers.channels}
        counts = self._expose(self._panel.fields, power, self.camera.exposure_ms, ())
        self.waited_s += time.perf_counter() - begun
        return counts


class Parts:
    """Notes when each part of a calibration begins: a callback for its progress."""

    def __init__(self, aloud: bool) -> None:
        self.aloud, self.begun = (
            aloud,
            [("reading the bundle", time.perf_counter(), time.process_time(), peak_mb())],
        )

    def __call__(self, done: float, what: str = "") -> None:
        name = "pictures" if what.startswith("showing") else what
        if name and name != self.begun[-1][0]:
            self.begun.append((name, time.perf_counter(), time.process_time(), peak_mb()))
            if self.aloud:
                print(f"{self.begun[-1][1] - self.begun[0][1]:>7.1f} s  {name}", flush=True)

    def table(self) -> list[dict[str, Any]]:
        """Each part's name, seconds on the clock and of the processors, and the most memory up to its end."""
        return [
            {
                "part": this[0],
                "s": round(then[1] - this[1], 2),
                "cpu_s": round(then[2] - this[2], 2),
                "peak_mb": then[3],
            }
            for this, then in zip(self.begun, self.begun[1:], strict=False)
        ]


def peak_mb() -> int:
    """The most memory that this process has had, MB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6)


def measured(shape: tuple[int, int], distance_mm: float, colours: list[str], aloud: bool) -> dict[str, Any]:
    """One calibration: its parts, times (s), memory (MB) and errors."""
    bench = bench_of(shape, distance_mm, colours)
    panel = VirtualPanel((bench.panel.height, bench.panel.width))
    lasers = VirtualLasers(tuple(c.name for c in bench.channels))
    pictures = TimedPictures(bench, panel, lasers)
    devices = Devices(panel, lasers, pictures.camera, {}, lambda plane_mm: None)  # it has one plane
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "bundle"
        write_ideal(folder, shape, distance_mm, colours)
        parts, begun = Parts(aloud), time.perf_counter()

        @contextmanager
        def opened() -> Iterator[Devices]:
            yield devices

        bundle = read_bundle(folder)
        found = calibrate(opened, bundle, progress=parts)
        parts(1.0, "the bundle's exchange")
        assert found.verdict == "recalibrated"
        replace_bundle(folder, bundle, found)
        end = time.perf_counter()
        parts(1.0, "end")
        drift = found.estimate.drift
        new = load_light_path(read_bundle(folder), colours[0])
        hidden = panel_path_nm(bench.defects[0], *shape, shape[1] / shape[0])  # type: ignore[arg-type]
        error = float(without_tilt(drift.wavefront(shape) - hidden).std())
        turned = np.exp(-2j * np.pi / COLOURS[colours[0]] * drift.wavefront(shape))
        assert np.abs(np.angle(new.source * turned)).max() < 1e-3  # the bundle has what was found
        said = numbers(found)
        return {
            "shape": list(shape),
            "distance_mm": distance_mm,
            "colours": colours,
            "cores": len(os.sched_getaffinity(0)),
            "load_before": round(os.getloadavg()[1], 2),
            "first_pattern_to_exchange_s": round(end - pictures.first_s, 1),
            "of_it_waiting_for_simulated_pictures_s": round(pictures.waited_s, 1),
            "whole_s": round(end - begun, 1),
            "cpu_s": round(sum(p["cpu_s"] for p in parts.table()), 1),
            "peak_mb": parts.begun[-1][3],
            "pictures": found.pictures_taken,
            "wavefront_nm": round(float(without_tilt(hidden).std()), 2),
            "wavefront_error_nm": round(error, 3),
            "wave_over": round(COLOURS[colours[0]] / error),
            "distance_error_mm": round(abs(drift.distance_mm - 0.18), 6),
            "excess": [said["heldout"]["before"]["excess"], said["heldout"]["after"]["excess"]],
            "maps": said["wavefront"]["free_form"]["nodes"],
            "picture_psnr_db": {c: said["channels"][c]["picture_psnr_db"] for c in colours},
            "parts": parts.table(),
        }


def main() -> None:
    """Calibrate once, and print what it took."""
    share_cores()
    keep_large_blocks()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", default="1080x1920")
    parser.add_argument("--distance", type=float, default=30.0, metavar="MM")
    parser.add_argument("--colours", type=int, choices=range(1, 1 + len(COLOURS)), default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    height, width = map(int, args.shape.split("x"))
    found = measured((height, width), args.distance, list(COLOURS)[: args.colours], not args.json)
    if args.json:
        print(json.dumps(found))
        return
    for part in found.pop("parts"):
        print("{s:>7.1f} s  {cpu_s:>7.1f} s of the processors  {peak_mb:>5} MB  {part}".format_map(part))
    for name, value in found.items():
        print(f"{name:<40}{value}")


if __name__ == "__main__":
    main()
