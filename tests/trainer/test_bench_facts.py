"""Benches whose bench.toml states a wrong distance, wavelength or pixel pitch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.trainer.hidden import LARGER, bench_file, captured, ran, state, with_few_effects, without_probes
from trainer.cli import main

RIVALS = (
    "distance",
    "wavelength",
    "panel_wavefront",
    "spatial_coherence",
    "sensor_blur",
    "stray_light",
    "laser_drift",
)
TWO_PLANES = ("--planes", "10,18", "--patterns", 6)


def explained(capsys, captures: Path, folder: Path) -> dict:
    return ran(capsys, "explain", captures, "--out", folder / "model.toml", "--workers", 1)


@pytest.mark.parametrize(
    ("key", "stated", "true"),
    [("pitch_um", 7.9, 8.0), pytest.param("wavelength_nm", 522.0, 520.0, marks=pytest.mark.slow)],
)
def test_at_one_plane_the_equivalent_facts_are_said(key, stated, true, tmp_path, capsys) -> None:
    # a wavelength's share of a distance's error is half a pixel pitch's, so it takes more pixels to find it as exactly
    captures = captured(capsys, tmp_path, **(LARGER if key == "wavelength_nm" else {}))
    state(captures, key, stated)
    found = explained(capsys, captures, tmp_path)
    assert [s["added"] for s in found["steps"]] == [None, "distance"]
    assert found["verdict"] == "complete"
    facts = {f["fact"].split(".")[-1]: f for f in found["equal_facts"]}
    assert set(facts) == {"wavelength_nm", "pitch_um"}
    assert facts[key]["stated"] == stated and facts[key]["value"] == pytest.approx(true, rel=2e-4)
    assert 0 < facts[key]["error"] < 1e-3 * true
    assert "±" in found["sentence"].split("pitch_um")[1]
    assert "pitch_um" in found["sentence"] and "wavelength_nm" in found["sentence"]
    assert any("another" in s or "a wrong distance" in s for s in found["suggested_captures"])


def test_two_planes_tell_a_wrong_pitch_from_a_wrong_distance(tmp_path, capsys, monkeypatch) -> None:
    with_few_effects(monkeypatch, *RIVALS)
    captures = captured(capsys, tmp_path, options=TWO_PLANES)
    state(captures, "pitch_um", 7.9)
    found = explained(capsys, captures, tmp_path)
    assert [s["added"] for s in found["steps"]] == [None, "wavelength"]
    assert found["verdict"] == "complete"
    facts = {f["fact"]: f["value"] for f in found["equal_facts"]}
    assert facts["panel.pitch_um"] == pytest.approx(8.0, rel=2e-4)


def test_two_planes_show_a_wrong_distance_as_such(tmp_path, capsys, monkeypatch) -> None:
    with_few_effects(monkeypatch, *RIVALS)
    captures = captured(capsys, tmp_path, 'kind = "distance"\noffset_mm = 1.0', options=TWO_PLANES)
    found = explained(capsys, captures, tmp_path)
    assert [s["added"] for s in found["steps"]] == [None, "distance"]
    assert found["verdict"] == "complete" and found["equal_facts"] == []


@pytest.mark.parametrize(
    ("stated", "true"), [(10, 30), (30, 12), pytest.param(20, 50, marks=pytest.mark.slow)]
)
def test_a_distance_far_from_the_stated_one_is_found(stated, true, tmp_path, capsys) -> None:
    bench = bench_file(tmp_path, distance_mm=true)
    captures = tmp_path / "captures"
    ran(capsys, "capture", "--bench", bench, "--out", captures)
    state(captures, "distance_mm", float(stated))
    table = captures / "captures.csv"
    table.write_text(table.read_text().replace(f",{true:.1f},", f",{stated:.1f},"))
    problems = ran(capsys, "check", captures)["problems"]
    assert [(p["severity"], p["kind"]) for p in problems] in ([("warning", "distance")], [])
    added = ran(capsys, "add", "distance", captures, "--out", tmp_path / "model.toml")
    assert added["parameters"]["offset_mm"]["value"] == pytest.approx(true - stated, abs=0.02)
    assert added["after"]["excess"] < 3e-4


def test_pictures_that_fit_no_pattern_are_refused(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    rng = np.random.default_rng(0)
    for path in (captures / "image").glob("*.png"):
        Image.fromarray(rng.permuted(np.asarray(Image.open(path)).ravel()).reshape(80, 96)).save(path)
    assert main(["explain", str(captures), "--out", str(tmp_path / "model.toml")]) == 2
    assert "fits any of their patterns" in capsys.readouterr().err
    assert main(["compare", str(captures), "--json"]) == 0
    assert "fits any of their patterns" in capsys.readouterr().err


def test_images_moved_far_are_not_taken_for_the_wrong_ones(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    table = captures / "captures.csv"  # smooth pictures also fit when they are moved
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([head, *(r for r in rows if ",random," in r or ",grains," in r)]) + "\n")
    for path in (captures / "image").glob("*.png"):
        Image.fromarray(np.roll(np.asarray(Image.open(path)), (31, 44), axis=(0, 1))).save(path)
    problems = ran(capsys, "check", captures)["problems"]
    assert [p["kind"] for p in problems if p["kind"] != "too_few"] == ["shifted"]
    assert "-31 rows and -44 columns" in problems[-1]["message"]


def test_a_plane_that_is_misread_is_a_fact_of_the_table(tmp_path, capsys, monkeypatch) -> None:
    with_few_effects(monkeypatch, *RIVALS)
    without_probes(monkeypatch)
    captures = captured(capsys, tmp_path, options=TWO_PLANES)
    table = captures / "captures.csv"
    assert ",18.0," in table.read_text()
    table.write_text(table.read_text().replace(",18.0,", ",17.4,"))
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    (fact,) = found["table_facts"]
    assert fact["fact"] == "plane_mm" and fact["stated"] == 17.4
    assert fact["value"] == pytest.approx(18.0, abs=max(0.005, 4 * fact["error"]))
    assert "captures.csv" in found["sentence"] and "17.4" in found["sentence"]


def test_a_distance_that_is_off_alike_is_no_fact_of_the_table(tmp_path, capsys, monkeypatch) -> None:
    with_few_effects(monkeypatch, *RIVALS)
    without_probes(monkeypatch)
    captures = captured(capsys, tmp_path, 'kind = "distance"\noffset_mm = 0.5', options=TWO_PLANES)
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    assert found["ranking"][0]["effect"] == "distance" and found["table_facts"] == []


@pytest.mark.parametrize("drifts", [False, True])
def test_an_exposure_that_is_misread_is_a_fact_of_the_table(drifts, tmp_path, capsys, monkeypatch) -> None:
    with_few_effects(monkeypatch, *RIVALS)
    without_probes(monkeypatch)
    secrets = ('kind = "laser_drift"',) if drifts else ()
    captures = captured(capsys, tmp_path, *secrets)
    table = captures / "captures.csv"
    head, *rows = table.read_text().splitlines()
    column = head.split(",").index("exposure_ms")
    changed = []
    for k, row in enumerate(rows):
        cells = row.split(",")
        if k % 3 == 2:  # these captures were taken at the same exposure as the others
            cells[column] = str(float(cells[column]) * 1.1)
        changed.append(",".join(cells))
    table.write_text("\n".join([head, *changed]) + "\n")
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    assert found["ranking"][0]["effect"] == "laser_drift"
    facts = found["table_facts"]
    if drifts:  # a drift of several per cent hides which exposure is wrong
        assert all(abs(f["value"] / f["stated"] - 1 / 1.1) < 5 * f["error"] for f in facts)
    else:
        (fact,) = facts
        assert fact["fact"] == "exposure_ms" and fact["value"] == pytest.approx(
            fact["stated"] / 1.1, rel=0.003
        )
        assert "captures.csv" in found["sentence"]


def test_a_wrong_black_level_looks_like_stray_light_and_is_said(tmp_path, capsys) -> None:
    captures = captured(capsys, tmp_path)
    state(captures, "black_level", 52)
    found = explained(capsys, captures, tmp_path)
    assert [s["added"] for s in found["steps"]] == [None, "stray_light"]
    (fact,) = found["equal_facts"]
    assert fact["fact"] == "camera.black_level" and fact["value"] == pytest.approx(64, abs=1)
    assert "black_level" in found["sentence"]
    assert any("laser off" in s for s in found["suggested_captures"])
