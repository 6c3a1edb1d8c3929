"""Phase retrieval for the cycle: named methods, from a target volume to gray levels of each colour.

    double_phase, gerchberg_saxton, wirtinger   through the model's light path (Hsueh and Sawchuk 1978; Gerchberg and
                                                Saxton 1972; Chakravarthula et al. 2019)
    wirtinger_no_zero_order                     the same, with the iris next to the zero order and a ramp on the pattern
    hardware_in_the_loop                        Wirtinger descent through light path and network
                                                (Chakravarthula et al. 2020, eq. 14-23)

All but the last are the headset's own solver. The last, and every stack of planes, differentiates the trainer's light
path and the network together: a network that is still learning has no ONNX file, and the solver's stacks have no
approximator.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from firmware_iface.errors import InputError, nearest
from runtime.lightpath.light_path import LightPath, irradiance, panel_phase, pixel_irradiance
from runtime.program.progress import Progress
from runtime.solver import DriveRange, solve
from trainer.cycle.target_pictures import TargetVolume
from trainer.device import array_of
from trainer.effects.effect_catalogue import BUILT_IN
from trainer.model.bundle_export import acting_on_display, baked_path
from trainer.model.model import Model, instance_with
from trainer.model.model_stages import scene_for, stages_of
from trainer.networks.approximator import Approximator, penalty
from trainer.prediction.predict import light_path

SOLVERS = {
    "double_phase": "double_phase",
    "gerchberg_saxton": "gerchberg_saxton",
    "wirtinger": "bfgs",
    "wirtinger_no_zero_order": "bfgs",
    "hardware_in_the_loop": "bfgs",
}
METHODS = tuple(SOLVERS)
ITERATIONS = 60
RATE, BETAS = 0.05, (0.8, 0.95)  # of Adam, rad: quick and without overshoot from a start that is nearly right
# Of the panel's band: centre of the iris that keeps the zero order out, and its half width.
CARRIER, OPENING = 0.3, 0.26


def beside_zero_order(model: Model) -> Model:
    """The model with the iris next to the zero order (Chakravarthula et al. 2020, section 5).

    Patterns then carry a phase ramp, which takes the picture's band into the iris; undiffracted light stays out.
    """
    iris = next(effect for effect in BUILT_IN if effect.name == "iris")
    return model.having(instance_with(iris, model.bench, {"half_width": OPENING, "centre_y": CARRIER}))


def retrieve(
    model: Model,
    wanted: TargetVolume,
    method: str = "hardware_in_the_loop",
    network: Approximator | None = None,
    iterations: int = ITERATIONS,
    progress: Progress | None = None,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Patterns that show a target.

    Parameters
    ----------
    model : Model
        Of the bench; effects that act on the camera alone are left out.
    wanted : TargetVolume
        What is to be shown.
    method : str
        One of `METHODS`.
    network : Approximator or None
        The approximator of `hardware_in_the_loop`; None is the identity, which makes it plain Wirtinger descent.
    iterations : int
        Of the descent.
    progress : callable or None
        Called with the share done.
    start : uint8 array [C, H, W] or None
        Gray levels to begin from, where the method descends.

    Returns
    -------
    uint8 array [C, H, W]
        Gray levels of each colour.

    Raises
    ------
    InputError
        For an unknown method, and for a method of one plane with a volume of several.
    """
    if method not in METHODS:
        raise InputError(f"there is no phase retrieval '{method}': {nearest(method, METHODS)}")
    model = acting_on_display(model)
    if method == "wirtinger_no_zero_order":
        model = beside_zero_order(model)
    if method != "hardware_in_the_loop":
        network = None
    if SOLVERS[method] != "bfgs":
        start = None
    if network is not None or (len(wanted.planes_mm) > 1 and SOLVERS[method] == "bfgs"):
        return _through_network(model, wanted, network, iterations, progress, start)
    if len(wanted.planes_mm) > 1:
        raise InputError(
            f"'{method}' shows one plane and {wanted.name} has {len(wanted.planes_mm)}: use wirtinger or "
            "hardware_in_the_loop"
        )
    baked = [baked_path(model, c.name, wanted.planes_mm[0]) for c in model.bench.channels]
    return np.stack([_solved(path, wanted, c, method, iterations, start)[0] for c, path in enumerate(baked)])


def _solved(
    path: LightPath,
    wanted: TargetVolume,
    colour: int,
    method: str,
    iterations: int,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gray levels and phase [H, W] of one colour and plane, by the headset's solver."""
    phase = None if start is None else panel_phase(path, start[colour].astype(np.int64))
    solution = solve(path, wanted.irradiance[0, colour], iterations, method=SOLVERS[method], start=phase)
    return solution.gray.copy(), solution.phase.copy()


def _through_network(
    model: Model,
    wanted: TargetVolume,
    network: Approximator | None,
    iterations: int,
    progress: Progress | None,
    start: np.ndarray | None,
) -> np.ndarray:
    """Adam on the penalty of the network's corrected irradiance, all colours and planes at once.

    It begins with `start`, or with the solver's result without the network for the plane that counts most, and returns
    the best pattern of all steps.
    """
    first = int(np.argmax(wanted.weight.sum((1, 2))))
    plane = wanted.planes_mm[first]
    flat = TargetVolume.flat(wanted.name, plane, np.sum(wanted.weight[:, None] * wanted.irradiance, 0))
    baked = [baked_path(model, c.name, plane) for c in model.bench.channels]
    if start is None:
        begin = [_solved(path, flat, c, "wirtinger", iterations)[1] for c, path in enumerate(baked)]
    else:
        begin = [panel_phase(path, gray.astype(np.int64)) for path, gray in zip(baked, start, strict=True)]
    phase = torch.tensor(np.stack(begin), dtype=torch.float32).requires_grad_(True)
    if network is not None and phase.device.type != "cpu":  # where networks stay
        network = copy.deepcopy(network).to(phase.device)
    paths = [[torch_path(model, c.name, z) for c in model.bench.channels] for z in wanted.planes_mm]
    target = torch.as_tensor(wanted.irradiance, dtype=torch.float32)
    weight = torch.as_tensor(wanted.weight, dtype=torch.float32)[:, None]
    target = target / ((target * weight).sum() / (weight.sum() * target.shape[1])).clamp(min=1e-12)
    drives = [DriveRange(path) for path in baked]
    adam = torch.optim.Adam([phase], lr=RATE, betas=BETAS)
    best, least = phase.detach().clone(), float("inf")
    for step in range(iterations + 1):
        loss = loss_of(phase, paths, target, weight, network)
        if loss.item() < least:
            best, least = phase.detach().clone(), loss.item()
        if progress:
            progress(step / max(iterations, 1))
        if step < iterations:
            (phase.grad,) = torch.autograd.grad(loss, [phase])
            adam.step()
            with torch.no_grad():
                for c, drive in enumerate(drives):
                    if drive.bounded:
                        phase[c] = torch.as_tensor(drive.held(array_of(phase[c])), dtype=phase.dtype)
    return np.stack([drive.gray(p) for drive, p in zip(drives, array_of(best), strict=True)])


def loss_of(
    phase: Tensor,
    paths: list[list[LightPath]],
    target: Tensor,
    weight: Tensor,
    network: Callable[[Tensor], Tensor] | None,
) -> Tensor:
    """The penalty of phases, sum over planes, colours and pixels that count.

    Parameters
    ----------
    phase : Tensor [C, H, W], rad
        Of the panel, for each colour.
    paths : list of list of LightPath
        [K][C], on tensors.
    target : Tensor [K, C, H, W]
        Wanted irradiance; each colour is scaled to the corrected irradiance.
    weight : Tensor [K, 1, H, W]
        How much a pixel of a plane counts.
    network : callable or None
        The approximator; None is the identity.
    """
    light = torch.stack(
        [torch.stack([_light(path, phase[c]) for c, path in enumerate(row)]) for row in paths]
    )
    corrected = light if network is None else network(light)
    with torch.no_grad():
        root, wanted = torch.sqrt(corrected.clamp(min=0)), torch.sqrt(target)
        scale = (
            (root * wanted * weight).sum((0, 2, 3)) / (target * weight).sum((0, 2, 3)).clamp(min=1e-12)
        ) ** 2
    return penalty(corrected, target * scale[None, :, None, None], weight)


def torch_path(model: Model, channel: str, plane_mm: float, dtype: torch.dtype = torch.float32) -> LightPath:
    """A model's light path for one colour and plane, on tensors."""
    with torch.no_grad():
        scene = scene_for(model, channel, plane_mm, dtype)
        return light_path(scene, stages_of(scene, model))


def _light(path: LightPath, phase: Tensor) -> Tensor:
    return pixel_irradiance(path, irradiance(path, phase))
