"""A small network that proposes the solver's first phase, learned from what the solver ends with.

The network sees a target's amplitude and answers with the panel's phase as cosine and sine. As in double phase,
neighbouring pixels on a chequerboard are turned opposite ways by an angle: the network gives that angle and what
it is turned about, starting from flat phase and the arc cosine of the amplitude, and learns how solved patterns
differ. It is local: light that walks further than its field of view it cannot know of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import INITIALISER, Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import bundle_paths, load_light_path
from runtime.lightpath.light_path import LightPath
from runtime.solver import Solver
from runtime.solver.targets import decode_srgb, fit_area
from trainer.networks.onnx_files import saved

PICTURES = (
    "astronaut", "coffee", "rocket", "retina", "hubble_deep_field", "immunohistochemistry", "camera", "moon", "coins",
    "chelsea",
)  # fmt: skip
HELD_OUT = 2  # of the pictures
ITERATIONS = 40  # of the solves that are learned from
SHOWN = 5  # iterations that the result is reported for
CROP = 160  # pixels, even, so that the chequerboard stays where it is
BATCH = 8
PATCH, WIDE = 4, 32
BRIGHT = 2.5  # amplitude, of mean square 1, that a pixel reaches with all of its light

Told = Callable[[float, str], None]


class InitialiserNetwork(nn.Module):
    """Amplitude [B, 1, H, W] to the cosine and sine [B, 2, H, W] of a phase; H and W are multiples of 4."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, WIDE, PATCH, PATCH)
        self.inner = nn.ModuleList(
            nn.Conv2d(WIDE, WIDE, 3, padding=spread, dilation=spread) for spread in (1, 2, 4, 8)
        )
        self.last = nn.ConvTranspose2d(WIDE, 2, PATCH, PATCH)
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, amplitude: Tensor) -> Tensor:
        x = torch.relu(self.first(amplitude))
        for layer in self.inner:
            x = x + torch.relu(layer(x))
        about, more = self.last(x).split(1, 1)
        share = 0.999 - torch.relu(0.999 - amplitude / BRIGHT)
        angle = torch.acos(share) + more
        phase = about + _chequer(amplitude) * angle
        return torch.cat((torch.cos(phase), torch.sin(phase)), 1)


def teach(
    bundle: Bundle, steps: int, told: Told, seed: int = 0
) -> tuple[InitialiserNetwork, dict[str, list[float]]]:
    """A network for a bundle's only light path, and how far iterations get from it and from double phase.

    That is the PSNR, dB, after 0, 1, 2 ... of them, mean over pictures that were not learned from. Raises
    InputError for several colours or planes.
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
        told(0.5 * number / len(learned), "solving")
        for picture in (target, target[:, ::-1], target[::-1]):
            solution = solver.solve(np.ascontiguousarray(picture), ITERATIONS)
            solved.append((_amplitude(picture), torch.tensor(solution.phase)))
    network = InitialiserNetwork()
    _fit(network, solved, steps, lambda done: told(0.5 + 0.4 * done, "learning"))
    told(0.9, "comparing")
    return network, {
        "double_phase": _reached(path, None, held_out),
        "initialiser": _reached(path, onnx_file(network, path.grid.shape), held_out),
    }


def with_initialiser(
    folder: Path, steps: int, out: Path, told: Told, seed: int = 0
) -> dict[str, list[float]]:
    """Teach for a bundle, write it again with the network in it, and return what `teach` found."""
    bundle = read_bundle(folder)
    network, found = teach(bundle, steps, told, seed)
    files = dict(bundle.networks) | {INITIALISER: onnx_file(network, load_light_path(bundle).grid.shape)}
    write_bundle(out, bundle.arrays, bundle.description, bundle.provenance, networks=files)
    return found


def onnx_file(network: InitialiserNetwork, shape: tuple[int, int]) -> bytes:
    """initialiser.onnx for a panel."""
    return saved(network.eval(), (torch.ones(1, 1, *shape),), ["target"], ["phase"])


def _fit(
    network: InitialiserNetwork,
    solved: Sequence[tuple[Tensor, Tensor]],
    steps: int,
    told: Callable[[float], None],
) -> None:
    """Lower one minus the cosine of the phase's error, over crops, by Adam with a falling rate."""
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(steps, 1))
    for step in range(steps):
        parts = [_crop(*solved[int(torch.randint(len(solved), ()))]) for _ in range(BATCH)]
        amplitude, phase = (torch.stack(whole)[:, None] for whole in zip(*parts, strict=True))
        cosine, sine = network(amplitude).split(1, 1)
        loss = 1 - (cosine * torch.cos(phase) + sine * torch.sin(phase)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        told(step / steps)


def _crop(amplitude: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    corner = [PATCH * int(torch.randint(max(n - CROP, 0) // PATCH + 1, ())) for n in amplitude.shape]
    place = tuple(slice(c, c + CROP) for c in corner)
    return amplitude[place], phase[place]


def _reached(path: LightPath, model: bytes | None, pictures: Sequence[np.ndarray]) -> list[float]:
    solver = Solver(path, initialiser=model)
    curves = [np.maximum.accumulate(solver.solve(target, SHOWN).psnr_db) for target in pictures]
    return [round(float(v), 3) for v in np.mean(curves, 0)]


def _amplitude(target: np.ndarray) -> Tensor:
    return torch.tensor(np.sqrt(target / target.mean()), dtype=torch.float32)


def _picture(name: str, shape: tuple[int, int]) -> np.ndarray:
    import skimage.data

    picture = np.asarray(getattr(skimage.data, name)(), float) / 255
    return fit_area(decode_srgb(picture[..., 1] if picture.ndim == 3 else picture), shape).astype(np.float32)


def _chequer(like: Tensor) -> Tensor:
    """1 and -1 on a chequerboard, [1, 1, H, W]; the runtime's double phase turns the same pixels the same way."""
    height, width = like.shape[-2:]
    odd = (torch.arange(height)[:, None] + torch.arange(width)[None, :]) % 2
    return (1 - 2 * odd).to(like.dtype)[None, None]
