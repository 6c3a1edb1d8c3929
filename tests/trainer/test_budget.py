"""The error budget: its parts add up, and each defect is counted where it belongs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from tests.trainer.fringed_bench import captured
from tests.trainer.test_networks import disturbed
from trainer.captures.capture_set import CaptureSet
from trainer.cli import main
from trainer.diagnosis.comparison import compare
from trainer.diagnosis.error_budget import error_budget
from trainer.model.model import Model
from trainer.networks.approximator import write_approximator
from trainer.training.recipe import RECIPES
from trainer.training.training_run import train
from trainer.training.training_sets import training_sets


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return captured(tmp_path_factory.mktemp("budget") / "captures")


def test_what_has_no_name_is_counted_for_the_network(captures: CaptureSet) -> None:
    model = Model(captures.bench)
    heldout = compare(captures, model).as_json()["heldout"]
    alone = error_budget(captures, model)
    assert alone.named_physics == pytest.approx(0, abs=1e-9) and alone.network == 0
    assert alone.unexplained == pytest.approx(heldout["excess"], rel=1e-3)
    assert alone.ideal == pytest.approx(heldout["nrmse"] ** 2, rel=1e-3)
    network = train(training_sets(captures, model).fitted, replace(RECIPES["compact"], filters=2), 250)
    learned = error_budget(captures, model, network)
    assert learned.ideal == pytest.approx(alone.ideal, rel=1e-6)
    assert learned.noise == pytest.approx(alone.noise)
    assert learned.network > 0.9 * alone.unexplained


def test_the_command_shows_it(
    captures: CaptureSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "network.safetensors"
    write_approximator(path, disturbed("compact", captures.bench.panel.shape, 2, 1), {})
    assert main(["compare", str(captures.folder), "--network", str(path), "--json"]) == 0
    budget = json.loads(capsys.readouterr().out)["budget"]
    assert set(budget) == {"named_physics", "network", "noise", "unexplained"}
    assert budget["network"] < 0  # weights drawn at random make it worse
    report = tmp_path / "report.html"
    assert main(["compare", str(captures.folder), "--network", str(path), "--report", str(report)]) == 0
    assert "unexplained" in capsys.readouterr().out
    assert "what was learned explains" in report.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="train one"):
        error_budget(captures, Model(captures.bench), disturbed("compact", (8, 8), 2, 1))
