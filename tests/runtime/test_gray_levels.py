"""A panel of few gray levels: from the bundle to the solver, and on a simulated bench."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.panel import phase_light_modulator as plm
from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.bench_description import read_bench
from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.lightpath.gray_levels import checked_gray_levels, shown_as
from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import open_solver
from runtime.solver import DriveRange, Solver, quality
from runtime.solver.soft_levels import levels_a_turn
from tests.campaigns.headset import write_configuration
from tests.runtime.benches import ideal_path, scene

SHAPE, DISTANCE_MM, IRIS = (64, 64), 10.0, 0.5
SIXTEEN = tuple(plm.gray_levels())


def bundle(folder: Path, **panel: Any) -> Path:
    path = ideal_path(SHAPE, 1e-3 * DISTANCE_MM, IRIS, np.float32)
    records, arrays = pack_light_paths([("green", DISTANCE_MM, 520.0, path)])
    described = {"paths": records, "panel": {"levels": 256, **panel}, "distance_mm": DISTANCE_MM}
    write_bundle(folder, arrays, described, {})
    return folder


def test_the_dlpc900s_gray_levels_are_its_states() -> None:
    assert SIXTEEN == (0, 3, 6, 12, 17, 21, 33, 52, 79, 87, 101, 121, 142, 162, 198, 240)
    assert plm.states(np.array(SIXTEEN, np.uint8)).tolist() == list(range(16))
    nearest = np.array(SIXTEEN)[plm.states(np.arange(256, dtype=np.uint8))]
    apart = np.abs(shown_as(SIXTEEN, 256) - nearest)
    assert np.count_nonzero(apart) <= 4, (
        "ties only: the gray levels are whole numbers, and the states are not"
    )


def test_others_are_shown_as_the_nearest_also_across_the_end_of_a_wave() -> None:
    assert shown_as((), 256).tolist() == list(range(256))
    assert shown_as((0, 64, 128, 192), 256)[[0, 31, 33, 100, 223, 225, 255]].tolist() == [
        0,
        0,
        64,
        128,
        192,
        0,
        0,
    ]
    assert shown_as((0, 100), 200)[[49, 51, 149, 151, 250]].tolist() == [0, 100, 100, 0, 0]


def test_the_bundle_says_them_and_they_are_in_the_loop(tmp_path: Path) -> None:
    """Of four patterns, as a panel of the DLPC900's 16 states shows them: against a solver that does not know."""
    few = load_light_path(read_bundle(bundle(tmp_path / "few", gray_levels=list(SIXTEEN))))
    every = load_light_path(read_bundle(bundle(tmp_path / "every")))
    assert levels_a_turn(DriveRange(few)) == 16 and levels_a_turn(DriveRange(every)) == 256
    bench = BenchDescription().resized(*SHAPE, DISTANCE_MM)
    bench = replace(bench, iris=replace(bench.iris, half_width=IRIS))
    panel = VirtualHeadset(replace(bench, panel=replace(bench.panel, gray_levels=tuple(map(float, SIXTEEN)))))
    target = scene(SHAPE)
    seen = {}
    for name, path in (("few", few), ("every", every)):
        grays = Solver(path, frames=4).solve(target, 40).gray
        if name == "few":
            assert set(np.unique(grays)) <= set(SIXTEEN)
        light = np.mean([panel.true_irradiance(gray, "green") for gray in grays], axis=0)
        seen[name] = quality(light, target).psnr_db
    assert seen["few"] > seen["every"] + 1


def test_a_simulated_panel_has_only_its_gray_levels() -> None:
    tables = {"panel": {"width": 32, "height": 24, "gray_levels": [0, 64, 128, 192]}}
    description = read_bench({**tables, "propagation": {"distance_mm": 6.0}}, "bench.toml")
    assert description.nominal()["panel"]["gray_levels"] == [0, 64, 128, 192]
    assert "gray_levels" not in BenchDescription().nominal()["panel"]
    headset = VirtualHeadset(description)
    gray = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    coarse = shown_as((0, 64, 128, 192), 256)[gray].astype(np.uint8)
    assert (gray != coarse).mean() > 0.9
    np.testing.assert_array_equal(
        headset.true_irradiance(gray, "green"), headset.true_irradiance(coarse, "green")
    )
    smooth = VirtualHeadset(replace(description, panel=replace(description.panel, gray_levels=())))
    np.testing.assert_allclose(
        headset.true_irradiance(gray, "green"), smooth.true_irradiance(coarse, "green"), rtol=1e-6
    )


def test_the_service_takes_them_from_its_bundle(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, patterns=2)
    there = read_bundle(tmp_path / "bundle")
    described = {**there.description, "panel": {"gray_levels": list(SIXTEEN)}}
    write_bundle(tmp_path / "bundle", there.arrays, described, {}, replace=True)
    solver = open_solver(read_configuration(file))
    target = np.full((1, 24, 32), 0.2, np.float32)
    target[:, 6:18, 8:24] = 1.0
    made = list(solver.patterns(target, time.monotonic_ns() + 500_000_000))
    assert [p.final for p in made] == [False, True] and made[1].psnr_db >= made[0].psnr_db
    assert all(set(np.unique(p.gray)) <= set(SIXTEEN) for p in made)


@pytest.mark.parametrize("given", [[3], [0, 256], [-1, 5], [5, 5], [9, 2], [0, 1.5], "16", [0, True]])
def test_what_are_no_gray_levels_is_refused(tmp_path: Path, given: Any) -> None:
    with pytest.raises(InputError, match="whole numbers from 0 to 255"):
        checked_gray_levels(given, "'gray_levels'")
    with pytest.raises(InputError, match=r"'gray_levels' in bundle\.json"):
        load_light_path(read_bundle(bundle(tmp_path / "b", gray_levels=given)))
