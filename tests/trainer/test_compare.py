"""`trainer.diagnosis.comparison` on small sets from a propagator of this file's own, with errors planted in them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from firmware_iface.errors import InputError
from runtime.excess import joined
from tests.trainer.hidden import LARGER, captured, ran
from tests.trainer.made_sets import write_captures
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.diagnosis import comparison as module
from trainer.diagnosis.comparison import Comparison, compare
from trainer.effects import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.predictor import Predictor
from trainer.model.model import Model, absent, instance_with

HEIGHT, WIDTH, PITCH, DISTANCE = 96, 128, 8e-6, 10e-3
WAVELENGTH = {"green": 520e-9, "blue": 450e-9}
BLACK, TOP, WELL, READ = 64, 4095, 10500, 5
COUNTS = 300.0  # a unit of light at 10 ms


def bench() -> dict:
    camera = {"width": WIDTH, "height": HEIGHT, "pixel_um": 8.0, "registered": True, "bit_depth": 12,
              "black_level": BLACK, "full_well_e": WELL, "read_noise_e": READ}  # fmt: skip
    return {
        "schema": 1,
        "name": "small",
        "panel": {"width": WIDTH, "height": HEIGHT, "pitch_um": 8.0},
        "channel": [{"name": n, "wavelength_nm": w * 1e9} for n, w in WAVELENGTH.items()],
        "propagation": {"distance_mm": DISTANCE * 1e3},
        "iris": {"shape": "square", "half_width": 1.0},
        "camera": camera,
    }


def smooth_pattern(rng: np.random.Generator) -> np.ndarray:
    """Gray levels with little light at the edge of the band, where a grid's last frequency is ambiguous."""
    phase = gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 2) * 600
    return (np.rint(phase) % 256).astype(np.uint8)


def light(gray: np.ndarray, wavelength: float) -> np.ndarray:
    """Irradiance over the area of each pixel, [H, W], by the angular spectrum on a doubled, padded field."""
    rows, columns = 2 * HEIGHT, 2 * WIDTH
    field = np.zeros((rows, columns), complex)
    field[HEIGHT // 2 : -HEIGHT // 2, WIDTH // 2 : -WIDTH // 2] = np.exp(2j * np.pi * gray / 256)
    fy, fx = np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns)[None]
    axial = np.sqrt(wavelength**-2 - (fy**2 + fx**2) / PITCH**2)
    band = np.fft.fft2(field) * np.sinc(fy) * np.sinc(fx) * np.exp(2j * np.pi * DISTANCE * axial)
    wide = np.zeros((2 * rows, 2 * columns), complex)
    place = np.ix_(np.rint(fy[:, 0] * rows).astype(int), np.rint(fx[0] * columns).astype(int))
    wide[place] = band
    image = np.abs(np.fft.ifft2(wide) * 4) ** 2
    gy, gx = 2 * np.fft.fftfreq(2 * rows)[:, None], 2 * np.fft.fftfreq(2 * columns)[None]
    image = np.fft.ifft2(np.fft.fft2(image) * np.sinc(gy) * np.sinc(gx)).real[::2, ::2]
    return image[HEIGHT // 2 : -HEIGHT // 2, WIDTH // 2 : -WIDTH // 2]


Change = Callable[[np.ndarray, int], np.ndarray]


def make_set(
    folder: Path,
    patterns: int = 6,
    channels: tuple[str, ...] = ("green",),
    change: Change | None = None,
    finish: Change | None = None,
) -> CaptureSet:
    """Every pattern captured once, the first and second twice; `change` acts on light, `finish` on counts."""
    rng = np.random.default_rng(5)
    rows = []
    for channel in channels:
        for p in range(patterns):
            gray = smooth_pattern(rng)
            irradiance = light(gray, WAVELENGTH[channel])
            for _ in range(2 if p < 2 else 1):
                k = len(rows)
                image = change(irradiance, k) if change else irradiance
                electrons = image * COUNTS * WELL / (TOP - BLACK)
                electrons = rng.poisson(np.maximum(electrons, 0)) + rng.normal(0, READ, image.shape)
                counts = np.clip(np.rint(BLACK + electrons * (TOP - BLACK) / WELL), 0, TOP)
                counts = finish(counts, k) if finish else counts
                row = {"gray": gray, "counts": counts.astype(np.uint16), "channel": channel}
                rows.append({**row, "pattern": f"{channel}-{p}", "exposure_ms": 10.0, "time_s": 2.0 * k})
    write_captures(folder, bench(), rows)
    return read_captures(folder)


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    return make_set(tmp_path_factory.mktemp("sets") / "ideal", channels=("green", "blue"))


@pytest.fixture(scope="module")
def result(ideal: CaptureSet) -> Comparison:
    return compare(ideal, Model(ideal.bench))


def test_a_right_model_ends_at_the_cameras_noise(result: Comparison) -> None:
    found = result.as_json()
    assert abs(found["heldout"]["excess"]) < 2e-4
    assert found["heldout"]["nrmse"] == pytest.approx(found["heldout"]["noise_nrmse"], rel=0.02)
    assert set(found["by_channel"]) == {"green", "blue"} and set(found["by_plane"]) == {"10"}
    assert all(abs(r["excess"]) < 5e-4 for r in found["by_capture"])
    assert all(abs(r["gain"] - 1) < 0.01 for r in found["by_capture"])
    assert result.model.gain["green"] == pytest.approx(COUNTS / 10, rel=0.01)


def test_json_has_its_documented_keys_and_no_nan(result: Comparison) -> None:
    found = result.as_json()
    json.dumps(found, allow_nan=False)
    assert {"heldout", "psnr_db", "by_channel", "by_capture", "where"} <= set(found)
    assert set(found["heldout"]) == {"nrmse", "noise_nrmse", "excess"}
    assert {"field", "frequency", "brightness", "time"} <= set(found["where"])
    assert {"capture", "channel", "plane_mm", "nrmse", "noise_nrmse", "excess"} <= set(found["by_capture"][0])
    field = np.array(found["where"]["field"])
    assert field.shape == (12, 16)
    assert set(found["where"]["frequency"][0]) == {"cycles_per_pixel", "error", "noise", "signal"}


def test_the_noise_floor_is_what_repeats_show(ideal: CaptureSet, result: Comparison) -> None:
    assert result.noise_from_repeats == pytest.approx(1, abs=0.03)
    pairs = [c for c in ideal.captures if c.pattern == "green-1"]
    first, second = (ideal.signal(c)[0].astype(float) for c in pairs)
    measured = np.sqrt(np.var(first - second) / 2 / np.var(first))
    row = next(r for r in result.by_capture() if r["capture"] == pairs[0].capture)
    assert row["noise_nrmse"] == pytest.approx(measured, rel=0.03)


def test_psnr_is_against_the_cameras_full_scale(result: Comparison) -> None:
    mse = float(result.errors.squared.sum() / result.errors.pixels.sum())
    assert result.psnr_db == pytest.approx(10 * np.log10((TOP - BLACK) ** 2 / mse))


def test_spectra_of_noise_are_flat_and_agree_with_the_residual(result: Comparison) -> None:
    rows = result.as_json()["where"]["frequency"]
    ratio = np.array([r["error"] / r["noise"] for r in rows[2:] if r["cycles_per_pixel"] < 0.6])
    assert np.all(np.abs(ratio - 1) < 0.15) and abs(ratio.mean() - 1) < 0.03
    assert np.all(np.diff([r["cycles_per_pixel"] for r in rows]) > 0)


def test_a_brighter_corner_shows_at_its_place_in_the_field(tmp_path: Path) -> None:
    def corner(image: np.ndarray, k: int) -> np.ndarray:
        image = image.copy()
        image[-24:, :32] *= 1.5
        return image

    captures = make_set(tmp_path / "corner", change=corner)
    field = np.array(compare(captures, Model(captures.bench)).as_json()["where"]["field"])
    inside = np.zeros(field.shape, bool)
    inside[-3:, :4] = True
    assert field[inside].mean() > 20 * field[~inside].mean()
    assert inside.ravel()[np.argsort(field.ravel())[-8:]].all()


def test_the_mean_of_the_field_is_the_excess(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "gradient", change=lambda image, k: image * np.linspace(0.8, 1.2, WIDTH))
    found = compare(captures, Model(captures.bench)).as_json()
    assert np.mean(found["where"]["field"]) == pytest.approx(found["heldout"]["excess"], rel=0.01)


def test_a_drift_shows_over_time(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "drift", patterns=9, change=lambda image, k: image * (1 + 0.03 * k))
    rows = compare(captures, Model(captures.bench)).as_json()["where"]["time"]
    gains, times = np.array([r["gain"] for r in rows]), np.array([r["time_s"] for r in rows])
    assert np.all(np.diff(times) > 0)
    true = 1 + 0.03 * times / 2
    np.testing.assert_allclose(gains / gains[0], true / true[0], atol=0.005)


def test_missing_light_shows_as_a_bias_of_dark_pixels(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "veil", change=lambda image, k: image + 0.2)
    rows = compare(captures, Model(captures.bench)).as_json()["where"]["brightness"]
    assert rows[0]["bias"] == pytest.approx(0.2 * COUNTS, rel=0.2)
    assert np.all(np.diff([r["counts"] for r in rows]) > 0)
    assert sum(r["pixels"] for r in rows) > 0.99 * 3 * HEIGHT * WIDTH


def test_saturated_pixels_change_nothing(tmp_path: Path) -> None:
    def burn(counts: np.ndarray, k: int) -> np.ndarray:
        counts = counts.copy()
        counts[:30, 40:90] = TOP
        return counts

    clean = make_set(tmp_path / "clean")
    burnt = make_set(tmp_path / "burnt", finish=burn)
    one, two = (compare(s, Model(s.bench)).as_json() for s in (clean, burnt))
    assert two["heldout"]["excess"] == pytest.approx(one["heldout"]["excess"], abs=2e-4)
    assert two["psnr_db"] == pytest.approx(one["psnr_db"], abs=0.2)
    assert two["noise_from_repeats"] == pytest.approx(1, abs=0.04)
    field = two["where"]["field"]
    assert field[0][7] is None and field[8][7] is not None
    assert all(abs(v) < 3e-3 for row in field for v in row if v is not None)
    assert all(abs(r["gain"] - 1) < 0.01 for r in two["where"]["time"])
    rows = [r for r in two["where"]["frequency"] if 0.05 < r["cycles_per_pixel"] < 0.6]
    assert all(abs(r["error"] / r["noise"] - 1) < 0.2 for r in rows)
    assert sum(r["pixels"] for r in two["where"]["brightness"]) < sum(
        r["pixels"] for r in one["where"]["brightness"]
    )


def test_all_saturated_is_an_error_that_says_what_to_change(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "white", patterns=3, finish=lambda counts, k: np.full_like(counts, TOP))
    with pytest.raises(InputError, match="lower the exposure"):
        compare(captures, replace(Model(captures.bench), gain={"green": 30.0}))


def test_a_models_own_gain_stands(ideal: CaptureSet) -> None:
    model = replace(Model(ideal.bench), gain={"green": 0.9 * COUNTS / 10})
    result = compare(ideal, model)
    assert result.model.gain["green"] == model.gain["green"]
    rows = {r["channel"]: r for r in result.as_json()["where"]["time"]}
    assert rows["green"]["gain"] == pytest.approx(1 / 0.9, rel=0.01)
    assert rows["blue"]["gain"] == pytest.approx(1, rel=0.01)


def test_the_gain_of_a_curved_response_is_fitted(ideal: CaptureSet) -> None:
    curve = absent(catalogue()["sensor_response"], ideal.bench)
    model = Model(ideal.bench, (curve.with_values({"bend": np.array([0.3, 0.0])}),))
    rows = [c for c in ideal.captures if c.channel == "green"][:3]
    found = with_gains(ideal, model, rows)
    batches = load(ideal, rows)

    def excess(factor: float) -> float:
        trial = replace(found, gain={"green": found.gain["green"] * factor})
        return joined([b.errors(Predictor(trial, b).predict(trial)) for b in batches]).excess

    assert excess(1.0) < min(excess(0.98), excess(1.02))


def test_one_capture_is_in_memory_at_a_time(ideal: CaptureSet, monkeypatch: pytest.MonkeyPatch) -> None:
    read = module.load_batch
    sizes: list[int] = []

    def counting(captures: CaptureSet, rows: list) -> object:
        sizes.append(len(rows))
        return read(captures, rows)

    monkeypatch.setattr(module, "load_batch", counting)
    shares: list[float] = []
    compare(ideal, Model(ideal.bench), progress=shares.append)
    assert set(sizes) == {1} and len(sizes) > 4
    assert shares == sorted(shares) and shares[-1] == 1


def test_pictures_show_every_colour_first(result: Comparison) -> None:
    pictures = result.pictures
    assert len(pictures) == 3 and {p.channel for p in pictures} == {"green", "blue"}
    for p in pictures:
        assert p.measured.shape == p.predicted.shape == (HEIGHT, WIDTH)
        np.testing.assert_allclose(p.difference, p.measured - p.predicted, atol=1e-3)


@pytest.mark.parametrize(
    "iris, fill_factor",
    [
        (("circle", 0.7), 1.0),
        (("circle", 0.3), 1.0),
        (("square", 0.837), 1.0),
        (("square", 0.3), 1.0),
        (("square", 1.0), 0.8),
        (("square", 1.5), 0.9),
        (("circle", 1.9), 0.9),
    ],
)
def test_what_the_bench_file_states_is_in_the_model(iris, fill_factor, tmp_path, capsys) -> None:
    options = ("--patterns", 6)
    captures = captured(capsys, tmp_path, options=options, iris=iris, fill_factor=fill_factor, **LARGER)
    assert ran(capsys, "compare", captures)["heldout"]["excess"] < 0.0004


def test_the_figure_of_an_iris_that_an_effect_closes_has_room(tmp_path, capsys) -> None:
    """Near the panel the grid of the open iris does not hold it: 0.0013 would be left."""
    iris = 'kind = "iris"\nshape = "circle"\nhalf_width = 0.3\ncentre_x_share = 0\ncentre_y_share = 0'
    sizes = LARGER | {"distance_mm": 4}
    captures = read_captures(captured(capsys, tmp_path, iris, options=("--patterns", 6), **sizes))
    effect = instance_with(catalogue()["iris"], captures.bench, {"half_width": 0.3, "roundness": 1.0})
    assert compare(captures, Model(captures.bench).having(effect)).as_json()["heldout"]["excess"] < 0.0004
