"""What is gained: a target with patterns for the ideal and for the explained model, as a bench displays them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_iface.errors import InputError
from firmware_iface.virtual import VirtualHeadset
from runtime.bundle.whole_files import whole_file
from runtime.lightpath.light_path import LightPath
from runtime.solver import quality, shown, solve
from runtime.solver.picture_files import encode_srgb, white_of
from runtime.solver.targets import fit_area
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import opened
from trainer.captures.open_bench import open_bench
from trainer.model.bundle_export import acting_on_display, baked_path, export_bundle
from trainer.model.model import Model
from trainer.studio.guess_benches import guess_bench, noted
from trainer.studio.jobs import Say
from trainer.training.photographs import photograph

PREDICTED, OWN = "prediction of the explained model", "the simulated bench of these captures"
PICTURES = ("astronaut", "coffee", "cat")
ITERATIONS = 60
SHOTS = 4
SATURATED = 0.001
AIM = 0.8  # of full scale, for the brightest pixels


@dataclass(frozen=True)
class GainPicture:
    """A target, and how it is displayed.

    Attributes
    ----------
    name, channel : str
    where : str
        What displayed it.
    target, ideal, explained : float32 array [h, w], 0 to 1
        Encoded for a screen; the last two as displayed with patterns of the two models.
    ideal_db, explained_db : float, dB
        Amplitude PSNR, after one free scale a picture.
    """

    name: str
    channel: str
    where: str
    target: np.ndarray
    ideal: np.ndarray
    explained: np.ndarray
    ideal_db: float
    explained_db: float


def show_gain(
    say: Say, folder: Path, model: Model, picture: str, channel: str, plane_mm: float, where: str
) -> GainPicture:
    """Solve a picture for both models, and display it.

    Parameters
    ----------
    picture : str
        One of PICTURES.
    where : str
        PREDICTED, OWN, `virtual:NAME`, or the path of a virtual bench or of a real headset's configuration.

    Raises
    ------
    InputError
        Where the bench cannot be opened, or its camera does not see the panel's own pixels.
    """
    bench = opened(folder).bench
    say("progress", (0.05, "preparing both models"))
    explained = baked_path(acting_on_display(model), channel, plane_mm)
    paths = {"ideal": baked_path(Model(bench), channel, plane_mm), "explained": explained}
    colour = {"red": 0, "green": 1, "blue": 2}.get(channel, 1)
    target = fit_area(photograph(picture)[colour], bench.panel.shape).astype(np.float32)
    gray = {}
    for k, (name, path) in enumerate(paths.items()):
        say("progress", (0.1 + 0.35 * k, f"solving {picture} for the {name} model"))
        gray[name] = solve(path, target, ITERATIONS).gray
    say("progress", (0.85, f"showing {picture}"))
    light = _displayed(folder, bench, explained, gray, channel, plane_mm, where)
    found = {name: quality(one, target) for name, one in light.items()}
    return GainPicture(
        picture,
        channel,
        where,
        _encoded(target),
        _encoded(light["ideal"]),
        _encoded(light["explained"]),
        found["ideal"].psnr_db,
        found["explained"].psnr_db,
    )


def export_model(say: Say, folder: Path, model: Model, network: Path | None, out: Path) -> dict[str, Any]:
    """Write the bundle for the headset, with the network in a file where there is one."""
    say("progress", (0.2, "writing the bundle"))
    return dict(export_bundle(model, opened(folder), out, network=network))


def keep(picture: GainPicture, path: Path) -> None:
    """Keep a displayed picture in a file."""
    with whole_file(path) as file:
        arrays: dict[str, Any] = {k: np.asarray(v) for k, v in vars(picture).items()}
        np.savez_compressed(file, **arrays)


def recorded(path: Path) -> GainPicture:
    """A displayed picture that was kept.

    Raises
    ------
    InputError
        Where the file is none.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            values: dict[str, Any] = {k: str(data[k]) for k in ("name", "channel", "where")}
            values |= {k: data[k].astype(np.float32) for k in ("target", "ideal", "explained")}
            values |= {k: float(data[k]) for k in ("ideal_db", "explained_db")}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path} holds no displayed picture ({error}): give a file that this page has kept"
        ) from None
    return GainPicture(**values)


def _displayed(
    folder: Path,
    bench: Bench,
    explained: LightPath,
    gray: dict[str, np.ndarray],
    channel: str,
    plane_mm: float,
    where: str,
) -> dict[str, np.ndarray]:
    if where == PREDICTED:
        return {name: shown(explained, levels) for name, levels in gray.items()}
    with _opened(folder, bench, where) as (headset, known):
        if not known.camera.registered:
            raise InputError(
                f"the camera of {where} does not see the panel's own pixels: "
                "choose the prediction of the explained model"
            )
        headset.move_to_plane(plane_mm)
        try:
            return {name: _capture(headset, known, channel, levels) for name, levels in gray.items()}
        finally:
            headset.lasers.off()


@contextmanager
def _opened(folder: Path, bench: Bench, where: str) -> Iterator[tuple[Any, Bench]]:
    if where == OWN:
        note = noted(folder)
        if note is None:
            raise InputError(
                "these captures were not taken from a simulated bench of this page: choose another display"
            )
        yield VirtualHeadset(guess_bench(*note), seed=note[1] + 1), bench
        return
    from runtime.headset.open_devices import configuration_of

    known = None if where.startswith("virtual:") or configuration_of(where) is None else bench
    with open_bench(where, 1, known) as one:
        if one.bench.panel.shape != bench.panel.shape:
            raise InputError(
                f"the panel of {where} is not that of these captures: choose the bench that they are of"
            )
        yield one.headset, bench


def _capture(headset: Any, bench: Bench, channel: str, gray: np.ndarray) -> np.ndarray:
    """The camera's picture of a pattern at a good exposure, mean of several shots, counts above black a millisecond."""
    camera, top = headset.camera, bench.camera
    headset.lasers.off()
    headset.lasers.set_power(channel, 1.0)
    headset.panel.show(gray)
    for _ in range(12):
        counts = np.asarray(camera.capture())
        if float((counts >= top.saturation).mean()) > SATURATED:
            camera.exposure_ms = camera.exposure_ms / 2
            continue
        bright = float(np.percentile(counts, 99.8)) - top.black_level
        wanted = camera.exposure_ms * AIM * top.full_scale / max(bright, 1.0)
        if bright > 0.5 * top.full_scale or wanted <= camera.exposure_ms:
            break
        camera.exposure_ms = min(wanted, float(camera.longest_exposure_ms))
    shots = [np.asarray(camera.capture()).astype(np.float64) - top.black_level for _ in range(SHOTS)]
    return np.asarray(np.mean(shots, axis=0) / camera.exposure_ms)


def _encoded(light: np.ndarray) -> np.ndarray:
    return np.asarray(encode_srgb(light / white_of(light)), dtype=np.float32)
