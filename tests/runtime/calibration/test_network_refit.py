"""A network D on a new light path: refitted, kept or left out, as pictures that no fit has seen decide."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.calibration.bundle_replacement import replace_bundle
from runtime.calibration.network_refit import ColourPictures, checked_network
from runtime.calibration.self_calibration import calibrate
from runtime.calibration.summary import numbers
from runtime.networks.onnx_approximator import Approximator
from tests.runtime.benches import ideal_path, scene
from tests.runtime.calibration.drifting import (
    DISTANCE_MM,
    WAVELENGTH_NM,
    drifted_bench,
    headset,
    opened,
)
from tests.runtime.test_approximator import fall_off, made, networks

SHAPE = (64, 80)


def pictures(seen_through: np.ndarray, count: int, first_seed: int = 0) -> list[ColourPictures]:
    """Pictures [1, H, W] that a camera sees through a gain [H, W], at a scale of its own."""
    found = []
    for seed in range(first_seed, first_seed + count):
        light = scene(SHAPE, seed)[None].astype(np.float32)
        light /= light.mean()
        found.append(ColourPictures(light, (137 * light * seen_through).astype(np.float32)))
    return found


def test_what_d_no_longer_has_to_correct_leaves_it_out() -> None:
    check = checked_network(
        made(fall_off(SHAPE)), pictures(np.ones(SHAPE), 3), pictures(np.ones(SHAPE), 2, 5)
    )
    assert check.outcome == "left_out" and check.errors["left_out"] < 1e-9 < check.errors["kept"]
    before = {APPROXIMATOR: b"a", GRADIENT: b"b", ADAPTERS: b"c", "initialiser.onnx": b"d"}
    assert check.networks(before) == {"initialiser.onnx": b"d"}


def test_what_d_still_corrects_keeps_it() -> None:
    gain = fall_off(SHAPE)
    check = checked_network(made(gain), pictures(gain[0, 0], 3), pictures(gain[0, 0], 2, 5))
    assert check.outcome == "kept" and "refitted" not in check.errors  # this export has its adapters built in
    assert check.networks({APPROXIMATOR: b"a", ADAPTERS: b"c"}) == {APPROXIMATOR: b"a", ADAPTERS: b"c"}


@pytest.fixture(scope="module")
def identity() -> dict[str, bytes]:
    """A small approximator as the trainer exports it, before any training: the identity."""
    torch = pytest.importorskip("torch")
    from trainer.networks.approximator import Approximator as Network
    from trainer.networks.approximator import Architecture
    from trainer.networks.onnx_files import onnx_files

    torch.manual_seed(0)
    return onnx_files(Network(Architecture("compact", 8, SHAPE, 1)))


def opened_network(files: dict[str, bytes]) -> Approximator:
    adapters = safetensors.numpy.load(files[ADAPTERS])
    return Approximator((1, *SHAPE), files[APPROXIMATOR], files[GRADIENT], adapters)


def test_adapters_learn_what_the_new_light_path_misses(identity: dict[str, bytes]) -> None:
    """A camera that sees amplitudes above the mean weaker, as a bent response does, in pictures not learned from."""

    def bent(count: int, seed: int) -> list[ColourPictures]:
        plain = pictures(np.ones(SHAPE), count, seed)
        return [ColourPictures(p.simulated, p.captured / (1 + 0.4 * p.simulated)) for p in plain]

    d = opened_network(identity)
    check = checked_network(d, bent(6, 0), bent(2, 20))
    assert check.outcome == "refitted"
    assert check.errors["refitted"] < 0.8 * min(check.errors["kept"], check.errors["left_out"])
    after = check.networks(identity)
    assert after[APPROXIMATOR] == identity[APPROXIMATOR] and after[ADAPTERS] != identity[ADAPTERS]
    # what is written gives, on the next start, the error that decided
    again = checked_network(opened_network(after), [], bent(2, 20))
    assert again.errors["kept"] == pytest.approx(check.errors["refitted"], rel=1e-4)


@pytest.mark.usefixtures("spared_maps")
def test_a_calibration_decides_for_the_bundle(tmp_path: Path) -> None:
    """The network believes in a fall-off of light that is not there; the panel is bent: the light path is replaced."""
    folder = tmp_path / "bundle"
    path = ideal_path(SHAPE, DISTANCE_MM * 1e-3, dtype=np.float32)
    records, arrays = pack_light_paths([("green", DISTANCE_MM, WAVELENGTH_NM, path)])
    description = {"paths": records, "distance_mm": DISTANCE_MM}
    write_bundle(folder, arrays, description, {}, networks=networks(fall_off(SHAPE)))
    bundle = read_bundle(folder)
    found = calibrate(opened(headset(drifted_bench("panel_wavefront", shape=SHAPE))), bundle)
    assert found.verdict == "recalibrated" and found.network is not None
    assert numbers(found)["network"]["outcome"] == "left_out"
    assert found.network.errors["left_out"] < 0.5 * found.network.errors["kept"]
    kept = replace_bundle(folder, bundle, found)
    assert not set(read_bundle(folder).networks) & {APPROXIMATOR, GRADIENT, ADAPTERS}
    assert read_bundle(kept).networks == bundle.networks
