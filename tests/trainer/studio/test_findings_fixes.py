"""What one click corrects in a capture set's files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("panel", reason="the studio needs the extra 'studio'")

from firmware_iface.errors import InputError
from trainer.captures.camera_numbers import numbers_text
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.check_set import check_captures
from trainer.captures.problems import Problem
from trainer.model.model_stages import ideal_irradiance
from trainer.studio.findings_fixes import fix_of


def test_one_click_sets_the_sign_of_the_phase(captures: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "reversed"
    shutil.copytree(captures.folder, folder)
    bench = folder / "bench.toml"
    bench.write_text("# mine\n" + bench.read_text().replace("phase_sign = 1", "phase_sign = -1"))
    (problem,) = [p for p in check_captures(folder, ideal_irradiance) if p.kind == "convention"]
    fix = fix_of(folder, problem)
    assert fix is not None and fix.what == "Set phase_sign = 1 in bench.toml"
    kept = fix.apply()
    assert "phase_sign = -1" in kept.read_text() and "phase_sign = 1" in bench.read_text()
    assert bench.read_text().startswith("# mine")
    assert not [p for p in check_captures(folder, ideal_irradiance) if p.kind == "convention"]


def test_one_click_removes_a_row(captures: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "missing"
    shutil.copytree(captures.folder, folder)
    lost = captures.captures[2]
    (folder / "image" / lost.image.name).unlink()
    (problem,) = [p for p in check_captures(folder, ideal_irradiance) if p.kind == "missing_file"]
    fix = fix_of(folder, problem)
    assert fix is not None and lost.capture in fix.what
    fix.apply()
    assert len(read_captures(folder)) == len(captures) - 1
    assert (folder / "captures.csv.before-1").is_file()
    with pytest.raises(InputError, match="no row"):
        fix.apply()


def test_one_click_exchanges_two_images(captures: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "swapped"
    shutil.copytree(captures.folder, folder)
    table = folder / "captures.csv"
    right = table.read_text()
    one, other = (f"image/{c.image.name}" for c in (captures.captures[2], captures.captures[4]))
    table.write_text(right.replace(one, "?").replace(other, one).replace("?", other))
    problems = [p for p in check_captures(folder, ideal_irradiance) if p.kind == "mismatched"]
    assert {p.capture for p in problems} == {captures.captures[2].capture, captures.captures[4].capture}
    fix = fix_of(folder, problems[0])
    assert fix is not None and fix.what.startswith("Exchange the images of ")
    fix.apply()
    assert table.read_text() == right
    assert not check_captures(folder, ideal_irradiance)


def test_one_click_takes_the_noise_that_repeats_show(captures: CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "noisy"
    shutil.copytree(captures.folder, folder)
    camera = captures.bench.camera
    said = numbers_text(camera, replace(camera, full_well_e=21000.0, read_noise_e=7.5))
    fix = fix_of(folder, Problem("warning", "camera_numbers", "", said))
    assert fix is not None and fix.what == "Set full_well_e = 21000 and read_noise_e = 7.5 in bench.toml"
    fix.apply()
    found = read_captures(folder).bench.camera
    assert (found.full_well_e, found.read_noise_e) == (21000.0, 7.5)


def test_what_is_no_line_of_a_table_has_no_button(captures: CaptureSet) -> None:
    for kind in ("too_few", "noise", "no_correlation"):
        assert fix_of(captures.folder, Problem("warning", kind, "", "more captures")) is None
