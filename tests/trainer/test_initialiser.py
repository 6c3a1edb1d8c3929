"""The initialiser: what it learns, and that the headset's solver begins with it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from runtime.bundle.bundle_folder import INITIALISER, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.solver import Solver
from tests.runtime.benches import ideal_path, scene
from trainer.cli import main
from trainer.networks.initialiser_network import InitialiserNetwork, initialiser_onnx
from trainer.training.train_initialiser import _fit

SHAPE = (48, 64)


def bundle(folder: Path, shape: tuple[int, int] = SHAPE, planes: tuple[float, ...] = (6.0,)) -> Path:
    paths = [("green", z, 520.0, ideal_path(shape, z * 1e-3, 0.5, np.float32)) for z in planes]
    records, arrays = pack_light_paths(paths)
    write_bundle(folder, arrays, {"paths": records}, {"code_version": "1"})
    return folder


def test_the_command_writes_a_bundle_whose_solver_begins_with_the_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = bundle(tmp_path / "old")
    assert main(["initialiser", str(old), "--out", str(tmp_path / "new"), "--steps", "3", "--json"]) == 0
    held = json.loads(capsys.readouterr().out)["heldout_psnr_db"]
    assert len(held["initialiser"]) == len(held["double_phase"])
    new = read_bundle(tmp_path / "new")
    assert new.provenance == read_bundle(old).provenance
    path, target = load_light_path(new), scene(SHAPE)
    begun = Solver(path, initialiser=new.networks[INITIALISER]).solve(target, 0).phase
    assert np.abs(np.exp(1j * begun) - np.exp(1j * Solver(path).solve(target, 0).phase)).mean() > 0.05


def test_onnx_says_what_torch_says() -> None:
    import onnxruntime

    network = InitialiserNetwork()
    for weight in network.parameters():
        torch.nn.init.normal_(weight, 0, 0.05)
    amplitude = torch.rand(1, 1, *SHAPE) * 2
    session = onnxruntime.InferenceSession(initialiser_onnx(network, SHAPE))
    (phase,) = session.run(["phase"], {"target": amplitude.numpy()})
    with torch.no_grad():
        np.testing.assert_allclose(phase, network(amplitude).numpy(), atol=1e-4)


def test_it_learns_a_phase_that_the_amplitude_determines() -> None:
    """A made-up solver whose phase is the amplitude itself: after some steps the network knows it."""
    torch.manual_seed(1)
    network = InitialiserNetwork()
    amplitude = torch.tensor(np.sqrt(scene(SHAPE) / scene(SHAPE).mean()), dtype=torch.float32)
    with torch.no_grad():
        cosine, sine = network(amplitude[None, None])[0]
    wanted = torch.atan2(sine, cosine) + 0.7

    def error() -> float:
        with torch.no_grad():
            c, s = network(amplitude[None, None])[0]
            return float(1 - (c * torch.cos(wanted) + s * torch.sin(wanted)).mean())

    before = error()
    _fit(network, [(amplitude, wanted)], 40, lambda done: None)
    assert error() < 0.2 * before


@pytest.mark.parametrize(
    ("shape", "planes", "message"),
    [((48, 66), (6.0,), "multiples of 4"), (SHAPE, (4.0, 6.0), "several colours or planes")],
)
def test_bundles_that_it_is_not_for(
    tmp_path: Path,
    shape: tuple[int, int],
    planes: tuple[float, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    old = bundle(tmp_path / "old", shape, planes)
    assert main(["initialiser", str(old), "--out", str(tmp_path / "new")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "new").exists()
