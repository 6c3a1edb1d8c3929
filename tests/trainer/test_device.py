"""The light path on another device than the processor: all of it there, and the same numbers.

They run on a GPU where torch finds one. Elsewhere `second_device` stands in for it.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from firmware_iface.virtual import open_headset
from tests.trainer.hidden import bench_file, ran
from tests.trainer.second_device import Far, second_device
from tests.trainer.test_panel_field import captured
from tests.trainer.test_unregistered import taken
from trainer import device
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load, load_batch
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.captures.open_bench import nominal_bench
from trainer.cli import main
from trainer.cycle.evaluation import run_evaluation
from trainer.cycle.evaluation_bench import EvaluationSizes
from trainer.device import array_of, computing_on
from trainer.diagnosis.explanation import Explanation, explain
from trainer.effects.effect_catalogue import catalogue
from trainer.effects.testing import slopes, small_bench
from trainer.fitting import learned_field, predictor
from trainer.fitting.free_form_maps import FreeFormBatch, descend
from trainer.fitting.gains import with_gains
from trainer.fitting.gauss_newton import fit
from trainer.fitting.learned_field import learn_field
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import Predictor
from trainer.kept_results import kept_by_device
from trainer.model.model import Model, absent, instance_with
from trainer.prediction.free_stages import FREE_STAGES

EFFECTS = ("phase_response", "zero_order", "illumination", "sensor_blur")
HIDDEN = ('kind = "zero_order"', 'kind = "phase_response"\ngain = 1.08')
UNSEEN = ("frame_motion", "laser_drift", "slow_response")
ON_GPU = torch.cuda.is_available()


def elsewhere() -> AbstractContextManager[None]:
    """A piece of work is done on the GPU, or on its stand-in."""
    return computing_on("cuda") if ON_GPU else second_device()


def is_there(tensor: torch.Tensor) -> bool:
    return tensor.is_cuda if ON_GPU else isinstance(tensor, Far)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """A bench with two effects, whose camera sees its panel pixel by pixel."""
    folder = tmp_path_factory.mktemp("device")
    acquire_from(str(bench_file(folder, *HIDDEN)), folder / "captures", patterns=6)
    return read_captures(folder / "captures")


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """A camera of other pixels that moves from capture to capture, and a laser that drifts."""
    folder = tmp_path_factory.mktemp("moving")
    taken(folder, 'kind = "frame_motion"', 'kind = "laser_drift"', panel=(64, 80), camera=(83, 104))
    return read_captures(folder / "captures")


def predicted(captures: CaptureSet, *names: str) -> torch.Tensor:
    """Counts of the captures that fits see, under a model with these effects a little away from absent."""
    model = Model(captures.bench)
    for name in names:
        one = absent(catalogue()[name], captures.bench)
        away = {p.name: one.values[p.name] + p.scale for p in one.effect.parameters if not p.per_pixel}
        model = model.having(one.with_values(away))
    model = with_gains(captures, model, capture_roles(captures).fitted)
    batch = load(captures, capture_roles(captures).fitted)[0]
    with torch.no_grad():
        return Predictor(model, batch).predict(model)


def explained(captures: CaptureSet) -> Explanation:
    known = {name: catalogue()[name] for name in EFFECTS}
    with open_pool(1) as pool:
        return explain(captures, Model(captures.bench), known, pool)


def same_explanation(found: Explanation, expected: Explanation) -> None:
    """The same effects and verdict, and an excess that differs by less than it is known to."""
    assert found.model.names == expected.model.names
    assert found.diagnosis.verdict == expected.diagnosis.verdict
    (low, high), excess = (one := expected.diagnosis.held_out).interval(), one.excess
    assert abs(found.diagnosis.held_out.excess - excess) < 0.1 * (high - low)


def test_the_stand_in_refuses_what_a_gpu_refuses() -> None:
    with second_device():
        far = torch.ones(3)
        assert isinstance(far + 1, Far) and float(far.sum()) == 3
        with pytest.raises(RuntimeError, match="meets"):
            far + torch.from_numpy(np.ones(3, np.float32))
        with pytest.raises(RuntimeError, match="numpy"):
            np.asarray(far)
        assert array_of(far).tolist() == [1, 1, 1]
        with computing_on("cpu"):
            assert not isinstance(torch.ones(3), Far)


def test_what_is_kept_is_kept_for_its_device() -> None:
    made = []

    @kept_by_device(2)
    def ones(count: int) -> torch.Tensor:
        made.append(count)
        return torch.ones(count)

    here = ones(2)
    with elsewhere():
        assert is_there(ones(2)) and ones(2) is ones(2)
    assert ones(2) is here and made == [2, 2]


def test_a_gpu_is_the_default_device_in_whole_single_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv("LOCAL_RANK", "1")  # of two processes that torchrun started
    rounded = torch.backends.cudnn.allow_tf32
    with computing_on("cuda"):
        assert torch.get_default_device() == torch.device("cuda", 1)
        assert not torch.backends.cudnn.allow_tf32 and not torch.backends.cuda.matmul.allow_tf32
        with computing_on("cpu"):
            assert torch.ones(3).device.type == "cpu"
    assert torch.get_default_device().type == "cpu" and torch.backends.cudnn.allow_tf32 == rounded


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_effect_acts_on_another_device(name: str) -> None:
    effect = catalogue()[name]
    one = absent(effect, small_bench())
    values = {p.name: one.values[p.name] + p.scale for p in effect.parameters}
    if effect.name in UNSEEN:
        pytest.skip("without captures it changes nothing")
    expected = slopes(effect, values)
    with elsewhere():
        found = slopes(effect, values)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-3 * max(expected.values()))


def test_a_prediction_is_the_same(captures: CaptureSet) -> None:
    expected = predicted(captures, *EFFECTS)
    with elsewhere():
        found = predicted(captures, *EFFECTS)
        assert is_there(found)
    np.testing.assert_allclose(array_of(found), array_of(expected), atol=1e-5 * float(expected.max()))


def test_a_prediction_of_a_moving_camera_of_other_pixels_is_the_same(moving: CaptureSet) -> None:
    expected = predicted(moving, "frame_motion", "laser_drift", "misregistration")
    with elsewhere():
        found = predicted(moving, "frame_motion", "laser_drift", "misregistration")
    np.testing.assert_allclose(array_of(found), array_of(expected), atol=1e-4 * float(expected.max()))


def test_a_fit_finds_the_same(captures: CaptureSet) -> None:
    def fitted() -> Any:
        model = Model(captures.bench)
        for name in ("zero_order", "phase_response"):
            model = model.having(absent(catalogue()[name], captures.bench))
        return fit(model, model.names, load(captures, capture_roles(captures).fitted))

    expected = fitted()
    with elsewhere():
        found = fitted()
    assert found.errors.excess == pytest.approx(expected.errors.excess, abs=1e-6)
    for one, other in zip(found.model.present, expected.model.present, strict=True):
        assert one.errors is not None
        for name, value in one.values.items():
            assert np.all(np.abs(value - other.values[name]) < 0.05 * one.errors[name] + 1e-9), name


@pytest.mark.parametrize("stage", FREE_STAGES)
def test_a_free_form_descends_the_same_way(stage: str, captures: CaptureSet) -> None:
    def found() -> dict[str, torch.Tensor]:
        rows = capture_roles(captures).fitted[:1]
        model = with_gains(captures, Model(captures.bench), rows)
        batches = [FreeFormBatch(model, b) for b in load(captures, rows)]
        return descend(FREE_STAGES[stage](captures.bench), batches, batches, 1e9, 2, 2)

    expected = found()
    assert any(float(t.abs().max()) > 0 for t in expected.values())
    with elsewhere():
        there = found()
    for name, values in expected.items():
        assert is_there(there[name])
        size = float(values.abs().max())
        np.testing.assert_allclose(array_of(there[name]), array_of(values), atol=0.01 * size, err_msg=name)


@pytest.mark.slow
def test_explain_comes_to_the_same_end(captures: CaptureSet) -> None:
    with elsewhere():
        found = explained(captures)
    same_explanation(found, explained(captures))


@pytest.mark.slow
def test_a_field_learned_there_is_the_same(tmp_path: Path) -> None:
    stripes = captured(tmp_path / "captures", "stripes", patterns=9)
    expected = learn_field(stripes, Model(stripes.bench))
    with elsewhere():
        found = learn_field(stripes, Model(stripes.bench))
    assert expected.after.excess < 0.1 * expected.before.excess
    assert found.after.excess == pytest.approx(expected.after.excess, rel=0.02)


@pytest.mark.slow
def test_evaluate_computes_there_and_trains_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ROUNDS", "ITERATIONS", "REFITS"):  # a field that is only begun is enough
        monkeypatch.setattr(learned_field, name, 1)
    bench = str(bench_file(tmp_path, HIDDEN[0], width=48, height=40, distance_mm=3))
    model = Model(nominal_bench(open_headset(bench, 0)))
    model = model.having(instance_with(catalogue()["zero_order"], model.bench, {"leak_real": 0.1}))
    methods = ("physics", "physics_network", "field", "field_compact")

    def found() -> dict[str, Any]:
        return run_evaluation(bench, methods, EvaluationSizes(2, 5, 5), model=model, workers=1)

    with elsewhere():
        there = found()
    here = found()
    for part in ("prediction", "display", "stack"):
        for one, other in zip(there[part], here[part], strict=True):
            assert one["psnr_db"] == pytest.approx(other["psnr_db"], abs=0.05), (part, one["method"])


def test_a_command_computes_where_it_is_told(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = []

    def load_and_note(*given: Any) -> Any:
        loaded.append(load_batch(*given))
        return loaded[-1]

    monkeypatch.setattr(device, "computing_on", lambda name: elsewhere() if name == "cuda" else nullcontext())
    monkeypatch.setattr(predictor, "load_batch", load_and_note)
    words = ("add", "zero_order", captures.folder, "--device", "cuda", "--out", tmp_path / "more.toml")
    assert ran(capsys, *words)["after"]["excess"] > 0
    assert loaded and all(is_there(batch.signal) for batch in loaded)


@pytest.mark.skipif(ON_GPU, reason="this machine has a GPU")
def test_without_a_gpu_the_option_says_so(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where, out = str(captures.folder), ("--out", str(tmp_path / "new"))
    for words in (
        ("diagnose", where),
        ("explain", where, *out),
        ("add", "zero_order", where, *out),
        ("field", where, *out),
        ("train", where, *out),
        ("evaluate", "--bench", "virtual:mixed"),
    ):
        assert main([*words, "--device", "cuda"]) == 2
        assert "torch finds no CUDA device on this machine: leave out --device" in capsys.readouterr().err


@pytest.mark.parametrize("more", [("--workers", "2"), ("--cluster", "tcp://127.0.0.1:1")])
def test_a_gpu_is_for_one_process(
    more: tuple[str, str], captures: CaptureSet, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diagnose", str(captures.folder), "--device", "cuda", *more]) == 2
    assert "leave out --workers and --cluster" in capsys.readouterr().err
