"""Training of the network that proposes the solver's first phase, on what the solver ends with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import INITIALISER, Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import bundle_paths, load_light_path
from runtime.lightpath.light_path import LightPath
from runtime.program.progress import Progress, part_of
from runtime.solver import Solver
from runtime.solver.targets import fit_area
from trainer.networks.initialiser_network import PATCH, InitialiserNetwork, initialiser_onnx
from trainer.training.photographs import photograph

PICTURES = (
    "astronaut", "coffee", "rocket", "retina", "hubble_deep_field", "immunohistochemistry", "camera", "moon", "coins",
    "chelsea",
)  # fmt: skip
HELD_OUT = 2  # of the pictures
ITERATIONS = 20  # of the solves that are learned from: later ones find what no network can know
REPORTED = 5  # iterations that the result is reported for
CROP = 160  # pixels, even, so that the chequerboard keeps its place
BATCH = 8


def train_initialiser(
    bundle: Bundle, steps: int, progress: Progress, seed: int = 0
) -> tuple[InitialiserNetwork, dict[str, list[float]]]:
    """A network for a bundle's only light path.

    Parameters
    ----------
    bundle : Bundle
        Of one colour and plane.
    steps : int
        Batches to learn from.
    progress : callable
        Called with the share done and what is being done.
    seed : int
        Of the first weights and the crops.

    Returns
    -------
    InitialiserNetwork
    dict of str to list of float, dB
        Under `double_phase` and `initialiser`, the PSNR after 0, 1, 2 ... iterations from that start, mean over
        pictures that were not learned from.

    Raises
    ------
    InputError
        For several colours or planes, and for a panel whose sides are no multiples of 4.
    """
    if len(bundle_paths(bundle)) > 1:
        raise InputError(
            "the bundle has several colours or planes, and an initialiser is for one: export one of them alone"
        )
    path = load_light_path(bundle)
    if any(n % PATCH for n in path.grid.shape):
        raise InputError(
            f"the panel is {path.grid.shape}: an initialiser needs sides that are multiples of {PATCH}"
        )
    torch.manual_seed(seed)
    pictures = [_picture(name, path.grid.shape) for name in PICTURES]
    learned, held_out = pictures[:-HELD_OUT], pictures[-HELD_OUT:]
    solver, solved = Solver(path), []
    for number, target in enumerate(learned):
        progress(0.5 * number / len(learned), "solving")
        for picture in (target, target[:, ::-1], target[::-1]):
            start = solver.solve(np.ascontiguousarray(picture), 0).phase.copy()
            phase = solver.solve(np.ascontiguousarray(picture), ITERATIONS).phase.copy()
            solved.append((_amplitude(picture), torch.tensor(start), torch.tensor(phase)))
    network = InitialiserNetwork()
    _fit(network, solved, steps, part_of(progress, 0.5, 0.9, "learning"))
    progress(0.9, "comparing")
    return network, {
        "double_phase": _psnr_by_iteration(path, None, held_out),
        "initialiser": _psnr_by_iteration(path, initialiser_onnx(network, path.grid.shape), held_out),
    }


def with_initialiser(
    folder: Path, steps: int, out: Path, progress: Progress, seed: int = 0, replace: bool = False
) -> dict[str, list[float]]:
    """Train for a bundle and write the bundle again with the network in it.

    Parameters
    ----------
    folder, out : path
        Of the bundle, and of the new one.
    steps, progress, seed
        As of `train_initialiser`.
    replace : bool
        Replace a folder that is not empty.

    Returns
    -------
    dict of str to list of float, dB
        As from `train_initialiser`.
    """
    bundle = read_bundle(folder)
    network, psnr_db = train_initialiser(bundle, steps, progress, seed)
    files = dict(bundle.networks) | {
        INITIALISER: initialiser_onnx(network, load_light_path(bundle).grid.shape)
    }
    write_bundle(out, bundle.arrays, bundle.description, bundle.provenance, networks=files, replace=replace)
    return psnr_db


def _fit(
    network: InitialiserNetwork,
    solved: Sequence[tuple[Tensor, Tensor, Tensor]],
    steps: int,
    progress: Progress,
) -> None:
    """Minimise one minus the cosine of the phase's error, over crops, by Adam with a falling rate."""
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(steps, 1))
    for step in range(steps):
        parts = [_crop(*solved[int(torch.randint(len(solved), ()))]) for _ in range(BATCH)]
        amplitude, start, phase = (torch.stack(whole)[:, None] for whole in zip(*parts, strict=True))
        cosine, sine = network(amplitude, start).split(1, 1)
        loss = 1 - (cosine * torch.cos(phase) + sine * torch.sin(phase)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        progress(step / steps)


def _crop(*arrays: Tensor) -> tuple[Tensor, ...]:
    """The same part of arrays [H, W]."""
    corner = [PATCH * int(torch.randint(max(n - CROP, 0) // PATCH + 1, ())) for n in arrays[0].shape]
    place = tuple(slice(c, c + CROP) for c in corner)
    return tuple(a[place] for a in arrays)


def _psnr_by_iteration(path: LightPath, onnx: bytes | None, pictures: Sequence[np.ndarray]) -> list[float]:
    """Best PSNR so far, dB, after 0, 1, 2 ... iterations, mean over pictures."""
    solver = Solver(path, initialiser=onnx)
    curves = [np.maximum.accumulate(solver.solve(target, REPORTED).psnr_db) for target in pictures]
    return [round(float(v), 3) for v in np.mean(curves, 0)]


def _amplitude(target: np.ndarray) -> Tensor:
    return torch.tensor(np.sqrt(target / target.mean()), dtype=torch.float32)


def _picture(name: str, shape: tuple[int, int]) -> np.ndarray:
    """A photograph's green plane, float32 [H, W]."""
    return fit_area(photograph(name)[1], shape).astype(np.float32)
