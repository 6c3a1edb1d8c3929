"""The solver on a GPU: the same light, gradients and patterns as on the processor.

Where CuPy finds no GPU, a stand-in has its place, whose arrays refuse what CuPy's refuse.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from runtime.lightpath.light_path import LightPath
from runtime.solver import Solver
from runtime.solver.array_backend import Backend
from runtime.solver.chosen_backend import backend
from runtime.solver.gpu_backend import CupyBackend
from runtime.solver.in_place_path import Optics
from tests.runtime.benches import PATHS, converted, ideal_path, scene
from tests.runtime.second_array_library import in_cupys_place

IDEAL = PATHS["ideal"]
HALF = ideal_path((48, 64), 0.02, 0.5)
# a random filter would make light negative
LIT = {name: replace(path, irradiance_filter=None) for name, path in PATHS.items()}
SOLVES: dict[str, tuple[Any, dict[str, Any]]] = {
    "gerchberg_saxton": (IDEAL, {"method": "gerchberg_saxton"}),
    "adam": (IDEAL, {"method": "adam"}),
    "l1": (IDEAL, {"penalty": "l1"}),
    "irradiance": (IDEAL, {"penalty": "irradiance"}),
    "half an iris": (HALF, {}),
    "fine": (HALF, {"grid": "fine"}),
    "a region": (IDEAL, {"region": np.pad(np.ones((14, 20)), 5)}),
    "a short turn": (replace(IDEAL, response=0.8 * IDEAL.response), {}),
    "16 levels": (IDEAL, {"levels": 16}),
    "frames": (IDEAL, {"frames": 2}),
    "frames of 16 levels": (IDEAL, {"frames": 3, "levels": 16}),
    "frames of a short turn": (replace(IDEAL, response=0.8 * IDEAL.response), {"frames": 2}),
    "colours": ([IDEAL, replace(IDEAL, gain=np.full((24, 30), 0.9))], {}),
    "planes": ([[IDEAL, ideal_path((24, 30), 0.006)]], {}),
}


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> CupyBackend:
    try:
        return backend("cupy")  # type: ignore[return-value]
    except InputError:
        in_cupys_place(monkeypatch)
        return CupyBackend()


def pictures(paths: Any) -> np.ndarray:
    """A picture for a path, for each of several colours, or for each plane of one."""
    if isinstance(paths, LightPath):
        return scene(paths.grid.shape).astype(float)
    return np.stack([pictures(path) * share for path, share in zip(paths, (1.0, 0.5), strict=False)])


def test_the_stand_in_refuses_what_cupy_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    in_cupys_place(monkeypatch)
    here = np.ones(3)
    far = CupyBackend().xp.asarray(here)
    assert float((far + 1).sum()) == 6 and CupyBackend().to_host(far).tolist() == [1, 1, 1]
    for mixed in (lambda: far + here, lambda: far.__setitem__(..., here), lambda: here + far):
        with pytest.raises(TypeError, match="Unsupported type"):
            mixed()
    with pytest.raises(TypeError, match="implicit conversion"):
        np.asarray(far)


def test_what_is_recorded_is_done_again_with_what_the_arrays_hold_then(gpu: CupyBackend) -> None:
    """A number that the work has computed, also; and what the host has taken into it, for other values of that."""
    xp, calls = gpu.xp, []

    def work(x: Any, out: Any, twice: bool) -> None:
        calls.append(twice)
        xp.multiply(x, x.sum(), out=out)
        if twice:
            out *= 2

    again, held, out = gpu.recorded(work), (xp.zeros(3), xp.zeros(3)), xp.zeros(3)
    for n in range(5):
        for k, x in enumerate(held):
            for twice in (False, True):
                values = np.array([1.0, n, k])
                x[...] = xp.asarray(values)
                again(x, out, twice)
                np.testing.assert_allclose(gpu.to_host(out), values * values.sum() * (1 + twice))
    assert len(calls) == 8, "once by itself and once to record it, for each of two arrays and two values"


def test_what_cannot_be_recorded_is_done_step_by_step(gpu: CupyBackend) -> None:
    xp, x, out = gpu.xp, gpu.xp.arange(3.0), gpu.xp.zeros(3)

    def work(x: Any, out: Any) -> None:
        out += x
        xp.add(out, float(x.sum()), out=out)  # the host waits for a number

    again = gpu.recorded(work)
    for n in range(4):
        again(x, out)
        assert gpu.to_host(out).tolist() == [3.0 * (n + 1), 4.0 * (n + 1), 5.0 * (n + 1)]


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("name", PATHS)
def test_light_and_gradients_are_the_same(name: str, whole: bool, gpu: CupyBackend) -> None:
    path = PATHS[name]
    if not whole:
        path = replace(path, crosstalk=None, irradiance_filter=None)
    rng = np.random.default_rng(4)
    phase, slope = rng.normal(0, 2, path.grid.shape), rng.normal(size=path.grid.shape)
    results = []
    for on in (Backend(2), gpu):
        optics = Optics(path, path.grid.fine if whole else 1, whole, on)
        light, gradient = on.xp.zeros(phase.shape), on.xp.zeros(phase.shape)
        optics.forward(on.xp.asarray(phase), light)
        optics.adjoint(on.xp.asarray(phase), on.xp.asarray(slope), gradient)
        results.append((on.to_host(light), on.to_host(gradient)))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", [*LIT, *SOLVES])
def test_a_solve_goes_the_same_way(name: str, gpu: CupyBackend) -> None:
    paths, options = SOLVES[name] if name in SOLVES else (LIT[name], {})
    picture = pictures(paths)
    here, there = (Solver(paths, on=on, **options).solve(picture, 5) for on in (Backend(2), gpu))
    assert np.isfinite(here.psnr_db).all() and len(here.psnr_db) > 1
    np.testing.assert_allclose(there.psnr_db, here.psnr_db, atol=1e-6)
    assert np.mean(there.gray != here.gray) < 0.01


@pytest.mark.parametrize("name", [*LIT, *(name for name in SOLVES if name != "gerchberg_saxton")])
def test_all_that_an_iteration_repeats_is_recorded(name: str, gpu: CupyBackend) -> None:
    """Three arrays for phases and two for gradients are used in turn: twelve calls at most, however many iterations."""
    calls: dict[str, int] = {}
    record = gpu.recorded

    def counted(work: Any) -> Any:
        def count(*arguments: Any) -> None:
            calls[work.__name__] = calls.get(work.__name__, 0) + 1
            work(*arguments)

        return record(count)

    paths, options = SOLVES[name] if name in SOLVES else (LIT[name], {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpu, "recorded", counted)
        solver = Solver(paths, on=gpu, **options)
    for _ in range(3):
        solver.solve(pictures(paths), 20)
    assert calls["_measure_now"] <= 12 and calls["_go_back_now"] <= 12 and calls.get("_multiply_now", 0) <= 12


@pytest.mark.parametrize("frames", [1, 2])
@pytest.mark.parametrize("name", ["ideal", "half an iris", "a short turn"])
def test_a_video_goes_the_same_way(name: str, frames: int, gpu: CupyBackend) -> None:
    """It stands still, moves as a whole, and moves in a part alone."""
    path = {**LIT, "half an iris": HALF, "a short turn": SOLVES["a short turn"][0]}[name]
    picture = pictures(path)
    height, width = picture.shape
    part = picture.copy()
    part[height // 4 : -height // 4, width // 4 : -width // 4] = part[height // 2 :, : width // 2][
        : height // 2, : width // 2
    ]
    video = (picture, picture, np.roll(picture, 2, 1), part)
    solvers = [Solver(path, frames=frames, on=on) for on in (Backend(1), gpu)]
    for number, target in enumerate(video):
        motion = (0, 2) if number == 2 else None
        here, there = (solver.frame(target, 2, motion=motion) for solver in solvers)
        np.testing.assert_allclose(there.psnr_db, here.psnr_db, atol=1e-6)
        assert np.mean(here.gray != there.gray) < 0.01


@pytest.mark.parametrize("through", ["gradient", "predistorted"])
def test_a_network_in_the_loop_goes_the_same_way(through: str, gpu: CupyBackend) -> None:
    from tests.runtime.test_approximator import fall_off, made

    path = converted(IDEAL, np.float32)
    d, picture = made(fall_off(path.grid.shape)), pictures(path)
    here, there = (
        Solver(path, approximator=d, through=through, on=on).solve(picture, 3) for on in (Backend(2), gpu)
    )
    np.testing.assert_allclose(there.psnr_db, here.psnr_db, atol=1e-3)
