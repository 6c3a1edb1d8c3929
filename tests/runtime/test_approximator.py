"""D through onnxruntime: its gradient, patterns that look right through it, files that do not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import (
    ADAPTERS,
    APPROXIMATOR,
    GRADIENT,
    INITIALISER,
    read_bundle,
    write_bundle,
)
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.cli import main
from runtime.lightpath.light_path import LightPath
from runtime.networks.onnx_approximator import EPSILON, Approximator, approximator_of
from runtime.solver import Solver, quality, shown, solve
from tests.runtime.benches import ideal_path, scene

onnx = pytest.importorskip("onnx")
SHAPE = (64, 80)


def fall_off(shape: tuple[int, int], colours: int = 1) -> np.ndarray:
    """A gain map [1, C, H, W]: light falls off to one side and there is a fringe."""
    y, x = np.meshgrid(np.linspace(-1, 1, shape[0]), np.linspace(-1, 1, shape[1]), indexing="ij")
    gain = 1 - 0.35 * x + 0.15 * np.sin(20 * y)
    return np.broadcast_to(gain, (1, colours, *shape)).astype(np.float32)


def networks(gain: np.ndarray) -> dict[str, bytes]:
    """D(I) = gain I, and the gradient of its penalty, with the gain as an adapter."""
    from onnx import TensorProto, helper, numpy_helper

    def picture(name: str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, list(gain.shape))

    def model(nodes: list, inputs: list, outputs: list, constants: list) -> bytes:
        graph = helper.make_graph(nodes, "d", inputs, outputs, constants)
        made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        onnx.checker.check_model(made)
        return made.SerializeToString()

    node = helper.make_node
    forward = model(
        [node("Mul", ["irradiance", "gain"], ["corrected"])],
        [picture("irradiance")],
        [picture("corrected")],
        [numpy_helper.from_array(gain, "gain")],
    )
    backward = model(
        [
            node("Mul", ["irradiance", "gain"], ["seen"]),
            node("Relu", ["seen"], ["light"]),
            node("Add", ["light", "epsilon"], ["above"]),
            node("Sqrt", ["above"], ["root"]),
            node("Add", ["target", "epsilon"], ["asked"]),
            node("Sqrt", ["asked"], ["wanted"]),
            node("Sub", ["root", "wanted"], ["error"]),
            node("Mul", ["error", "error"], ["square"]),
            node("ReduceSum", ["square"], ["loss"], keepdims=0),
            node("Div", ["error", "root"], ["slope"]),
            node("Mul", ["slope", "gain"], ["gradient"]),
            node("Mul", ["slope", "irradiance"], ["gradient.gain"]),
        ],
        [picture("irradiance"), picture("target"), picture("gain")],
        [
            helper.make_tensor_value_info("loss", TensorProto.FLOAT, []),
            picture("gradient"),
            picture("gradient.gain"),
        ],
        [numpy_helper.from_array(np.array(EPSILON, np.float32), "epsilon")],
    )
    return {APPROXIMATOR: forward, GRADIENT: backward, ADAPTERS: save({"gain": gain})}


def made(gain: np.ndarray) -> Approximator:
    files = networks(gain)
    return Approximator(gain.shape[1:], files[APPROXIMATOR], files[GRADIENT], {"gain": gain})


@pytest.fixture(scope="module")
def path() -> LightPath:
    return ideal_path(SHAPE, 0.008, 0.5, np.float32)


def test_loss_and_gradient_are_those_of_the_penalty() -> None:
    gain = fall_off((6, 8))
    d = made(gain)
    rng = np.random.default_rng(0)
    d.irradiance[...], d.target[...] = rng.uniform(0, 2, (2, 1, 6, 8))

    def loss(x: np.ndarray, g: np.ndarray) -> float:
        root, wanted = np.sqrt(np.maximum(x * g, 0) + EPSILON), np.sqrt(d.target.astype(float) + EPSILON)
        return float(((root - wanted) ** 2).sum())

    x, g = d.irradiance.astype(float), gain[0].astype(float)
    assert d.look() == pytest.approx(loss(x, g), rel=1e-5)
    slope, over_gain = d.slope.astype(float), d.adapter_gradients()["gain"][0].astype(float)
    way, step = rng.normal(size=(2, 1, 6, 8)), 1e-6
    change = (loss(x + step * way[0], g) - loss(x - step * way[0], g)) / (2 * step)
    assert change == pytest.approx((slope * way[0]).sum(), rel=1e-4)
    change = (loss(x, g + step * way[1]) - loss(x, g - step * way[1])) / (2 * step)
    assert change == pytest.approx((over_gain * way[1]).sum(), rel=1e-4)
    d.correct()
    np.testing.assert_allclose(d.corrected, d.irradiance * gain[0], rtol=1e-6)


@pytest.mark.parametrize("through", ["gradient", "predistorted"])
def test_patterns_look_right_through_d(path: LightPath, through: str) -> None:
    gain, target = fall_off(SHAPE), scene(SHAPE)
    aware = Solver(path, approximator=made(gain), through=through).solve(target, 25)
    unaware = solve(path, target, 25)
    seen = quality(shown(path, aware.gray) * gain[0, 0], target)
    assert seen.psnr_db > quality(shown(path, unaware.gray) * gain[0, 0], target).psnr_db + 6
    assert aware.quality.psnr_db == pytest.approx(seen.psnr_db, abs=0.01)
    assert aware.psnr_db[-1] > aware.psnr_db[0] + 3


def test_three_colours_go_through_one_d() -> None:
    paths = [ideal_path(SHAPE, z, 0.5, np.float32) for z in (0.006, 0.008, 0.01)]
    pictures = np.stack([scene(SHAPE, seed) for seed in range(3)])
    gain = fall_off(SHAPE, 3).copy()
    gain[0, 1] *= 0.5
    solution = Solver(paths, approximator=made(gain), through="gradient").solve(pictures, 20)
    for k in range(3):
        unaware = quality(shown(paths[k], solve(paths[k], pictures[k], 20).gray) * gain[0, k], pictures[k])
        assert solution.qualities[k].psnr_db > unaware.psnr_db + 4


@pytest.mark.parametrize("through", ["gradient", "predistorted"])
def test_what_a_colour_gets_goes_with_its_picture_through_d_as_well(through: str) -> None:
    """A D that changes nothing: light for colours in turn is shared out as without it."""
    paths = [ideal_path(SHAPE, z, 0.5, np.float32) for z in (0.006, 0.008, 0.01)]
    pictures = np.stack([light * scene(SHAPE, seed) for seed, light in enumerate((1.0, 0.3, 0.1))])
    d = made(np.ones((1, 3, *SHAPE), np.float32))
    with_d, plain = (
        Solver(paths, approximator=one, through=through).solve(pictures, 8).given for one in (d, None)
    )
    np.testing.assert_allclose(with_d, plain, rtol=0.05)


@pytest.mark.parametrize("through", ["gradient", "predistorted"])
def test_a_long_descent_through_d_does_not_end_in_the_dark(through: str) -> None:
    shape = (24, 32)
    path, d = ideal_path(shape, 6e-3, 0.7, np.float32), made(np.ones((1, 1, *shape), np.float32))
    solver = Solver(path, approximator=d, through=through)
    (first,), (last,) = (solver.solve(scene(shape), n).given for n in (0, 600))
    assert last > 0.45 * first


def test_a_d_of_another_panel_or_for_planes_is_refused(path: LightPath) -> None:
    for paths, d in (
        (path, made(fall_off((32, 40)))),
        ([path, path], made(fall_off(SHAPE))),
        ([[path, path]], made(fall_off(SHAPE))),
    ):
        with pytest.raises(InputError, match="export it for these"):
            Solver(paths, approximator=d)


def test_the_command_uses_the_bundles_d(
    path: LightPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records, arrays = pack_light_paths([("green", 8.0, 520.0, path)])
    gain, target = fall_off(SHAPE), scene(SHAPE)
    files = networks(gain)
    write_bundle(tmp_path / "b", arrays, {"paths": records}, {}, networks=files)
    np.save(tmp_path / "t.npy", target)
    command = [
        "solve",
        str(tmp_path / "b"),
        str(tmp_path / "t.npy"),
        "--out",
        str(tmp_path / "p.png"),
        "--json",
    ]
    assert main([*command, "--iterations", "20"]) == 0
    (pattern,) = json.loads(capsys.readouterr().out)["patterns"]
    unaware = quality(shown(path, solve(path, target, 20).gray) * gain[0, 0], target)
    assert pattern["psnr_db"] > unaware.psnr_db + 4
    assert approximator_of(read_bundle(tmp_path / "b"), (1, *SHAPE)) is not None
    data = bytearray(files[GRADIENT])
    data[len(data) // 2] ^= 1
    (tmp_path / "b" / GRADIENT).write_bytes(data)
    assert main(command) == 2
    assert "is not the file that was exported" in capsys.readouterr().err


@pytest.mark.parametrize("broken", [b"not a network", b""])
def test_a_file_that_is_no_network_gives_one_sentence(
    path: LightPath, tmp_path: Path, broken: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    if not broken:
        broken = networks(fall_off((8, 8)))[APPROXIMATOR]  # a network for another panel
    records, arrays = pack_light_paths([("green", 8.0, 520.0, path)])
    write_bundle(tmp_path / "b", arrays, {"paths": records}, {}, networks={APPROXIMATOR: broken})
    np.save(tmp_path / "t.npy", scene(SHAPE))
    command = ["solve", str(tmp_path / "b"), str(tmp_path / "t.npy"), "--out", str(tmp_path / "p.png")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "approximator.onnx" in error and "export" in error
    assert not (tmp_path / "p.png").exists()


def test_a_network_proposes_the_start(path: LightPath) -> None:
    """A network whose output is a fixed phase: the solve begins with it."""
    from onnx import TensorProto, helper, numpy_helper

    phase = np.random.default_rng(0).uniform(-3, 3, SHAPE).astype(np.float32)
    answer = 2 * np.stack([np.cos(phase), np.sin(phase)])[None]
    nodes = [
        helper.make_node("Mul", ["target", "nothing"], ["dark"]),
        helper.make_node("Add", ["dark", "answer"], ["phase"]),
    ]
    graph = helper.make_graph(
        nodes,
        "start",
        [helper.make_tensor_value_info("target", TensorProto.FLOAT, [1, 1, *SHAPE])],
        [helper.make_tensor_value_info("phase", TensorProto.FLOAT, [1, 2, *SHAPE])],
        [
            numpy_helper.from_array(np.zeros((), np.float32), "nothing"),
            numpy_helper.from_array(answer, "answer"),
        ],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9
    ).SerializeToString()
    solver, target = Solver(path, initialiser=model), scene(SHAPE)
    np.testing.assert_allclose(solver.solve(target, 0).phase, phase, atol=1e-5)
    expected = solve(path, target, 5, start=phase).psnr_db
    np.testing.assert_allclose(solver.solve(target, 5).psnr_db, expected, atol=1e-2)
    assert INITIALISER == "initialiser.onnx"
    with pytest.raises(InputError, match=INITIALISER):
        Solver(path, initialiser=networks(fall_off(SHAPE))[APPROXIMATOR])
