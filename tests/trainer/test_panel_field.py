"""The panel's learned field: without effect when absent, equal to what is hidden, and exported to the headset."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from firmware_iface.virtual.simulated_panel import Surface
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path
from runtime.lightpath.light_path import irradiance, panel_phase
from tests.trainer.fringed_bench import SHAPE
from tests.trainer.hidden import ran
from trainer.captures.acquire import acquire_captures
from trainer.captures.batches import load_batch
from trainer.captures.bench_file import Bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.open_bench import nominal_bench
from trainer.cycle.cycle_settings import CycleSettings
from trainer.cycle.hardware_in_the_loop import run_cycle
from trainer.cycle.phase_retrieval import retrieve
from trainer.cycle.show_on_bench import BenchDisplay
from trainer.cycle.target_pictures import photographs
from trainer.diagnosis.error_budget import error_budget
from trainer.diagnosis.separate import _difference
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.learned_field import PanelFieldFit, learn_field
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model, absent
from trainer.model.model_file import read_model, write_model
from trainer.model.model_stages import scene_for, stages_for, stages_of
from trainer.prediction.panel_field import UNITS, combined, with_field
from trainer.prediction.predict import trace
from trainer.training.recipe import RECIPES


def headset(*kinds: str) -> VirtualHeadset:
    defects = tuple(make_defect(kind) for kind in kinds)
    return VirtualHeadset(BenchDescription("panel", defects=defects).resized(*SHAPE, 6.0), seed=4)


def captured(folder: Path, *kinds: str, patterns: int = 18) -> CaptureSet:
    there = headset(*kinds)
    acquire_captures(there, nominal_bench(there), folder, patterns=patterns)
    return read_captures(folder)


def bumpy(bench: Bench, size: float = 0.1, seed: int = 0) -> dict[str, np.ndarray]:
    """A field of random maps."""
    rng = np.random.default_rng(seed)
    return {name: size * rng.standard_normal(bench.panel.shape).astype(np.float32) for name in UNITS}


@pytest.fixture(scope="module")
def striped(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return captured(tmp_path_factory.mktemp("striped") / "captures", "stripes")


@pytest.fixture(scope="module")
def learned(striped: CaptureSet) -> PanelFieldFit:
    """What is learned of it."""
    return learn_field(striped, Model(striped.bench))


def image_of(model: Model, gray: np.ndarray) -> torch.Tensor:
    scene = scene_for(model, "green", model.bench.distance_mm, torch.float64)
    return trace(scene, stages_of(scene, model), torch.as_tensor(gray.astype(np.int64))[None]).image[0]


def test_an_absent_field_changes_nothing_at_all() -> None:
    bench = nominal_bench(headset())
    gray = np.random.default_rng(0).integers(0, 256, SHAPE)
    zero = {name: np.zeros(SHAPE, np.float32) for name in UNITS}
    plain = Model(bench)
    assert torch.equal(image_of(plain, gray), image_of(replace(plain, panel_field=zero), gray))


def test_light_has_the_slope_over_every_map_that_the_gradient_says() -> None:
    bench = nominal_bench(headset())
    model = Model(bench).having(absent(catalogue()["zero_order"], bench))
    scene = scene_for(model, "green", bench.distance_mm, torch.float64)
    stages = stages_for(scene, model.present)
    rng = np.random.default_rng(1)
    gray = torch.as_tensor(rng.integers(0, 256, (1, *SHAPE)))
    weight = torch.as_tensor(rng.standard_normal(scene.grid.image_shape))
    maps = {n: torch.as_tensor(m, dtype=torch.float64) for n, m in bumpy(bench).items()}
    direction = {n: torch.as_tensor(m, dtype=torch.float64) for n, m in bumpy(bench, 1.0, 2).items()}

    def loss(at: dict[str, torch.Tensor]) -> torch.Tensor:
        moved = replace(stages, panel=with_field(stages.panel, at))
        return (trace(scene, moved, gray).image[0] * weight).sum()

    for name in UNITS:
        free = {n: m.clone().requires_grad_(n == name) for n, m in maps.items()}
        (gradient,) = torch.autograd.grad(loss(free), [free[name]])
        step = 1e-6
        rise = [float(loss({**maps, name: maps[name] + s * step * direction[name]})) for s in (1, -1)]
        assert float((gradient * direction[name]).sum()) == pytest.approx(
            (rise[0] - rise[1]) / (2 * step), rel=1e-5
        )


def test_two_fields_one_after_the_other_are_one() -> None:
    bench = nominal_bench(headset())
    panel = stages_for(scene_for(Model(bench), "green", bench.distance_mm, torch.float64), ()).panel
    first, then = (
        {n: torch.as_tensor(m, dtype=torch.float64) for n, m in bumpy(bench, seed=k).items()} for k in (3, 4)
    )
    both = combined({n: m.numpy() for n, m in first.items()}, {n: m.numpy() for n, m in then.items()})
    one = with_field(panel, {n: torch.as_tensor(m, dtype=torch.float64) for n, m in both.items()})
    two = with_field(with_field(panel, first), then)
    torch.testing.assert_close(one.source, two.source, atol=1e-6, rtol=0)
    torch.testing.assert_close(one.leak, two.leak, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("kind", "error"), [("stripes", 0.03), ("specks", 0.2)])
def test_what_is_hidden_on_the_panel_is_found(
    kind: str, error: float, learned: PanelFieldFit, tmp_path: Path
) -> None:
    """The learned factor against the bench's own, a number a pixel, up to one complex number."""
    found = learned
    if kind != "stripes":
        captures = captured(tmp_path / "captures", kind)
        found = learn_field(captures, Model(captures.bench))
    assert found.after.excess < 0.05 * found.before.excess
    field = found.model.panel_field
    assert field is not None
    ours = np.exp(field["log_amplitude"] + 1j * field["phase"])
    surface = Surface(headset(kind).description, 520.0).lit
    q = surface.shape[0] // SHAPE[0]
    truth = surface.reshape(SHAPE[0], q, SHAPE[1], q).mean((1, 3))
    scale = np.vdot(ours, truth) / np.vdot(ours, ours)
    off = np.sqrt(np.mean(np.abs(scale * ours - truth) ** 2))
    assert off < error * np.sqrt(np.mean(np.abs(truth) ** 2))
    assert off < 0.4 * np.std(truth)


def test_where_nothing_is_hidden_nothing_gets_worse(tmp_path: Path) -> None:
    captures = captured(tmp_path / "captures", patterns=9)
    found = learn_field(captures, Model(captures.bench))
    assert found.after.excess < found.before.excess + 1e-4


def test_the_budget_counts_the_field_as_learned(striped: CaptureSet, learned: PanelFieldFit) -> None:
    budget = error_budget(striped, learned.model)
    assert budget.named_physics == pytest.approx(0, abs=1e-6)
    assert budget.network > 0.9 * (budget.ideal - budget.noise)


def test_suggested_captures_take_account_of_the_field(striped: CaptureSet) -> None:
    """Two models that differ in nothing but the field predict different captures; equal fields, equal ones."""
    batch = load_batch(striped, striped.captures[:1])
    plain = Model(striped.bench, gain={batch.channel: 1.0})
    one, other = (replace(plain, panel_field=bumpy(striped.bench, seed=k)) for k in (6, 7))
    assert _difference(one, one, batch) < 1e-9
    assert _difference(plain, one, batch) > 1e-3
    assert _difference(one, other, batch) > 1e-3


def test_the_headset_gets_the_field_and_shows_better(
    striped: CaptureSet, learned: PanelFieldFit, tmp_path: Path
) -> None:
    """What the bundle's light path says is what the model says; and the true bench shows more than 3 dB better."""
    from runtime.solver import quality

    model = learned.model
    summary = export_bundle(model, striped, tmp_path / "bundle")
    assert summary["panel_field"] is True
    path = load_light_path(read_bundle(tmp_path / "bundle"))
    gray = np.random.default_rng(5).integers(0, 256, SHAPE)
    theirs, ours = irradiance(path, panel_phase(path, gray)), image_of(model, gray).numpy()
    assert np.abs(theirs - ours).max() < 2e-5 * ours.max()
    target, shown = photographs(("astronaut",), striped.bench)[0], []
    for one in (Model(striped.bench), model):
        pattern = retrieve(one, target, "wirtinger", None, 100)[0]
        light = headset("stripes").true_irradiance(pattern, "green", striped.bench.distance_mm)
        shown.append(quality(light, target.irradiance[0, 0].astype(float)).psnr_db)
    assert shown[1] > shown[0] + 3


def test_online_each_picture_has_its_own_field(
    striped: CaptureSet, learned: PanelFieldFit, tmp_path: Path
) -> None:
    """Without a network, round after round from the pattern before; each model can be exported."""
    there = headset("stripes")
    display = BenchDisplay(there, striped.bench, Model(striped.bench))
    settings = CycleSettings(2, RECIPES["compact"], 0, iterations=60, good=2.0, online=True)
    target = photographs(("astronaut",), striped.bench)
    cycle = run_cycle(learned.model, target, settings, tmp_path / "loop", display)
    psnr = [one["astronaut"].psnr_db for one in cycle.history]
    assert psnr[2] > psnr[0] + 0.5
    assert cycle.network is None and not cycle.own
    again = read_model(tmp_path / "loop" / "round-1" / "astronaut.toml", catalogue())
    for name in UNITS:
        assert np.array_equal(again.panel_field[name], cycle.models["astronaut"].panel_field[name])


# Files and commands


def test_the_command_writes_a_model_that_others_take(
    striped: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, run = tmp_path / "learned.toml", tmp_path / "run"
    summary = ran(capsys, "field", striped.folder, "--out", model)
    assert summary["after"]["excess"] < 0.1 * summary["before"]["excess"]
    assert set(summary["maps"]) == {"log_amplitude", "phase_rad", "added_real", "added_imaginary"}
    compared = ran(capsys, "compare", striped.folder, "--model", model)
    assert compared["heldout"]["excess"] == pytest.approx(summary["after"]["excess"], abs=1e-6)
    ran(capsys, "train", striped.folder, "--model", model, "--out", run, "--filters", 2, "--steps", 5)
    network = run / "network.safetensors"
    ran(capsys, "export", "--model", model, "--network", network, "--out", tmp_path / "bundle")
    write_model(tmp_path / "bare.toml", replace(read_model(model, catalogue()), panel_field=None))
    with pytest.raises(InputError, match="trained beyond panel_field and the model has no effects"):
        export_bundle(read_model(tmp_path / "bare.toml", catalogue()), None, tmp_path / "b", network=network)


def test_a_field_is_read_as_it_was_written_or_refused(tmp_path: Path) -> None:
    bench = nominal_bench(headset())
    path, field = tmp_path / "model.toml", bumpy(bench)
    write_model(path, Model(bench, panel_field=field))
    again = read_model(path, {}).panel_field
    assert again is not None and all(np.array_equal(again[name], field[name]) for name in UNITS)
    assert list(tomllib.loads(path.read_text())["panel_field"]) == list(UNITS)
    text = path.read_text()
    for old, new, message in (
        ("panel_field.phase", "panel_field.phases", "names the array"),
        ('phase = { array = "panel_field.phase" }', "phase = 3", "panel_field.phase is 3"),
        ("[panel_field]\n", "[panel_field]\nglow = 1\n", "panel_field.glow is not known"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=message):
            read_model(path, {})
    write_model(path, Model(bench, panel_field={**field, "phase": np.full(SHAPE, np.nan, np.float32)}))
    with pytest.raises(InputError, match="not a finite number for each of the panel's 48 x 64 pixels"):
        read_model(path, {})
