"""A displayed picture gets better by the camera's captures; refinement stops, rolls back, logs, and sets no laser."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from PIL import Image

from firmware_iface.errors import InputError
from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.defects import make_defect
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT, write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.camera.view import View
from runtime.cli import main
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import Approximator
from runtime.refinement.panel_and_camera import PanelAndCamera
from runtime.refinement.picture_refinement import HOLD_OUT, Refinement, _to_step, refine
from runtime.solver import solve
from tests.runtime.benches import converted, ideal_path, scene

SHAPE, DISTANCE_MM = (64, 80), 8.0


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    """A small approximator as the trainer exports it, before any training: the identity."""
    torch = pytest.importorskip("torch")
    from trainer.networks.approximator import Approximator as Network
    from trainer.networks.approximator import Architecture
    from trainer.networks.onnx_files import onnx_files

    torch.manual_seed(0)
    return onnx_files(Network(Architecture("compact", 8, SHAPE, 1)))


@pytest.fixture
def approximator(files: dict[str, bytes]) -> Approximator:
    adapters = safetensors.numpy.load(files[ADAPTERS])
    return Approximator((1, *SHAPE), files[APPROXIMATOR], files[GRADIENT], adapters)


@pytest.fixture(scope="module")
def path() -> LightPath:
    return ideal_path(SHAPE, DISTANCE_MM * 1e-3, dtype=np.float32)


@pytest.fixture(scope="module")
def start(path: LightPath) -> np.ndarray:
    return np.asarray(solve(path, scene(SHAPE), 20).phase).reshape(1, *SHAPE)


def lit_headset(*defects: str) -> VirtualHeadset:
    """A bench with hidden defects, its laser on."""
    bench = BenchDescription(defects=tuple(make_defect(kind) for kind in defects))
    headset = VirtualHeadset(bench.resized(*SHAPE, DISTANCE_MM), seed=2)
    headset.lasers.set_power("green", 0.8)
    headset.camera.exposure_ms = 25.0
    return headset


def panel_and_camera_of(headset: VirtualHeadset) -> PanelAndCamera:
    return PanelAndCamera(headset.panel, headset.camera, View(SHAPE), 64.0)


def test_a_refinement_waits_for_a_slow_panel() -> None:
    headset, plain = lit_headset("slow_response"), lit_headset()
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 256, (2, 1, *SHAPE), dtype=np.uint8)
    seen = []
    for one, settling in ((headset, 2), (plain, 0)):
        take = PanelAndCamera(one.panel, one.camera, View(SHAPE), 64.0, settling=settling)
        take(first)
        seen.append(take(second))
    soon = panel_and_camera_of(headset)
    soon(first)
    noise = np.abs(seen[0] - seen[1]).mean()
    assert np.abs(soon(second) - seen[1]).mean() > 1.5 * noise


@pytest.mark.parametrize(
    ("defect", "better_db"), [("phase_response", 6.0), ("zero_order", 4.0), ("ghost", 2.0)]
)
def test_the_displayed_picture_gets_better(
    approximator: Approximator, path: LightPath, start: np.ndarray, defect: str, better_db: float
) -> None:
    """Judged by the true irradiance without the camera's noise, not by the pictures that were learned from."""
    from runtime.solver import quality

    headset = lit_headset(defect)
    target = scene(SHAPE)[None]
    state = Refinement([path], approximator, target, start)
    before = quality(headset.true_irradiance(state.gray[0], "green"), target[0]).psnr_db
    steps = refine(state, panel_and_camera_of(headset), 30)
    after = quality(headset.true_irradiance(headset.panel.gray, "green"), target[0]).psnr_db
    assert after > before + better_db
    np.testing.assert_array_equal(headset.panel.gray, state.gray[0])  # the best is what stays on the panel
    assert max(s.psnr_db for s in steps) > steps[0].psnr_db + better_db


def test_the_adapters_learn_from_captures(
    approximator: Approximator, path: LightPath, start: np.ndarray
) -> None:
    """D learns, and only from captures that are not held out."""
    state = Refinement([path], approximator, scene(SHAPE)[None], start)
    steps = refine(state, panel_and_camera_of(lit_headset("ghost")), 13)
    held = [s for s in steps if s.held_out]
    assert [s.number for s in held] == [1, 4, 7, 10, 13]
    assert all(s.heldout == held[0].heldout for s in steps[:HOLD_OUT])
    assert 0 < steps[1].drift < steps[-1].drift


def test_it_stops_where_the_held_out_error_rises_and_keeps_the_best(
    approximator: Approximator, path: LightPath, start: np.ndarray
) -> None:
    """The captures are shifted, except when one is held out: the adapters learn something wrong."""
    headset = lit_headset()
    capture, count = panel_and_camera_of(headset), 0

    def show_and_capture(gray: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        captured = capture(gray)
        return captured if count < 8 or (count - 1) % HOLD_OUT == 0 else np.roll(captured, 17, axis=2)

    state = Refinement([path], approximator, scene(SHAPE)[None], start)
    steps = refine(state, show_and_capture, 60)
    assert steps[-1].stopped == "the held-out error rises" and 10 <= len(steps) < 40
    assert all(s.stopped is None for s in steps[:-1])
    worst = max(s.drift for s in steps)
    assert steps[-1].drift < worst  # put back to where held-out captures were predicted best
    with pytest.raises(InputError, match="held-out error rises"):
        state.take(np.ones((1, *SHAPE)))


def test_it_can_be_rolled_back(approximator: Approximator, path: LightPath, start: np.ndarray) -> None:
    before = {name: weights.copy() for name, weights in approximator.adapters.items()}
    state = Refinement([path], approximator, scene(SHAPE)[None], start)
    first = state.gray
    refine(state, panel_and_camera_of(lit_headset("ghost")), 5)
    assert any((approximator.adapters[n] != w).any() for n, w in before.items())
    state.rollback()
    assert state.stopped is None
    np.testing.assert_array_equal(state.gray, first)
    for name, weights in before.items():
        np.testing.assert_array_equal(approximator.adapters[name], weights)
    assert state.take(np.ones((1, *SHAPE), np.float32)).number == 6  # the log goes on


def test_every_capture_is_a_line_of_the_drift_log(
    approximator: Approximator, path: LightPath, start: np.ndarray
) -> None:
    log = io.StringIO()
    state = Refinement([path], approximator, scene(SHAPE)[None], start, log)
    steps = refine(state, panel_and_camera_of(lit_headset()), 4)
    lines = [json.loads(line) for line in log.getvalue().splitlines()]
    assert [line["number"] for line in lines] == [1, 2, 3, 4]
    assert lines[2]["drift"] == steps[2].drift and lines[0]["held_out"] and not lines[1]["held_out"]


def test_it_never_moves_the_laser(approximator: Approximator, path: LightPath, start: np.ndarray) -> None:
    headset = lit_headset("ghost")
    asked: list[str] = []

    def refuse(name: str) -> Callable[..., None]:
        return lambda *given: asked.append(name)

    for name in ("set_power", "off"):
        setattr(headset.lasers, name, refuse(name))
    panel_and_camera = panel_and_camera_of(headset)
    refine(Refinement([path], approximator, scene(SHAPE)[None], start), panel_and_camera, 6)
    assert asked == [] and headset.lasers.power("green") == 0.8 and headset.camera.exposure_ms == 25.0
    assert not any(value is headset.lasers for value in vars(panel_and_camera).values())


def test_where_camera_and_model_agree_the_gradient_is_the_models(
    approximator: Approximator, path: LightPath, start: np.ndarray
) -> None:
    """The captured picture takes the place of the simulated one: given the simulated one, it is plain descent."""
    from runtime.lightpath.light_path import irradiance, pixel_irradiance
    from runtime.lightpath.light_path_adjoint import irradiance_and_pullback
    from runtime.refinement.picture_refinement import STEP, _amplitude, matched

    target = scene(SHAPE)[None]
    start = start + np.random.default_rng(0).normal(0, 0.5, start.shape).astype(np.float32)
    state = Refinement([path], approximator, target, start)
    light = pixel_irradiance(path, irradiance(path, start[0].astype(np.float32)))
    state.take(7.5 * light[None])  # any scale
    image, pullback = irradiance_and_pullback(path, start[0].astype(np.float32))
    simulated = pixel_irradiance(path, image)
    simulated /= simulated.mean()
    made = _amplitude(simulated)
    slope = (made - _amplitude(matched(target[0], simulated))) / made  # D is the identity
    wanted = start[0] - STEP * _to_step(path, pullback)(slope.astype(np.float32))
    moved = np.angle(np.exp(1j * (state.phase[0] - wanted)))
    # 255 steps of a 256th of a turn leave a gap: phases in it are held at its nearer edge
    assert np.abs(moved).max() < 1.01 * np.pi / 256 and np.quantile(np.abs(moved), 0.9) < 1e-3
    assert np.abs(wanted - start[0]).max() > 0.05


def test_sizes_that_differ_are_refused(
    files: dict[str, bytes], approximator: Approximator, path: LightPath, start: np.ndarray
) -> None:
    target = scene(SHAPE)[None]
    with pytest.raises(InputError, match="no adapters"):
        Refinement([path], Approximator((1, *SHAPE), files[APPROXIMATOR]), target, start)
    with pytest.raises(InputError, match="one size"):
        Refinement([path], approximator, target[:, :-1], start)
    state = Refinement([path], approximator, target, start)
    with pytest.raises(InputError, match="captured picture"):
        state.take(np.ones(SHAPE))


def test_the_command_refines_a_picture_and_changes_neither_bundle_nor_lasers(
    files: dict[str, bytes],
    path: LightPath,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from firmware_iface import virtual

    records, arrays = pack_light_paths([("green", DISTANCE_MM, 520.0, path)])
    bundle = tmp_path / "bundle"
    write_bundle(bundle, arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {}, networks=files)
    before = {p.name: p.read_bytes() for p in bundle.iterdir()}
    picture, out, log = tmp_path / "picture.npy", tmp_path / "pattern.png", tmp_path / "drift.jsonl"
    np.save(picture, scene(SHAPE))
    headset = lit_headset("phase_response")
    headset.lasers.off()
    monkeypatch.setattr(virtual, "open_headset", lambda spec, seed: headset)
    words = [
        bundle,
        picture,
        "--headset",
        "virtual:demo",
        "--captures",
        9,
        "--out",
        out,
        "--log",
        log,
        "--json",
    ]
    assert main(["refine", *map(str, words)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["psnr_db"]["best"] > result["psnr_db"]["first"] + 4 and result["captures"] == 9
    assert len(log.read_text().splitlines()) == 9
    with Image.open(out) as image:
        np.testing.assert_array_equal(np.asarray(image), headset.panel.gray)
    assert headset.lasers.power("green") == 0
    assert {p.name: p.read_bytes() for p in bundle.iterdir()} == before

    write_bundle(bundle, arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {}, replace=True)
    assert main(["refine", *map(str, words), "--overwrite"]) == 2
    assert "no approximator" in capsys.readouterr().err


def test_three_colours_take_turns_and_each_is_refined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bench of three colours whose drive is not what the bundle believes; one laser is lit at a time."""
    torch = pytest.importorskip("torch")
    from firmware_iface import virtual
    from firmware_iface.virtual.bench_description import ChannelDescription
    from runtime.lightpath import ideal_path as ideal
    from runtime.solver import quality
    from trainer.networks.approximator import Approximator as Network
    from trainer.networks.approximator import Architecture
    from trainer.networks.onnx_files import onnx_files

    colours = {"red": 638.0, "green": 520.0, "blue": 450.0}
    shape = (48, 64)
    bench = BenchDescription(
        defects=(make_defect("phase_response"),),
        channels=tuple(ChannelDescription(name, nm) for name, nm in colours.items()),
    ).resized(*shape, DISTANCE_MM)
    headset = VirtualHeadset(bench, seed=2)
    headset.lasers.off()
    paths = [
        (
            name,
            DISTANCE_MM,
            nm,
            converted(ideal.ideal_path(shape, 8e-6, nm * 1e-9, DISTANCE_MM * 1e-3, 1.0), np.float32),
        )
        for name, nm in colours.items()
    ]
    records, arrays = pack_light_paths(paths)
    torch.manual_seed(0)
    networks = onnx_files(Network(Architecture("compact", 8, shape, 3)))
    bundle = tmp_path / "bundle"
    write_bundle(bundle, arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {}, networks=networks)
    picture = tmp_path / "picture.npy"
    target = np.stack([scene(shape), scene(shape)[:, ::-1], scene(shape)[::-1]])
    np.save(picture, target)

    levels: dict[str, set[float]] = {name: set() for name in colours}
    whole = headset.camera.capture

    def capture() -> np.ndarray:
        powers = {name: headset.lasers.power(name) for name in colours}
        assert sum(power > 0 for power in powers.values()) <= 1
        for name, power in powers.items():
            levels[name].add(power)
        return np.asarray(whole())

    monkeypatch.setattr(headset.camera, "capture", capture)
    monkeypatch.setattr(virtual, "open_headset", lambda spec, seed: headset)
    out = tmp_path / "pattern.png"
    words = [bundle, picture, "--headset", "virtual:demo", "--captures", 9, "--out", out, "--json"]
    assert main(["refine", *map(str, words)]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["psnr_db"]["best"] > result["psnr_db"]["first"] + 3
    assert all(seen == {0.0, 1.0} for seen in levels.values())  # off, or at its one power
    assert all(headset.lasers.power(name) == 0 for name in colours)
    monkeypatch.undo()
    for (name, _, _, path), wanted in zip(paths, target, strict=True):
        with Image.open(result["patterns"][name]) as image:
            shown = np.asarray(image)
        before, after = (
            quality(headset.true_irradiance(gray, name), wanted).psnr_db
            for gray in (solve(path, wanted).gray, shown)
        )
        assert after > before + 3, name
