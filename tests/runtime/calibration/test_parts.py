"""The parts of a calibration: drift, the camera's view, derivatives, the response, verdicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.panel.phase_light_modulator import gray_levels
from firmware_iface.virtual.defects import make_defect
from firmware_iface.virtual.simulated_drive import Drive
from runtime.bundle.bundle_folder import read_bundle
from runtime.calibration.columns import Columns
from runtime.calibration.drift import LOWEST_WAVEFRONT, Drift, drifted
from runtime.calibration.estimate import ColourLightPath, Estimate, predicted, shot_of
from runtime.calibration.parameter_layout import ParameterLayout
from runtime.calibration.prediction import Predictor
from runtime.calibration.replacement_rule import replacement_verdict
from runtime.calibration.response import (
    Sweep,
    best_period,
    fitted_response,
    measured_sweep,
    swept,
)
from runtime.calibration.self_calibration import calibrate
from runtime.calibration.shown_patterns import grains, grating
from runtime.calibration.taking import Taker
from runtime.camera.view import View, sampler
from runtime.excess import PredictionErrors, is_complete
from runtime.lightpath.gray_levels import shown_as
from runtime.lightpath.legendre import edge_to_edge, legendre_maps
from runtime.lightpath.light_path import irradiance, panel_phase, pixel_irradiance
from runtime.lightpath.overdrive import settling_periods
from tests.runtime.benches import PITCH, ideal_path, random_path
from tests.runtime.calibration.drifting import (
    WAVELENGTH_NM,
    base,
    devices,
    drifted_bench,
    headset,
    ideal_bundle,
    opened,
)
from trainer.captures.grating_powers import phase_of_power

SMALL = (40, 52)


def test_a_distance_drift_is_a_light_path_to_another_plane() -> None:
    near, far = (ideal_path(SMALL, z) for z in (8e-3, 8.3e-3))
    phase = np.random.default_rng(0).uniform(0, 6, SMALL)
    moved = drifted(near, "green", WAVELENGTH_NM, Drift(distance_mm=0.3))
    inside = (slice(8, -8), slice(8, -8))  # the far grid is padded a little more
    seen, wanted = (pixel_irradiance(p, irradiance(p, phase))[inside] for p in (moved, far))
    assert np.corrcoef(seen.ravel(), wanted.ravel())[0, 1] > 0.9999
    before = pixel_irradiance(near, irradiance(near, phase))[inside]
    assert np.corrcoef(before.ravel(), wanted.ravel())[0, 1] < 0.9


def test_a_wavefront_turns_source_and_leak_alike_and_in_nanometres() -> None:
    path = random_path(SMALL)
    maps = legendre_maps(*edge_to_edge(SMALL), 3, LOWEST_WAVEFRONT)
    terms = np.zeros(len(maps))
    terms[1] = 65.0
    moved = drifted(path, "green", WAVELENGTH_NM, Drift(wavefront_nm=terms))
    turn = np.exp(2j * np.pi * 65.0 / WAVELENGTH_NM * maps[1])
    np.testing.assert_allclose(moved.source, path.source * turn, rtol=1e-12)
    np.testing.assert_allclose(moved.leak, path.leak * turn, rtol=1e-12)
    np.testing.assert_array_equal(moved.transfers, path.transfers)


def test_no_drift_changes_nothing() -> None:
    path = random_path(SMALL)
    same = drifted(path, "green", WAVELENGTH_NM, Drift())
    for name in ("source", "leak", "transfers", "response"):
        np.testing.assert_allclose(getattr(same, name), getattr(path, name), rtol=1e-14)


def test_a_registered_view_sees_what_the_panels_pixels_integrate() -> None:
    path = ideal_path(SMALL, 8e-3)
    image = irradiance(path, np.random.default_rng(1).uniform(0, 6, SMALL))
    wanted = pixel_irradiance(path, image)
    np.testing.assert_allclose(sampler(View(SMALL), path.grid)(image), wanted, atol=2e-5 * wanted.max())


@pytest.mark.parametrize("finer", [1, 2])
def test_a_moved_view_sees_a_wave_where_it_looks(finer: int) -> None:
    """A sinusoid is integrated, blurred and read at positions that are known in closed form."""
    path = ideal_path(SMALL, 8e-3)
    grid = path.grid
    fy, fx = (
        6 / (grid.image_shape[0] / 2),
        -9 / (grid.image_shape[1] / 2),
    )  # cycles a panel pixel, whole periods
    y, x = (np.arange(n) / 2 - grid.margin for n in grid.image_shape)
    image = 2 + np.cos(2 * np.pi * (fy * y[:, None] + fx * x[None, :]))
    view = View(
        (33, 41), (1.2, 0.03, -2, -0.03, 1.1, 3, 0, 0, 1), 0.3, -0.7, 8.0, blur_y_px2=0.1, blur_x_px2=0.2
    )
    rows, columns = view.positions(SMALL)
    down, right = rows[17, 20] - rows[16, 20], rows[16, 21] - rows[16, 20]
    across = (columns[17, 20] - columns[16, 20], columns[16, 21] - columns[16, 20])
    area = np.sinc(fy * down + fx * across[0]) * np.sinc(fy * right + fx * across[1])
    blur = np.exp(-2 * np.pi**2 * (0.1 * fy**2 + 0.2 * fx**2))
    wanted = 2 + area * blur * np.cos(2 * np.pi * (fy * rows + fx * columns))
    np.testing.assert_allclose(sampler(view, grid, finer)(image), wanted, atol=2e-3 if finer == 1 else 2e-4)


def test_a_view_is_what_it_was_after_a_bundle() -> None:
    view = View((3, 4), shift_x_px=0.5, sensitivity=(0.1, 0, 0, 0, 0.2) + (0,) * 9)
    assert View.from_json(view.as_json()) == view


@pytest.mark.parametrize("half_width", [0.8, 0.5])
@pytest.mark.parametrize("channels", [("green",), ("red", "green")])
def test_derivatives_are_what_differences_say(channels: tuple[str, ...], half_width: float) -> None:
    """Every column of the fit against a central difference of the prediction, with modes, leak and crosstalk."""
    full = random_path(SMALL, half_width)
    one = ColourLightPath(full, WAVELENGTH_NM)
    rng = np.random.default_rng(2)
    gray = rng.integers(0, 256, SMALL, dtype=np.uint8)
    shot = shot_of("green", gray, np.zeros(SMALL, np.float32), 0.0, np.ones(SMALL, np.float32))
    layout = ParameterLayout(channels, 3, 2)
    start = layout.moved(
        layout.nothing(Estimate(Drift(), View(SMALL))), 0.02 * rng.normal(size=int(layout.edges[-1]))
    )
    bases = {"green": one}
    columns = dict(Columns(bases, start, layout).of(shot))
    of_red = range(int(layout.edges[1]), int(layout.edges[1]) + layout.block * (len(channels) - 1))
    assert sorted(columns) == [k for k in range(int(layout.edges[-1])) if k not in of_red]
    for place, column in columns.items():
        step = np.zeros(int(layout.edges[-1]))
        step[place] = 1e-2 if place < layout.edges[1] else 1e-3
        above, below = (
            predicted(
                one,
                shot,
                layout.moved(start, s * step),
                sampler(layout.moved(start, s * step).view, full.grid),
            )
            for s in (1, -1)
        )
        wanted = (above - below).astype(float) / (2 * step[place])
        assert np.linalg.norm(column - wanted) < 0.05 * np.linalg.norm(wanted), place


@pytest.mark.parametrize("has", [(), tuple(gray_levels())])
def test_a_sweep_of_gratings_gives_a_hidden_response(has: tuple[int, ...]) -> None:
    """Also of a panel with 16 gray levels, which shows others as the nearest of its own."""
    shape = (64, 80)
    bench = drifted_bench("phase_response", shape=shape)
    bench = replace(bench, panel=replace(bench.panel, gray_levels=tuple(map(float, has))))
    device, one, still = headset(bench), base(shape), Estimate(Drift(), View(shape))
    if has:
        path = one.path
        coarse = replace(path, response=path.response[shown_as(has, 256)], gray_levels=has)
        one = replace(one, path=coarse)
    taker = Taker(devices(device), lambda what: None)
    black, floor = taker.darkness()
    taker.light("green")
    taker.expose(grains(shape, 4, 0), black)
    noise = taker.noise(grains(shape, 4, 0), black, floor)
    sample = sampler(still.view, one.path.grid)
    period = best_period(one, "green", still, sample)
    shots = taker.shots("green", [grating(shape, period, g) for g in swept(one.path)], noise, "grating")
    predictor = Predictor({"green": one})
    predictor.take(still)
    sweep = measured_sweep(predictor, shots)
    true = Drive(bench, WAVELENGTH_NM).magnitude(np.arange(256.0)[None])[0]
    assert np.abs(true - one.path.response).max() > 0.5
    assert np.abs(sweep.phase - true[sweep.gray]).max() < 0.03
    assert sweep.visibility.min() > 0.98 and 0 < sweep.error.max() < 0.02
    found = fitted_response(np.asarray(one.path.response, float), sweep, has)
    assert np.abs(found - true).max() < 0.02
    assert (
        (np.diff(found) >= 0).all() if not has else len(np.unique(found)) == len(has) == len(sweep.gray) + 1
    )


def test_the_cameras_noise_is_measured_without_its_data_sheet() -> None:
    shape = (64, 80)
    device = headset(drifted_bench(shape=shape))
    camera = device.description.camera
    taker = Taker(devices(device), lambda what: None)
    black, floor = taker.darkness()
    taker.light("green")
    exposure = taker.expose(grains(shape, 4, 0), black)
    noise = taker.noise(grains(shape, 4, 0), black, floor)
    counts = (2**camera.bit_depth - 1 - camera.black_level) / camera.full_well_e  # of an electron
    assert noise.black == pytest.approx(camera.black_level, abs=0.2)
    assert noise.slope == pytest.approx(counts, rel=0.1)
    assert noise.floor == pytest.approx((camera.read_noise_e * counts) ** 2 + 1 / 12, rel=0.1)
    top = taker.shot("green", grains(shape, 4, 0), noise, "").weight == 0
    assert top.mean() < 0.005 and 1 < exposure < 100


def test_pixels_that_are_full_below_the_top_count_get_a_shorter_exposure() -> None:
    shape, knee_share = (64, 80), 0.1
    gray = grains(shape, 4, 0)

    def exposure(*defects: str, **parameters: float) -> float:
        taker = Taker(devices(headset(drifted_bench(*defects, shape=shape, **parameters))), lambda what: None)
        black, _ = taker.darkness()
        taker.light("green")
        return taker.expose(gray, black)

    bent, straight = exposure("sensor_response", knee_share=knee_share), exposure()
    # From where the curve bends to where twice the light gives a quarter more: s / knee from about 1 to 2.2.
    assert knee_share * straight / 0.7 < bent < 2.5 * knee_share * straight / 0.7


def test_power_of_gratings_gives_the_phase_that_made_it() -> None:
    gray = np.arange(256)
    true = 12.0 * (gray / 255) ** 1.4
    envelope = 1 - 0.3 * gray / 255  # the contrast of a real panel falls with voltage
    power = envelope * (1 - np.cos(true)) / 2 + 0.02
    assert np.abs(phase_of_power(power) - true).max() < 0.3
    assert np.abs(phase_of_power((1 - np.cos(true)) / 2) - true)[true < 4 * np.pi].max() < 0.15
    with pytest.raises(InputError, match="half a wave"):
        phase_of_power((1 - np.cos(0.8 * np.pi * gray / 255)) / 2)


def test_a_real_panels_linear_table_is_straightened_by_its_own_corrected_one(shared: Path) -> None:
    """Meadowlark 1920 x 1152, 532 nm: the measured phase, read at the corrected table's voltages, is a line.

    The sweep has one point every 8 voltage steps; the corrected table was made by the panel's owner, from it.
    """
    folder = shared / "real" / "panel_response"
    if not folder.is_dir():
        pytest.skip("no measurements of a real panel here")
    power = np.loadtxt(folder / "GlobalNormalizedMeasurements.csv", delimiter=",")[:, 1]
    table = np.loadtxt(folder / "SN5721_WL532_Global.lut")[:, 1] / 8
    gray = np.arange(256)
    phase = np.interp(table, gray, phase_of_power(power))
    slope, start = np.polyfit(gray, phase, 1)
    assert slope == pytest.approx(2 * np.pi / 256, rel=0.02)
    assert np.std(phase - start - slope * gray) < 0.07  # a 90th of a wave


def test_a_real_panels_correction_is_seen_to_peak_too_early(shared: Path) -> None:
    """After correction half a wave comes at gray 118 where 128 was meant, in noisy power."""
    folder = shared / "real" / "panel_response"
    if not folder.is_dir():
        pytest.skip("no measurements of a real panel here")
    power = np.loadtxt(folder / "Raw0.csv", delimiter=",")[:, 1]
    gray = np.arange(256)
    measured = Sweep(gray, phase_of_power(power), np.full(256, 0.1), np.ones(256))
    found = fitted_response(2 * np.pi * gray / 256, measured)
    assert np.interp(np.pi, found, gray) == pytest.approx(118, abs=5)
    assert (np.diff(found) >= 0).all()


def _heldout(excess: float, rng: np.random.Generator, count: int = 400) -> PredictionErrors:
    """A held-out error whose tiles scatter by a tenth about their mean."""
    noise = 0.001
    tiles = (excess + noise) * (1 + 0.1 * rng.normal(size=count)) / count
    return PredictionErrors(
        ("0",),
        tiles[None],
        np.full((1, tiles.size), noise / tiles.size),
        np.ones(1),
        np.full(1, float(count)),
    )


@pytest.mark.parametrize(
    ("before", "after", "known", "said", "whole"),
    [
        (0.2, 1e-5, 0, "recalibrated", True),
        (0.2, 0.05, 0, "recalibrated", False),  # better, and something else is wrong as well
        (0.2, 0.15, 0, "not_explained", False),  # better, but most of it is something else
        (0.2, 0.15, 0.14, "recalibrated", False),  # most of what has come since the export
        (0.2, 0.2, 0, "not_explained", False),
        (0.2, 0.4, 0, "not_explained", False),
        (0.15, 0.15, 0.14, "unchanged", False),  # as good as it ever was
        (5e-5, 1e-5, 0, "unchanged", True),  # too little to matter, however sure
    ],
)
def test_the_verdict_asks_whether_it_is_real_and_whether_it_matters(
    before: float, after: float, known: float, said: str, whole: bool
) -> None:
    rng = np.random.default_rng(3)
    one, other = _heldout(before, rng), _heldout(after, rng)
    assert replacement_verdict(one, other, known) == said
    assert is_complete(other.excess, one.excess) == whole


def test_a_gain_that_few_tiles_make_is_not_believed() -> None:
    rng = np.random.default_rng(4)
    before = _heldout(0.2, rng, 16)
    lucky = before.squared.copy()
    lucky[0, 0] *= 0.05
    after = replace(before, squared=lucky)
    assert replacement_verdict(before, after) == "not_explained"


def test_grains_use_every_gray_level_and_differ_with_the_seed() -> None:
    one = grains((120, 160), 2, 0)
    assert one.shape == (120, 160) and len(np.unique(one)) == 256
    assert (one != grains((120, 160), 2, 1)).mean() > 0.9
    path = ideal_path((120, 160), 8e-3)
    assert path.grid.pitch == PITCH and panel_phase(path, one.astype(np.int64)).shape == (120, 160)


def test_a_capture_keeps_its_weights_in_half_of_the_memory() -> None:
    rng = np.random.default_rng(7)
    counts = rng.integers(60, 4000, SMALL).astype(np.uint16)
    weight = np.where(counts > 3900, 0, 1 / (4 + 0.2 * counts)).astype(np.float32)
    shot = shot_of("green", np.zeros(SMALL, np.uint8), counts, 64.0, weight)
    assert shot.signal.dtype == shot.weight.dtype == np.float32
    np.testing.assert_array_equal(shot.signal, counts.astype(np.float32) - 64)
    np.testing.assert_allclose(shot.weight, weight, rtol=2**-8)
    np.testing.assert_array_equal(shot.weight == 0, weight == 0)
    assert shot.counts.nbytes + shot.weight_halves.nbytes == weight.nbytes


@pytest.mark.parametrize(
    ("share", "pictures"), [(0.0, 0), (0.001, 0), (0.04, 1), (0.1, 2), (0.3, 5), (0.9, 59)]
)
def test_a_slow_panel_is_waited_for_until_little_is_left(share: float, pictures: int) -> None:
    assert settling_periods(share) == pictures
    assert share ** (pictures + 1) <= 1 / 512 and (pictures == 0 or share**pictures > 1 / 512)


@pytest.mark.usefixtures("spared_maps")
def test_a_calibration_on_a_slow_panel_finds_the_drift_alone(tmp_path: Path) -> None:
    shape, share = (48, 64), 0.1
    bench = drifted_bench("panel_wavefront", shape=shape)
    bench = replace(bench, defects=(*bench.defects, make_defect("slow_response", share=share)))
    found = {
        said: calibrate(opened(headset(bench)), read_bundle(ideal_bundle(tmp_path / str(said), shape, said)))
        for said in (0.0, share)
    }
    assert found[0.0].verdict != "recalibrated", "without waiting, each picture has a tenth of the one before"
    assert found[share].verdict == "recalibrated" and found[share].complete
    assert found[share].after.errors.excess < 0.01 * found[0.0].after.errors.excess
    before, after = (found[share].pictures["green"][when][1] for when in ("before", "after"))
    assert after > before + 6
