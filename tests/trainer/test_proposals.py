"""Proposals: shapes are read off maps as they were put in, files compute what was read, and captures accept them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from runtime.excess import RemovedExcess
from tests.trainer.hidden import bench_file, ran
from trainer.captures.capture_set import read_captures
from trainer.cli import main
from trainer.diagnosis.probes import ProbeResult
from trainer.diagnosis.proposals.blob_shape import blobs_in, blobs_of_their_own, more_blobs_in
from trainer.diagnosis.proposals.effect_file import write_effect
from trainer.diagnosis.proposals.gray_shape import steps_in_gray
from trainer.diagnosis.proposals.probe_maps import (
    AMPLITUDE,
    DELAY,
    GAIN,
    GRAY,
    OFFSET,
    PASSED,
    PHASE,
    PLACES,
    TRANSMISSION,
    Place,
    ProbeMap,
)
from trainer.diagnosis.proposals.proposing import Proposals, propose
from trainer.diagnosis.proposals.reading import Reading
from trainer.diagnosis.proposals.row_column_shape import rows_and_columns_in
from trainer.diagnosis.proposals.shapes_tried import candidates_of
from trainer.diagnosis.proposals.surface_shape import radial_in, smooth_in, times_surface
from trainer.diagnosis.proposals.wave_shape import waves_in, waves_in_gray
from trainer.effects import testing
from trainer.effects.effect_catalogue import catalogue, load_effects
from trainer.effects.own_effect import applied
from trainer.fitting.pool import open_pool
from trainer.model.model import Model, instance_with
from trainer.prediction.scene import bare_stages, scene_at

SHAPE = (72, 96)
NOISE = 0.01


def map_at(place: Place, values: np.ndarray) -> ProbeMap:
    """A probe's map of a panel or a camera of its own size."""
    if place is GRAY:
        return ProbeMap(place, values, (0, 0), (0.0, 0.0))
    if place.spread == "pixels":
        return ProbeMap(place, values, SHAPE, ((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2))
    return ProbeMap(place, values, (0, 0), (1.0, 1.0))


def pixels() -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    grid = np.meshgrid(y, x, indexing="ij")
    return grid[0], grid[1]


def noise(seed: int = 0) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).standard_normal(SHAPE)


def fringes(period: float = 9.3, angle: float = 33.0, chirp: float = 0.3, bend: float = -0.2) -> np.ndarray:
    y, x = pixels()
    turn = math.radians(angle)
    t, s = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    radius = math.hypot((SHAPE[0] - 1) / 2, (SHAPE[1] - 1) / 2)
    return 0.1 * np.cos(2 * math.pi / period * (t + (chirp * t**2 + bend * s**2) / (2 * radius)) + 0.5)


def start(reading: Reading, name: str) -> np.ndarray:
    return np.asarray(reading.starts[name])


# Shapes


@pytest.mark.parametrize(
    ("angle", "chirp", "bend"), [(33.0, 0.3, -0.2), (-70.0, -0.25, 0.0), (2.0, 0.0, 0.4)]
)
def test_bent_fringes_are_read_with_their_numbers(angle: float, chirp: float, bend: float) -> None:
    (found,) = waves_in(map_at(GAIN, fringes(9.3, angle, chirp, bend) + noise()))
    assert found.explained > 0.95
    # The same fringes may be counted the other way round.
    sign = 1 if abs(math.remainder(float(start(found, "angle")) - angle, 360)) < 90 else -1
    turned = float(start(found, "angle")) + (0 if sign == 1 else 180)
    assert math.remainder(turned - angle, 360) == pytest.approx(0, abs=0.2)
    assert start(found, "period") == pytest.approx(9.3, rel=0.005)
    assert sign * start(found, "chirp") == pytest.approx(chirp, abs=0.01)
    assert sign * start(found, "bend") == pytest.approx(bend, abs=0.02)
    assert math.hypot(start(found, "cosine"), start(found, "sine")) == pytest.approx(0.1, rel=0.03)


def test_specks_are_read_with_places_sizes_and_what_passes() -> None:
    y, x = pixels()
    # The last two touch.
    true = [(-20.3, 11.6, 4.0), (13.7, -30.2, 2.2), (0.4, 2.8, 1.2), (25.1, 30.4, 3.1), (22.4, 36.1, 3.9)]
    inside = 0.2 * np.exp(1j)
    whole = np.ones(SHAPE, complex)
    for row, column, radius in true:
        whole *= 1 + np.clip(radius + 0.5 - np.hypot(y - row, x - column), 0, 1) * (inside - 1)
    (found,) = blobs_in(map_at(TRANSMISSION, whole - 1 + noise() + 1j * noise(1)))
    places = np.stack([start(found, n) for n in ("row", "column", "radius")], axis=1)
    assert len(places) == len(true), places
    for one in true:
        near = places[np.hypot(places[:, 0] - one[0], places[:, 1] - one[1]).argmin()]
        assert np.allclose(near, one, atol=0.3)
    assert complex(start(found, "real"), start(found, "imaginary")) == pytest.approx(inside, abs=0.1)

    # With one of them left out, the map of what is left shows it again.
    others = {n: v[1:] if v.ndim else v for n, v in found.starts.items()}
    row, column, radius = places[0]
    disc = np.clip(radius + 0.5 - np.hypot(y - row, x - column), 0, 1) * (inside - 1)
    (again,) = more_blobs_in(map_at(TRANSMISSION, disc + noise() + 1j * noise(1)), others)
    assert np.allclose(start(again, "row")[-1], row, atol=0.3) and len(start(again, "row")) == len(true)
    assert not more_blobs_in(map_at(TRANSMISSION, noise() + 1j * noise(1)), others)


def test_noise_has_no_specks_and_no_shape_worth_a_fit() -> None:
    assert not blobs_in(map_at(TRANSMISSION, noise() + 1j * noise(1)))
    pictures = (("gain over the picture", 1 + noise(), "relative"), ("light added", noise(1), "counts"))
    found = ProbeResult("sensor", RemovedExcess(0.1, 0.001), 0.01, pictures)
    assert candidates_of([found], testing.small_bench(), 100.0) == []


def test_columns_and_what_repeats_in_them() -> None:
    each = 0.1 * np.random.default_rng(3).standard_normal(SHAPE[1])
    found = {r.name: r for r in rows_and_columns_in(map_at(AMPLITUDE, each[None, :] + noise()))}
    assert np.allclose(start(found["columns"], "each"), each - each.mean(), atol=0.01)
    assert found["columns"].explained > 0.95 and found["columns_every_3"].explained < 0.2

    three = np.array([0.1, -0.05, 0.02])[np.arange(SHAPE[0]) % 3]
    found = {r.name: r for r in rows_and_columns_in(map_at(PHASE, three[:, None] + noise()))}
    assert found["rows_every_3"].explained > 0.9
    assert np.allclose(start(found["rows_every_3"], "others"), [-0.15, -0.08], atol=0.01)
    assert found["rows_every_2"].explained < 0.1


def test_a_function_of_the_distance_and_a_surface_are_told_apart() -> None:
    y, x = pixels()
    far = np.hypot(y - 7.1, x + 9.6) / 60
    one = map_at(GAIN, 0.3 * far**2 - 0.5 * far**6 + noise())
    (radial,) = radial_in(one)
    assert radial.explained > 0.9
    plane = map_at(GAIN, 0.1 * x / 48 + 0.05 * (y / 36) ** 3 + noise())
    (smooth,) = smooth_in(plane)
    assert smooth.explained > 0.9 and smooth.explained > radial_in(plane)[0].explained


def test_fringes_under_an_envelope_are_a_product() -> None:
    y, x = pixels()
    one = map_at(GAIN, fringes(chirp=0, bend=0) * (1 + 0.8 * x / 48 - 0.3 * y / 36) + noise())
    (plain,) = waves_in(one)
    product = times_surface(one, plain)
    assert product is not None and product.explained > plain.explained + 0.05
    assert times_surface(one, product) is None
    (steady,) = waves_in(map_at(GAIN, fringes() + noise()))
    assert times_surface(map_at(GAIN, fringes() + noise()), steady) is None


def test_a_ripple_over_gray_levels() -> None:
    level = np.linspace(0, 1, 33)
    ripple = 0.2 * np.cos(2 * math.pi * 5.3 * level + 1) + 0.3 * level**2
    (found,) = waves_in_gray(map_at(GRAY, ripple))
    assert start(found, "cycles") == pytest.approx(5.3, abs=0.05)
    assert math.hypot(start(found, "cosine"), start(found, "sine")) == pytest.approx(0.2, rel=0.05)


# Files


def readings(place: Place) -> list[Reading]:
    if place is GRAY:
        one = map_at(GRAY, 0.2 * np.cos(np.linspace(0, 20, 33)))
        return [*waves_in_gray(one), *steps_in_gray(one)]
    if place is TRANSMISSION:
        y, x = pixels()
        disc = np.clip(3.5 - np.hypot(y - 8.2, x + 5.1), 0, 1) * (0.3 + 0.4j - 1)
        one = map_at(place, disc + 0.1 * (noise() + 1j * noise(1)))
        (common,) = blobs_in(one)
        return [common, blobs_of_their_own(one, common.starts)]
    one = map_at(place, fringes() * (1 + 0.8 * pixels()[1] / 48))
    waves = waves_in(one)
    product = times_surface(one, waves[0])
    assert product is not None
    rows = rows_and_columns_in(one) if place.spread == "pixels" else []
    return [*waves, product, *smooth_in(one), *radial_in(one), *rows]


@pytest.mark.parametrize("place", [*PLACES, TRANSMISSION], ids=lambda p: f"{p.stage}-{p.title or 'field'}")
def test_files_load_and_compute_what_was_read(place: Place, tmp_path: Path) -> None:
    bench = testing.small_bench()
    scene = scene_at(bench, bench.channels[0].name, 10.0, "angular_spectrum", 1.0, torch.float32)
    before = getattr(bare_stages(scene), place.stage)
    for reading in readings(place):
        name = f"{place.stage}_{reading.name}"
        write_effect(tmp_path / f"{name}.py", name, place, reading)
        assert all(len(line) <= 240 for line in (tmp_path / f"{name}.py").read_text().splitlines())
        (effect,) = load_effects(tmp_path / f"{name}.py")
        assert (effect.name, effect.stage) == (name, place.stage)
        values = instance_with(effect, bench, reading.starts).values
        tensors = {n: torch.as_tensor(v, dtype=torch.float32) for n, v in values.items()}
        after = applied(effect, before, tensors)
        if place in (AMPLITUDE, TRANSMISSION):
            change = (after.source / before.source - 1).numpy()
        elif place is PHASE:
            change = np.angle((after.source / before.source).numpy())
        elif place is GAIN:
            change = after.gain.numpy() - 1
        elif place is OFFSET:
            change = after.offset.numpy()
        else:
            continue
        off = change - reading.found
        assert np.abs(off - off.mean()).max() < 0.02 * np.abs(reading.found).max(), name


@pytest.mark.parametrize("place", [GAIN, DELAY, PASSED, TRANSMISSION, GRAY], ids=lambda p: p.stage + p.name)
def test_a_written_effect_that_is_absent_changes_nothing(place: Place, tmp_path: Path) -> None:
    for reading in readings(place):
        if any(n.size in SHAPE for n in reading.numbers):
            continue  # a number a row or column: of this panel alone
        write_effect(tmp_path / f"own_{reading.name}.py", f"own_{reading.name}", place, reading)
        (effect,) = load_effects(tmp_path / f"own_{reading.name}.py")
        assert testing.change_when_absent(effect) < 1e-5


# The command


SPECKS = 'kind = "specks"\ncount = 3\nsmallest_radius_px = 2.0\nlargest_radius_px = 4.0'
FRINGES = 'kind = "fringes"'


def captured(capsys: pytest.CaptureFixture[str], folder: Path, *defects: str) -> Path:
    bench = bench_file(folder, *defects, width=96, height=72, distance_mm=8)
    ran(capsys, "capture", "--bench", bench, "--out", folder / "captures")
    return folder / "captures"


def proposed(capsys: pytest.CaptureFixture[str], captures: Path, folder: Path) -> dict:
    return ran(capsys, "propose", captures, "--out", folder / "proposals", "--workers", 1)


def explained_with(capsys: pytest.CaptureFixture[str], captures: Path, folder: Path, found: dict) -> dict:
    """What `explain` says with the files that are worth adding."""
    files = [folder / "proposals" / p["file"] for p in found["proposals"] if p["worth_adding"]]
    words = [word for file in files for word in ("--effects", file)]
    out = folder / "model.toml"
    return ran(capsys, "explain", captures, *words, "--out", out, "--workers", 1)


def proposals(captures: Path, drafts: Path) -> Proposals:
    """What is proposed where the catalogue has two effects only, which saves their trials."""
    few = {n: e for n, e in catalogue().items() if n in ("illumination", "stray_light")}
    read = read_captures(captures)
    with open_pool(1) as pool:
        return propose(read, Model(read.bench), few, pool, drafts)


def test_specks_are_proposed_and_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = proposals(captured(capsys, tmp_path, SPECKS), tmp_path)
    first = found.proposals[0]
    assert (first.name, first.candidate.place.stage) == ("panel_specks", "panel")
    assert first.worth_adding and first.removed.interval()[0] > 0
    # What is finer than a pixel at the specks' edges is in no model.
    assert first.excess_after < min(6e-4, 0.02 * found.diagnosis.held_out.excess)
    keys = {"file", "stage", "what", "excess_after", "excess_removed", "ci95", "worth_adding"}
    assert set(first.as_json()) == keys and "3 specks" in first.as_json()["what"]
    # The file starts where the fit ended.
    (effect,) = load_effects(first.write(tmp_path))
    assert effect.starts is not None
    (start,) = effect.starts([])
    assert all(np.allclose(start[n], v, rtol=1e-4, atol=1e-5) for n, v in first.fitted.values.items())


def test_bent_fringes_are_proposed_and_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = proposals(captured(capsys, tmp_path, FRINGES), tmp_path)
    first = found.proposals[0]
    assert (first.name, first.worth_adding) == ("sensor_fringes", True)
    assert first.excess_after < 3e-4
    values = first.fitted.values
    assert values["period"] == pytest.approx(17, rel=0.01)
    assert values["chirp"] == pytest.approx(0.3, abs=0.02)
    assert math.hypot(values["cosine"], values["sine"]) == pytest.approx(0.22, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("specks", {"panel_specks.py"}),
        ("fringes", {"sensor_fringes.py"}),
        ("stripes", {"panel_amplitude_columns.py"}),
        ("outside", {"sensor_fringes.py", "panel_specks.py"}),
    ],
)
def test_named_benches_end_at_the_noise_with_what_is_proposed(
    name: str, files: set[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captures = tmp_path / "captures"
    ran(capsys, "capture", "--bench", f"virtual:{name}", "--out", captures, "--patterns", 16)
    found = proposed(capsys, captures, tmp_path)
    accepted = [p for p in found["proposals"] if p["worth_adding"]]
    assert {p["file"] for p in accepted} == files
    assert found["proposals"][: len(accepted)] == accepted
    keys = {"file", "stage", "what", "excess_after", "excess_removed", "ci95", "worth_adding"}
    assert all(set(p) == keys for p in found["proposals"])
    assert sorted(p.name for p in (tmp_path / "proposals").iterdir()) == sorted(
        p["file"] for p in found["proposals"]
    )
    assert accepted[-1]["excess_after"] < 5e-4
    better = explained_with(capsys, captures, tmp_path, found)
    assert better["verdict"] == "complete" and better["steps"][-1]["excess"] < 5e-4


def test_nothing_is_proposed_for_a_complete_model_or_before_what_has_a_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for defects, verdict in (((), "complete"), (('kind = "distance"',), "missing")):
        folder = tmp_path / verdict
        folder.mkdir()
        found = proposed(capsys, captured(capsys, folder, *defects), folder)
        assert (found["verdict"], found["proposals"]) == (verdict, [])
        assert list((folder / "proposals").iterdir()) == []
        assert ("Add distance first" in found["sentence"]) == (verdict == "missing")


def test_a_folder_of_proposals_is_replaced_only_when_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captures = captured(capsys, tmp_path)
    out = tmp_path / "proposals"
    out.mkdir()
    (out / "panel_specks.py").write_text("edited")
    words = ["propose", str(captures), "--out", str(out), "--workers", "1"]
    assert main(words) == 2
    assert "is there already and is not empty" in capsys.readouterr().err
    (out / "notes.txt").write_text("kept")
    assert main([*words, "--overwrite"]) == 2
    assert "notes.txt" in capsys.readouterr().err
    (out / "notes.txt").unlink()
    assert main([*words, "--overwrite"]) == 0
    assert list(out.iterdir()) == []
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith(".")) == []
