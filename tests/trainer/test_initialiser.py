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
    assert np.abs(np.exp(1j * begun) - np.exp(1j * Solver(path).solve(target, 0).phase)).mean() > 0.001


def test_an_untaught_network_begins_as_double_phase_does() -> None:
    path, target = ideal_path(SHAPE, 6e-3, 0.5, np.float32), scene(SHAPE)
    untaught = initialiser_onnx(InitialiserNetwork(), SHAPE)
    begun = Solver(path, initialiser=untaught).solve(target, 0).phase
    plain = Solver(path).solve(target, 0).phase
    np.testing.assert_allclose(np.exp(1j * begun), np.exp(1j * plain), atol=1e-4)


def test_it_corrects_double_phase_behind_an_iris_that_is_half_open() -> None:
    """Taught on some scenes, it is ahead of double phase on another, at the start and after an iteration."""
    torch.manual_seed(2)
    path = ideal_path(SHAPE, 6e-3, 0.5, np.float32)
    solver, solved = Solver(path), []
    for seed in range(12):
        target = scene(SHAPE, seed)
        amplitude = torch.tensor(np.sqrt(target / target.mean()), dtype=torch.float32)
        phases = [torch.tensor(solver.solve(target, k).phase.copy()) for k in (0, 20)]
        solved.append((amplitude, *phases))
    network = InitialiserNetwork()
    _fit(network, solved, 150, lambda done: None)
    target = scene(SHAPE, 20)
    taught = Solver(path, initialiser=initialiser_onnx(network, SHAPE)).solve(target, 1).psnr_db
    plain = Solver(path).solve(target, 1).psnr_db
    assert taught[0] > plain[0] + 0.3 and taught[1] > plain[1] + 0.1


def test_onnx_says_what_torch_says() -> None:
    import onnxruntime

    network = InitialiserNetwork()
    for weight in network.parameters():
        torch.nn.init.normal_(weight, 0, 0.05)
    amplitude, start = torch.rand(2, 1, 1, *SHAPE) * 2
    session = onnxruntime.InferenceSession(initialiser_onnx(network, SHAPE))
    (phase,) = session.run(["phase"], {"target": amplitude.numpy(), "start": start.numpy()})
    with torch.no_grad():
        np.testing.assert_allclose(phase, network(amplitude, start).numpy(), atol=1e-4)


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
