"""Light that is added to pictures grows with the exposure; a wrong black level does not."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from tests.trainer.hidden import bench_file, state
from trainer.captures.acquire import acquire_from
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.diagnosis.bench_facts import equal_facts
from trainer.diagnosis.explanation import Explanation, explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.free_form_maps import FreeFormBatch
from trainer.fitting.gains import with_gains
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model, instance_with
from trainer.prediction.free_stages import FreeFormStage

KNOWN = catalogue()
FEW = ("stray_light", "laser_drift", "sensor_response", "vignetting", "zero_order")
NOTHING_FREE = FreeFormStage("sensor", {}, lambda stages, _: stages, lambda _: [])


def at_three_exposures(folder: Path, *defects: str) -> Path:
    """Six patterns at a quarter, one and four times the usual exposure, each a capture of its own."""
    folder.mkdir()
    acquire_from(str(bench_file(folder, *defects)), folder / "captures", patterns=6, frames=3)
    table = folder / "captures" / "captures.csv"
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows({**row, "bracket": ""} for row in rows)
    return folder / "captures"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """Captures at three exposures, of a bench without faults."""
    return read_captures(at_three_exposures(tmp_path_factory.mktemp("plain") / "bench"))


@pytest.mark.parametrize("constant", [0.0, 20.0, 60.0])
def test_added_light_grows_with_the_exposure_and_a_black_level_does_not(
    plain: CaptureSet, constant: float
) -> None:
    (batch,) = load(plain, plain.captures, torch.float64)
    bare = with_gains(plain, Model(plain.bench), plain.captures)
    values = {"counts": [60.0, 0.0, 0.0], "constant": constant}
    lit = bare.having(instance_with(KNOWN["stray_light"], plain.bench, values))
    of_usual = batch.exposure / sorted(batch.exposure)[len(batch.exposure) // 2]
    assert {0.25, 1.0, 4.0} == set(of_usual.tolist())
    truth = (constant + (60 - constant) * of_usual)[:, None, None].expand_as(batch.signal)
    with torch.no_grad():
        added = Predictor(lit, batch).predict(lit) - Predictor(bare, batch).predict(bare)
        torch.testing.assert_close(added, truth)
        alone = [FreeFormBatch(m, batch) for m in (lit, bare)]
        for k in range(len(batch.ids)):  # as descents along a gradient see it
            one, other = (each.predict(NOTHING_FREE, {}, k) for each in alone)
            torch.testing.assert_close(one - other, truth[k : k + 1])


def explained(folder: Path) -> Explanation:
    captures = read_captures(folder)
    with open_pool(1) as pool:
        return explain(captures, Model(captures.bench), {name: KNOWN[name] for name in FEW}, pool)


def test_glare_at_several_exposures_is_one_effect_and_no_wrong_black_level(tmp_path: Path) -> None:
    """The bench's glow is the laser's light, nearly the same everywhere."""
    folder = at_three_exposures(tmp_path / "bench", 'kind = "stray_light"\nradius_share = 3')
    found = explained(folder)
    assert found.model.names == ("stray_light",) and found.diagnosis.verdict == "complete"
    stray = found.model.instance("stray_light")
    assert float(stray.values["constant"]) == pytest.approx(0, abs=2)
    assert not equal_facts(found.model, read_captures(folder)).facts


def test_a_wrong_black_level_is_the_same_at_every_exposure(tmp_path: Path) -> None:
    folder = at_three_exposures(tmp_path / "bench")
    state(folder, "black_level", 14)
    found = explained(folder)
    assert found.model.names == ("stray_light",) and found.diagnosis.verdict == "complete"
    stray = found.model.instance("stray_light")
    assert float(stray.values["counts"][0]) == pytest.approx(50, abs=2)
    assert float(stray.values["constant"]) == pytest.approx(50, abs=2)
    same = equal_facts(found.model, read_captures(folder))
    (fact,) = same.facts
    assert same.told and not same.deciding_captures
    assert fact.fact == "camera.black_level" and fact.value == pytest.approx(64, abs=2)
