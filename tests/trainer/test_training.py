"""Training: its pairs, its losses, and that a killed run continues to the same result."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from tests.conftest import ROOT
from tests.trainer.fringed_bench import captured
from tests.trainer.made_sets import bench_tables, counted, irradiance, write_captures
from trainer.captures.batches import load_batch
from trainer.captures.bench_file import read_bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.effects import catalogue
from trainer.fitting.gains import with_gains
from trainer.model.model import Model, absent
from trainer.model.model_stages import scene_for, stages_for
from trainer.networks.discriminator import Discriminator
from trainer.training.camera_to_panel import onto_camera, onto_panel
from trainer.training.checkpoint import CHECKPOINT
from trainer.training.image_metrics import image_metrics, noise_floor, prediction_metrics
from trainer.training.losses import (
    adversarial_loss,
    content_loss,
    display_encoded,
    matching_loss,
    where_measured,
)
from trainer.training.recipe import RECIPES, Recipe, recipe_named
from trainer.training.training_pairs import measured_on_panel, pairs_of, stacked
from trainer.training.training_run import NETWORK, train
from trainer.training.training_sets import TrainingSets, training_sets

SMALL = replace(RECIPES["compact"], filters=2)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return captured(tmp_path_factory.mktemp("fringed") / "captures")


@pytest.fixture(scope="module")
def sets(captures: CaptureSet) -> TrainingSets:
    return training_sets(captures, Model(captures.bench))


def test_a_defect_without_a_name_is_learned(sets: TrainingSets) -> None:
    """Held-out pictures come to within 1.5 dB of the camera's noise, from 13 dB above it."""
    before, floor = prediction_metrics(sets.held_out, None), noise_floor(sets.held_out)
    network = train(sets.fitted, SMALL, 250)
    after = prediction_metrics(sets.held_out, network)
    assert before.psnr_db < floor.psnr_db - 8
    assert after.psnr_db > floor.psnr_db - 1.5
    assert after.ssim > before.ssim


def test_a_student_learns_its_teachers_results(sets: TrainingSets) -> None:
    teacher = train(sets.fitted, SMALL, 100)
    student = train(sets.fitted, SMALL, 100, teacher=teacher, seed=1)
    held_out = replace(sets.held_out, measured=teacher(sets.held_out.predicted).detach())
    assert prediction_metrics(held_out, student).psnr_db > prediction_metrics(held_out, None).psnr_db + 6


def test_no_steps_leave_the_identity(sets: TrainingSets) -> None:
    assert torch.equal(train(sets.fitted, SMALL, 0)(sets.held_out.predicted), sets.held_out.predicted)


# Pairs


def test_pairs_are_the_counts_over_the_gain_where_the_camera_adds_nothing(captures: CaptureSet) -> None:
    rows = captures.captures[:3]
    model = with_gains(captures, Model(captures.bench), rows)
    pairs = pairs_of(captures, rows, model)
    for k, row in enumerate(rows):
        signal, valid = captures.signal(row)
        light = signal / (model.gain["green"] * row.exposure_ms)
        assert np.allclose(pairs.measured[k, 0].numpy(), light, atol=2e-5)
        assert np.array_equal(pairs.weight[k, 0].numpy() > 0, valid)
    assert float(pairs.predicted[:, 0].mean()) == pytest.approx(float(pairs.measured[:, 0].mean()), rel=0.1)


def test_effects_of_the_camera_are_taken_out(captures: CaptureSet) -> None:
    """A model that says that the camera is brighter at a side leaves predicted irradiance as it is."""
    row = captures.captures[0]
    vignetting = absent(catalogue()["vignetting"], captures.bench)
    values = {name: value + 0.2 for name, value in vignetting.values.items()}
    plain = Model(captures.bench, gain={"green": 50.0})
    darker = replace(plain.having(vignetting.with_values(values)))
    one, other = (measured_on_panel(m, load_batch(captures, [row])) for m in (plain, darker))
    assert torch.equal(one.predicted, other.predicted)
    assert (one.measured - other.measured).abs().max() > 0.01


def test_a_turned_camera_sees_the_same_pairs(tmp_path: Path) -> None:
    """A camera turned by a quarter, with its homography: what it measures stands on the panel's own pixels."""
    tables = bench_tables((48, 64))
    rng = np.random.default_rng(2)
    gray = rng.integers(0, 256, (48, 64), dtype=np.uint8)
    light = irradiance(gray)
    turned = bench_tables((48, 64), width=48, height=64, registered=False)
    # camera row i, column j looks at panel row 47 - j, column i
    turned["camera"]["homography"] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 47.0], [0.0, 0.0, 1.0]]
    found = []
    for name, table, view in (("straight", tables, light), ("turned", turned, np.rot90(light, -1))):
        quiet = {**table, "camera": {**table["camera"], "read_noise_e": 0, "full_well_e": 1e8}}
        counts = counted(np.ascontiguousarray(view), quiet, np.random.default_rng(0))
        write_captures(tmp_path / name, quiet, [{"gray": gray, "counts": counts, "channel": "green"}])
        captures = read_captures(tmp_path / name)
        model = with_gains(captures, Model(captures.bench), captures.captures)
        found.append(pairs_of(captures, captures.captures, model))
    inner = (slice(None), slice(0, 1), slice(4, -4), slice(4, -4))
    straight, other = (one.measured[inner] for one in found)
    assert (straight - other).abs().max() < 0.05 * straight.max()
    assert float((straight - other).std() / straight.std()) < 0.01


def test_camera_and_panel_pixels_are_taken_to_each_other() -> None:
    tables = bench_tables((48, 64), width=90, height=70, registered=False, pixel_um=5.6)
    tables["camera"]["homography"] = [[0.7, 0.02, -1.0], [-0.015, 0.69, 0.5], [1e-5, 0.0, 1.0]]
    bench = read_bench(tables)
    y, x = np.mgrid[0:48, 0:64]
    smooth = torch.tensor(np.sin(y / 6.0) + np.cos(x / 7.0))
    scene = scene_for(Model(bench), "green", 5.0, torch.float64)
    stages = stages_for(scene, ())
    dy, dx = (torch.full((70, 90), shift, dtype=torch.float64) for shift in (0.8, -0.5))
    for one in (stages, replace(stages, sensor=stages.sensor.displaced(dy, dx))):
        back = onto_panel(scene, one, onto_camera(scene, one, smooth))
        assert (back - smooth)[4:-4, 4:-4].abs().max() < 0.01


def test_colours_are_stacked_in_the_order_of_their_patterns(tmp_path: Path) -> None:
    captures = captured(tmp_path / "captures", patterns=3, colours=True)
    stacks = stacked(captures, captures.captures[:-1])
    assert [[None if c is None else c.channel for c in stack] for stack in stacks] == [
        ["red", "green"], ["red", "green"], ["red", "green"], ["red", None],
    ]  # fmt: skip


# Losses and metrics


def test_losses_vanish_for_equal_pictures_and_are_what_they_say() -> None:
    ours, target = torch.rand(2, 1, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    recipe = Recipe(l1=100.0)
    assert content_loss(recipe, ours, ours, None) == 0
    assert float(content_loss(recipe, ours, target, None)) == pytest.approx(
        100 * float((ours - target).abs().mean())
    )
    discriminator = Discriminator(4)
    judged = discriminator(ours, target)
    assert matching_loss(judged, judged) == 0
    assert matching_loss(judged, discriminator(target, target)) > 0
    certain = [[torch.ones(1, 1, 3, 3)]]
    assert adversarial_loss(certain, True) == 0
    assert adversarial_loss(certain, False) == 1
    assert float(adversarial_loss([[torch.full((1, 1, 2, 2), 30.0)]], True, cross_entropy=True)) < 1e-6


def test_only_a_conditional_discriminator_depends_on_the_condition() -> None:
    ours, one, other = torch.rand(3, 1, 3, 48, 64)
    for conditional in (True, False):
        torch.manual_seed(0)
        discriminator = Discriminator(4, conditional=conditional)
        same = torch.equal(discriminator(ours, one)[0][-1], discriminator(ours, other)[0][-1])
        assert same is not conditional


def test_pixels_without_a_measurement_have_no_gradient() -> None:
    ours = torch.rand(1, 3, 8, 8, requires_grad=True)
    weight = (torch.rand(1, 3, 8, 8) > 0.5).float()
    target = torch.rand(1, 3, 8, 8)
    content_loss(
        Recipe(), where_measured(display_encoded(ours, 1.0), target, weight), target, None
    ).backward()
    assert torch.equal(ours.grad != 0, weight > 0)


def test_ablations_are_the_published_recipe_with_one_thing_changed() -> None:
    changed = {
        name: {k for k in vars(recipe) if getattr(recipe, k) != getattr(RECIPES["published"], k)}
        for name, recipe in RECIPES.items()
        if name.startswith("published_")
    }
    assert changed == {
        "published_unconditional": {"conditional"},
        "published_no_l1": {"l1"},
        "published_no_perceptual": {"perceptual"},
        "published_no_adversarial": {"adversarial"},
        "published_l1_only": {"perceptual", "adversarial"},
    }
    with pytest.raises(InputError, match="compact"):
        recipe_named("compct")


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_takes_steps(name: str, sets: TrainingSets) -> None:
    recipe = replace(RECIPES[name], filters=2)
    network = train(sets.fitted, recipe, 2)
    given = sets.held_out.predicted[:1]
    assert not torch.equal(network(given), given)
    assert torch.isfinite(network(given)).all()


def test_metrics_of_equal_pictures_is_perfect_and_counts_what_counts() -> None:
    one, every = torch.rand(3, 40, 40), torch.ones(3, 40, 40)
    same, other = image_metrics(one, one, every), image_metrics(0.9 * one, 0.9 * one + 0.1, every)
    assert (same.psnr_db, same.ssim) == (120, 1)
    assert other.psnr_db == pytest.approx(20) and other.ssim < 1
    half = every.clone()
    half[:, :20] = 0
    wrong = torch.cat((torch.zeros(3, 20, 40), one[:, 20:]), 1)
    assert image_metrics(wrong, one, half).psnr_db == 120
    assert image_metrics(0.9 * one, 0.9 * one + 0.1, half).psnr_db == pytest.approx(20)
    assert (
        image_metrics(torch.cat((one[:1], 0 * one[1:])), one, torch.cat((every[:1], 0 * one[1:]))).ssim == 1
    )


# That a killed run continues

RESUMED = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
import torch
from safetensors.torch import save_file
torch.set_num_threads(1)
from trainer.captures.capture_set import read_captures
from trainer.model.model import Model
from trainer.training.recipe import RECIPES
from trainer.training.training_sets import training_sets
from trainer.training.training_run import train

captures = read_captures(sys.argv[1])
sets = training_sets(captures, Model(captures.bench))
die = int(sys.argv[3])

def die_at(step, loss):
    if step == die:
        os.kill(os.getpid(), signal.SIGKILL)

# Pix2Pix has all that could differ: a discriminator, two optimisers and dropout.
train(sets.fitted, replace(RECIPES["pix2pix"], filters=2), 8, Path(sys.argv[2]), every=3, progress=die_at)
"""


def test_a_stopped_training_continues_to_the_same_bits(sets: TrainingSets, tmp_path: Path) -> None:
    """In one process; the next test kills one."""
    recipe = replace(RECIPES["pix2pix"], filters=2)

    def stop_at_5(step: int, loss: float) -> None:
        if step == 5:
            raise KeyboardInterrupt

    train(sets.fitted, recipe, 8, tmp_path / "whole", every=3)
    with pytest.raises(KeyboardInterrupt):
        train(sets.fitted, recipe, 8, tmp_path / "stopped", every=3, progress=stop_at_5)
    assert not (tmp_path / "stopped" / NETWORK).exists()
    train(sets.fitted, recipe, 8, tmp_path / "stopped", every=3)
    assert (tmp_path / "stopped" / NETWORK).read_bytes() == (tmp_path / "whole" / NETWORK).read_bytes()


@pytest.mark.slow
def test_a_killed_training_continues_to_the_same_bits(captures: CaptureSet, tmp_path: Path) -> None:
    def run(folder: str, die: int) -> int:
        command = [sys.executable, "-c", RESUMED, str(captures.folder), str(tmp_path / folder), str(die)]
        (tmp_path / folder).mkdir(exist_ok=True)
        return subprocess.run(command, cwd=ROOT, check=False).returncode

    assert run("whole", 0) == 0
    assert run("killed", 5) == -signal.SIGKILL
    assert not (tmp_path / "killed" / NETWORK).exists()
    assert (tmp_path / "killed" / CHECKPOINT).exists()
    assert run("killed", 0) == 0
    assert (tmp_path / "killed" / NETWORK).read_bytes() == (tmp_path / "whole" / NETWORK).read_bytes()


def test_a_run_with_other_settings_is_not_continued(sets: TrainingSets, tmp_path: Path) -> None:
    train(sets.fitted, SMALL, 2, tmp_path)
    with pytest.raises(InputError, match="another recipe"):
        train(sets.fitted, replace(SMALL, l1=3.0), 4, tmp_path)
    train(sets.fitted, SMALL, 4, tmp_path)
    (tmp_path / CHECKPOINT).write_bytes(b"torn")
    with pytest.raises(InputError, match="cannot be read"):
        train(sets.fitted, SMALL, 4, tmp_path)
