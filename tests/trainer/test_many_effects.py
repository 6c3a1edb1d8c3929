"""How many effects an explanation may have: beyond that, one more must remove most of what is left."""

from __future__ import annotations

import pytest

from tests.trainer.hidden import bench_file
from trainer.captures.acquire import acquire_from
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.diagnosis import way
from trainer.diagnosis.explanation import explain
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.pool import open_pool
from trainer.model.model import Model


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    folder = tmp_path_factory.mktemp("many")
    bench = bench_file(folder, 'kind = "illumination"', 'kind = "ghost"\nshare = 0.05')
    acquire_from(str(bench), folder / "captures", patterns=8)
    return read_captures(folder / "captures")


@pytest.mark.parametrize(
    ("much", "names", "verdict"),
    [(0.5, {"illumination", "ghost"}, "complete"), (1.1, {"illumination"}, "missing")],
)
def test_a_last_effect_that_removes_most_of_what_is_left_is_added_to_however_many(
    much: float,
    names: set[str],
    verdict: str,
    captures: CaptureSet,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(way, "MOST_EFFECTS", 1)
    monkeypatch.setattr(way, "MUCH", much)
    known = {
        name: effect for name, effect in catalogue().items() if name in ("illumination", "ghost", "distance")
    }
    with open_pool(1) as pool:
        found = explain(captures, Model(captures.bench), known, pool)
    assert set(found.model.names) == names
    assert found.diagnosis.verdict == verdict
