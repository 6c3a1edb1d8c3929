"""Captures without light are used for nothing, and a set without any is refused before any work."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import InputError
from tests.trainer.made_sets import make_set
from trainer import cli
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles, sample, split
from trainer.captures.signal_present import DARK, SATURATED, fault_of
from trainer.diagnosis.comparison import compare
from trainer.effects import catalogue
from trainer.model.model import Model

COMMANDS = ("compare", "diagnose", "explain", "add", "field")


@pytest.fixture(autouse=True)
def _one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.fitting.pool.cores", lambda: 1)


def repaint(captures: CaptureSet, change: Callable[[np.ndarray], np.ndarray], ids: Iterable[str]) -> None:
    for c in captures.captures:
        if c.capture in ids:
            Image.fromarray(change(captures.counts(c)).astype(np.uint16)).save(c.image)


def blacked(counts: np.ndarray) -> np.ndarray:
    """Black with the camera's read noise."""
    return np.round(np.random.default_rng(int(counts.sum())).normal(64, 1.95, counts.shape))


def saturated(counts: np.ndarray) -> np.ndarray:
    """Every pixel at the top count."""
    return np.full_like(counts, 4095)


def without_column(folder: Path, column: str) -> CaptureSet:
    """The set with a column of its table left out."""
    path = folder / "captures.csv"
    with path.open(newline="") as stream:
        rows = [{k: v for k, v in row.items() if k != column} for row in csv.DictReader(stream)]
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return read_captures(folder)


def arguments(command: str, folder: Path, out: Path) -> list[str]:
    """A command line of a command that takes captures."""
    named = [command, "distance", str(folder)] if command == "add" else [command, str(folder)]
    return named + (["--out", str(out)] if command in ("explain", "add", "field") else [])


def test_repeats_without_the_pattern_column_are_on_one_side(tmp_path: Path) -> None:
    named = make_set(tmp_path / "set", patterns=4)
    digests = {named.gray(c).tobytes(): 0 for c in named.captures}
    unnamed = without_column(named.folder, "pattern")
    assert len({c.pattern for c in unnamed.captures}) == len(digests) == 4
    parts = split(unnamed)
    sides = [{unnamed.gray(c).tobytes() for c in side} for side in (parts.fitted, parts.held_out)]
    assert not sides[0] & sides[1] and parts.is_held_out
    assert [c.capture for c in parts.held_out] == [c.capture for c in split(named).held_out]
    assert len(sample(unnamed.captures, 1, 99)) == 4


def test_equal_gray_levels_are_one_pattern_in_their_channel_whatever_the_table_says(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "set", patterns=4)
    table = (captures.folder / "captures.csv").read_text()
    (captures.folder / "captures.csv").write_text(table.replace("green-0", "other", 1))
    a, b, *rest = read_captures(captures.folder).captures
    assert a.pattern == b.pattern == "other"
    assert [c.pattern for c in rest] == ["green-1", "green-2", "green-3"]
    gray = Image.open(b.phase).copy()
    gray.save(b.phase, compress_level=0)  # other bytes, the same gray levels
    assert b.phase.read_bytes() != a.phase.read_bytes()
    assert read_captures(captures.folder).captures[1].pattern == "other"


@pytest.fixture
def few_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands try these only, to be quick."""
    few = {name: one for name, one in catalogue().items() if name in ("stray_light", "laser_drift")}
    monkeypatch.setattr("trainer.effects.effect_catalogue.catalogue", lambda files=(): few)


@pytest.mark.usefixtures("few_effects")
@pytest.mark.parametrize("column", ["pattern", "time_s"])
def test_a_single_pattern_is_not_called_held_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], column: str
) -> None:
    captures = make_set(tmp_path / "set", patterns=1)
    without_column(captures.folder, column)
    for command in ("compare", "explain"):
        assert cli.main([*arguments(command, captures.folder, tmp_path / "m.toml"), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["held_out"] is False
    assert cli.main(["compare", str(captures.folder)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "these captures hold one pattern" in out and "no fit saw" not in out


def test_several_patterns_are_held_out(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "set", patterns=3)
    assert compare(captures, Model(captures.bench)).as_json()["held_out"] is True


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("paint", "says"), [(blacked, "laser"), (saturated, "lower the exposure")])
def test_nothing_to_see_is_refused_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    paint: Callable[[np.ndarray], np.ndarray],
    says: str,
) -> None:
    captures = make_set(tmp_path / "set", patterns=3)
    repaint(captures, paint, [c.capture for c in captures.captures])
    assert cli.main(arguments(command, captures.folder, tmp_path / "new.toml")) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and says in err, err
    assert not (tmp_path / "new.toml").exists()


def test_a_dark_capture_is_used_for_nothing_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captures = make_set(tmp_path / "set", patterns=5)
    before = compare(captures, Model(captures.bench))
    dark = split(captures).fitted[-1].capture
    repaint(captures, blacked, [dark])
    parts = split(captures)
    assert parts.left_out == {dark: DARK}
    roles = capture_roles(captures)
    used = (*parts.fitted, *parts.held_out, *roles.fitted, *roles.screened, *roles.probed, *roles.held_out)
    assert dark not in {c.capture for c in used}
    after = compare(captures, Model(captures.bench))
    assert after.errors.nrmse == pytest.approx(before.errors.nrmse, rel=0.2)
    assert cli.main(["compare", str(captures.folder), "--json"]) == 0
    assert f"left out capture {dark} ({DARK})" in capsys.readouterr().err
    assert cli.main(["check", str(captures.folder), "--json"]) == 1
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert [(p["severity"], p["kind"], p["capture"]) for p in problems if p["severity"] == "error"] == [
        ("error", "dark", dark)
    ]


@pytest.mark.usefixtures("few_effects")
def test_a_dark_capture_is_not_a_drift_of_the_laser(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captures = make_set(tmp_path / "set", patterns=6)
    repaint(captures, blacked, [captures.captures[3].capture])
    args = arguments("explain", captures.folder, tmp_path / "m.toml")
    assert cli.main([*args, "--json"]) == 0
    assert "laser_drift" not in {s["added"] for s in json.loads(capsys.readouterr().out)["steps"]}


def test_a_dim_picture_and_a_dark_one_with_hot_pixels(tmp_path: Path) -> None:
    dim = make_set(tmp_path / "dim", patterns=1, brightness=0.002, repeat=False)
    camera = dim.bench.camera
    assert fault_of(dim.counts(dim.captures[0]), camera) == ""
    dark = blacked(dim.counts(dim.captures[0])).astype(np.uint16)
    assert fault_of(dark, camera) == DARK
    dark[3, 4] = camera.saturation
    assert fault_of(dark, camera) == DARK
    assert fault_of(np.full_like(dark, camera.saturation), camera) == SATURATED
    assert fault_of(dark + np.uint16(40), camera) == ""
    assert fault_of(dark, replace(camera, bit_depth=4)) == ""


def test_library_calls_refuse_too(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "set", patterns=2)
    repaint(captures, blacked, [c.capture for c in captures.captures])
    with pytest.raises(InputError, match="no light above the camera's noise"):
        compare(captures, Model(captures.bench))
