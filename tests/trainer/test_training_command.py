"""The command `train`: what it says and writes, and folders and runs that are there already."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tests.conftest import ROOT
from tests.trainer.fringed_bench import SHAPE, captured
from tests.trainer.test_perceptual import random_weights
from trainer.captures.capture_set import CaptureSet
from trainer.cli import main
from trainer.networks.approximator import read_approximator
from trainer.networks.pretrained_features import ALEXNET, VGG19
from trainer.training.checkpoint import CHECKPOINT
from trainer.training.run_lock import RUNNING, only_run
from trainer.training.training_run import NETWORK, _TrainingRun


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return captured(tmp_path_factory.mktemp("fringed") / "captures")


def train_words(captures: CaptureSet, out: Path, *options: str) -> list[str]:
    """The command line of a small training."""
    return ["train", str(captures.folder), "--out", str(out), "--filters", "2", *options]


def test_the_command(captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    words = train_words(captures, out, "--steps", "4", "--every", "2", "--json")
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["steps"] == 4
    assert len(result["left_out"]) == 1 and "LPIPS" in result["left_out"][0]
    assert set(result["heldout"]) == {"before", "after", "noise_floor"}
    network, about = read_approximator(result["network"])
    assert network.architecture.shape == SHAPE
    assert about["captures_sha256"] == captures.content_hash()
    assert any(path.name.startswith("events") for path in (out / "curves").iterdir())
    assert (
        main([*words, "--network", "published", "--perceptual", "0", "--l1", "0", "--adversarial", "0"]) == 2
    )
    assert "every loss" in capsys.readouterr().err
    assert main([*words, "--network", "publsihed"]) == 2
    assert "published" in capsys.readouterr().err


def test_weights_that_are_named_are_used(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With VGG-19's and LPIPS's weights nothing is left out, and 1 - LPIPS is a number of at most 1."""
    vgg, lpips = tmp_path / "vgg.safetensors", tmp_path / "lpips.safetensors"
    save_file(random_weights(VGG19), vgg)
    heads = {f"lin{k}.model.1.weight": torch.rand(1, w, 1, 1) for k, w in enumerate((64, 192, 384, 256, 256))}
    save_file(random_weights(ALEXNET) | heads, lpips)
    words = train_words(captures, tmp_path / "run", "--network", "published")
    assert main([*words, "--steps", "1", "--vgg", str(vgg), "--lpips", str(lpips), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["left_out"] == []
    assert all(0 < found["one_minus_lpips"] <= 1 for found in result["heldout"].values())


@pytest.mark.slow
def test_a_second_training_in_a_folder_is_refused_and_a_dead_ones_lock_is_not(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    out.mkdir()
    words = train_words(captures, out, "--steps", "2")
    with only_run(out):
        assert (out / RUNNING).read_text() == f"{os.getpid()}\n"
        assert main(words) == 2
        assert f"another training runs in {out} (process {os.getpid()})" in capsys.readouterr().err
    assert not (out / RUNNING).exists()
    (out / RUNNING).write_text("1\n")  # of a process that was killed; another has its number now
    assert main(words) == 0
    assert not (out / RUNNING).exists()


def test_a_folder_of_something_else_is_refused_and_a_run_of_other_settings_replaced_on_request(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "thesis.tex").write_text("")
    words = train_words(captures, out, "--steps", "2", "--every", "1")
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 2
    assert "thesis.tex" in capsys.readouterr().err
    (out / "thesis.tex").unlink()
    assert main(words) == 0
    with monkeypatch.context() as before_any_work:
        before_any_work.setattr("trainer.training.training_sets.training_sets", None)
        assert main([*words, "--l1", "3"]) == 2
    assert "another recipe: give another --out, or --overwrite" in capsys.readouterr().err
    assert main([*words, "--l1", "3", "--overwrite"]) == 0


def test_ctrl_c_says_where_the_checkpoint_is(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(step: int) -> None:
        step_of = _TrainingRun._step

        def step_or_stop(run: _TrainingRun) -> dict[str, float]:
            if run.step == step:
                raise KeyboardInterrupt
            return step_of(run)

        monkeypatch.setattr(_TrainingRun, "_step", step_or_stop)

    out = tmp_path / "run"
    words = train_words(captures, out, "--steps", "8", "--every", "2")
    interrupted(1)
    assert main(words) == 130
    assert f"interrupted before the first checkpoint; there is no network in {out}" in capsys.readouterr().err
    monkeypatch.undo()
    interrupted(5)
    assert main(words) == 130
    said = capsys.readouterr().err
    assert f"the checkpoint at step 4 is {out / CHECKPOINT}, and the same command goes on from there" in said
    monkeypatch.undo()
    assert main(words) == 0


def test_two_processes_train_one_network(captures: CaptureSet, tmp_path: Path) -> None:
    """The same command under torchrun."""
    out = tmp_path / "run"
    words = train_words(captures, out, "--steps", "4", "--network", "published")
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "-m", "trainer.cli"]
    subprocess.run([*launcher, *words], cwd=ROOT, check=True, capture_output=True, timeout=300)
    assert read_approximator(out / NETWORK)[1]["steps"] == 4
