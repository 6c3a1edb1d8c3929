"""The demo: all steps on a virtual bench, from captures to a better picture.

A headset with three hidden effects is captured and explained. Pictures are then shown with patterns for the ideal
model, for the explained model, and by an oracle that knows the true bench, which gives the upper bound. They are shown
through the drivers of a real headset, on emulated hardware: the panel over USB (pyusb), the lasers over I2C (smbus2,
with safety controller and heartbeat), the camera over its link (depthai).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset, open_headset
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path
from runtime.bundle.whole_files import whole_file
from runtime.headset.open_devices import Devices, emulated
from runtime.program.progress import Progress, no_progress, part_of
from runtime.solver import Quality, quality, solve
from runtime.solver.pattern_files import write_pattern
from runtime.solver.targets import encode_srgb, fit_area
from trainer.captures.bench_file import Bench
from trainer.captures.open_bench import nominal_bench
from trainer.effects.effect_catalogue import catalogue
from trainer.formatting import listed
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model
from trainer.report.display_section import DisplayedPicture, with_display
from trainer.training.photographs import photograph

BENCH, QUICK_BENCH = "virtual:demo", "virtual:small_demo"
PICTURES = ("astronaut", "coffee")  # not among those that are captured
ITERATIONS, ORACLE_ITERATIONS = 100, 60
SHOTS = 4  # pictures of the camera that are averaged
SATURATED = 0.001  # share of pixels


@dataclass(frozen=True)
class CameraPicture:
    """The camera's picture of a pattern.

    Attributes
    ----------
    light : array [h, w], counts/ms
        Above black.
    quality : Quality
        Against the target.
    """

    light: np.ndarray
    quality: Quality


def run_demo(
    folder: Path, quick: bool = False, workers: int | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Run all steps and leave every file in `folder`.

    Parameters
    ----------
    folder : path
        A new or empty one.
    quick : bool
        A smaller panel and fewer captures.
    workers : int or None
        Processes; None: one for each core.
    progress : callable or None
        Called with the share done and what is being done.

    Returns
    -------
    dict
        Keys `sentence`, `found`, `verdict`, `steps`, `noise_nrmse`, `display`, `pictures`, `captures`, `model`,
        `bundle` and `report` of `demo --json`.

    Raises
    ------
    InputError
        Where the folder is not empty or cannot be made.
    """
    from trainer.captures.acquire import acquire_captures
    from trainer.captures.capture_set import read_captures
    from trainer.diagnosis.comparison import compare
    from trainer.diagnosis.explanation import explain
    from trainer.fitting.pool import open_pool
    from trainer.model.model_file import write_model
    from trainer.report import write_report

    say = progress or no_progress
    _make_empty(folder)
    spec = QUICK_BENCH if quick else BENCH
    headset = open_headset(spec, seed=1)
    bench = nominal_bench(headset)
    captures_folder, model_path, report_path = (folder / n for n in ("captures", "model.toml", "report.html"))
    acquire_captures(
        headset, bench, captures_folder, patterns=9 if quick else None,
        progress=part_of(say, 0.0, 0.1, "capturing"),
    )  # fmt: skip
    captures = read_captures(captures_folder)

    def keep(model: Model) -> None:
        write_model(model_path, model)

    with open_pool(workers) as pool:
        found = explain(
            captures, Model(captures.bench), catalogue(), pool, save=keep,
            progress=part_of(say, 0.1, 0.6, "explaining"),
        )  # fmt: skip
    keep(found.model)

    say(0.6, "exporting")
    bundles = {"before": folder / "bundle-ideal", "after": folder / "bundle"}
    export_bundle(Model(captures.bench), captures, bundles["before"])
    export_bundle(found.model, captures, bundles["after"])
    pictures = PICTURES[:1] if quick else PICTURES
    patterns = folder / "patterns"
    solved = _patterns(headset, captures.bench, bundles, pictures, patterns, part_of(say, 0.62, 0.87))
    say(0.88, "showing")
    with emulated(spec, seed=2) as devices:
        shown = [_show(devices, captures.bench, *each, patterns) for each in solved]

    say(0.94, "writing the report")
    display = {name: _mean([p.qualities[name] for p in shown]) for name in ("before", "after", "oracle")}
    sentence = (
        f"Explained by {listed(found.model.names) or 'nothing'}: the picture shown goes from "
        f"{display['before']['psnr_db']:.1f} to {display['after']['psnr_db']:.1f} dB (amplitude PSNR, seen "
        "by the camera); with the true bench known it is "
        f"{display['oracle']['psnr_db']:.1f} dB."
    )
    ladder = found.as_json(model_path)
    write_report(
        report_path, "hololoop demo", comparison=compare(captures, found.model), diagnosis=found.diagnosis,
        ladder=ladder, model=found.model,
    )  # fmt: skip
    html = with_display(report_path.read_text(encoding="utf-8"), shown, sentence)
    with whole_file(report_path, "w") as stream:
        stream.write(html)
    say(1.0, "done")
    return {
        "sentence": sentence,
        "found": list(found.model.names),
        "verdict": found.diagnosis.verdict,
        "steps": ladder["steps"],
        "noise_nrmse": ladder["noise_nrmse"],
        "display": display,
        "pictures": [{"picture": p.name, **{k: _numbers(q) for k, q in p.qualities.items()}} for p in shown],
        "captures": str(captures_folder),
        "model": str(model_path),
        "bundle": str(bundles["after"]),
        "report": str(report_path),
    }


def _make_empty(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            f"{folder} is there already and is not an empty folder: give another --out or remove it"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}): give another --out") from None


def _patterns(
    headset: VirtualHeadset,
    bench: Bench,
    bundles: dict[str, Path],
    pictures: Sequence[str],
    folder: Path,
    say: Progress,
) -> list[tuple[str, np.ndarray, dict[str, np.ndarray]]]:
    """(name, target, gray levels by source) of every picture; sources are the bundles and the oracle on `headset`."""
    channel = bench.channels[0].name
    paths = {name: load_light_path(read_bundle(bundle), channel) for name, bundle in bundles.items()}
    folder.mkdir()
    found = []
    for number, name in enumerate(pictures):
        begin, part = number / len(pictures), 1 / len(pictures)
        target = _target(name, bench.panel.shape)
        _write_picture(folder / f"{name}-target.png", target)
        gray = {}
        for k, (which, path) in enumerate(paths.items()):
            say(begin + 0.1 * k * part, f"solving: {name}, {which}")
            gray[which] = solve(path, target, ITERATIONS).gray
        gray["oracle"] = _oracle(
            headset, target, channel, gray["after"],
            part_of(say, begin + 0.2 * part, begin + part, f"asking the oracle: {name}"),
        )  # fmt: skip
        for which, levels in gray.items():
            write_pattern(folder / f"{name}-{which}.png", levels)
        found.append((name, target, gray))
    return found


def _show(
    devices: Devices, bench: Bench, name: str, target: np.ndarray, gray: dict[str, np.ndarray], folder: Path
) -> DisplayedPicture:
    """A picture with each of its patterns, as the camera measures it."""
    channel = bench.channels[0].name
    camera = {which: _capture(devices, bench, channel, levels, target) for which, levels in gray.items()}
    for which, one in camera.items():
        _write_picture(folder / f"{name}-{which}-seen.png", one.light)
    return DisplayedPicture(
        name,
        target,
        {which: one.light for which, one in camera.items()},
        {which: one.quality for which, one in camera.items()},
    )


def _target(name: str, shape: tuple[int, int]) -> np.ndarray:
    """A photograph's green part as linear irradiance [H, W]."""
    return fit_area(photograph(name)[1], shape).astype(np.float32)


def _oracle(
    headset: VirtualHeadset,
    target: np.ndarray,
    channel: str,
    start: np.ndarray,
    progress: Progress,
) -> np.ndarray:
    """The better of a start and of the oracle's pattern from it, by the quality on the true bench."""
    wanted = target.astype(np.float64)
    better = headset.oracle_pattern(
        wanted,
        channel,
        iterations=ORACLE_ITERATIONS,
        start=start,
        progress=lambda i, loss: progress(i / ORACLE_ITERATIONS),
    )
    return max(
        (start, better), key=lambda gray: quality(headset.true_irradiance(gray, channel), target).psnr_db
    )


def _capture(
    devices: Devices, bench: Bench, channel: str, gray: np.ndarray, target: np.ndarray
) -> CameraPicture:
    """The camera's picture of a pattern at an exposure that does not saturate, mean of several shots."""
    camera = devices.camera
    black = bench.camera.black_level * 2.0 ** (camera.bit_depth - bench.camera.bit_depth)
    devices.panel.show(gray)
    devices.light(channel)
    while (camera.capture() >= 2**camera.bit_depth - 1).mean() > SATURATED:
        camera.exposure_ms = camera.exposure_ms * 0.7
    shots = [camera.capture().astype(np.float64) - black for _ in range(SHOTS)]
    devices.lasers.off()
    light = np.mean(shots, axis=0) / camera.exposure_ms
    return CameraPicture(light, quality(light, target))


def _write_picture(path: Path, light: np.ndarray) -> None:
    """Irradiance as an sRGB picture, its 99.8th percentile white."""
    share = np.clip(light / max(float(np.percentile(light, 99.8)), 1e-12), 0, 1)
    with whole_file(path) as file:
        Image.fromarray(np.rint(255 * encode_srgb(share)).astype(np.uint8)).save(file, format="PNG")


def _numbers(q: Quality) -> dict[str, float]:
    return {"psnr_db": round(q.psnr_db, 3), "nrmse": round(q.nrmse, 5)}


def _mean(qualities: list[Quality]) -> dict[str, float]:
    psnr = float(np.mean([q.psnr_db for q in qualities]))
    return {"psnr_db": round(psnr, 3), "nrmse": round(float(np.mean([q.nrmse for q in qualities])), 5)}
