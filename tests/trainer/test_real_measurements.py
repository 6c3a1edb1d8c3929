"""Real measurements: a panel's grating sweeps, a bench's field, and holograms that nobody here made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from firmware_iface.errors import InputError
from firmware_iface.virtual import load_bench, open_headset
from runtime.lightpath.propagation import band_limit, far_field, transfer_function
from trainer.captures.grating_powers import fitted_to_powers, read_powers
from trainer.cli import main


@pytest.fixture
def real(shared: Path) -> Path:
    folder = shared / "real"
    if not folder.is_dir():
        pytest.skip("no real measurements here")
    return folder


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_a_fitted_response_errs_as_its_errors_say(noise: float) -> None:
    rng, gray = np.random.default_rng(0), np.arange(256.0)
    true = 12.0 * (gray / 255) ** 1.4
    z = []
    for _ in range(4):
        power = (1 - 0.3 * gray / 255) * (1 - np.cos(true)) / 2 + 0.02 + noise * rng.normal(size=256)
        found = fitted_to_powers(gray, power)
        assert found.error[10:].max() < 20 * noise
        z.append((found.phase - true)[10:] / found.error[10:])
    assert 0.6 < np.std(z) < 1.5


def test_a_real_panels_response_and_its_error(real: Path) -> None:
    found = fitted_to_powers(*read_powers(real / "panel_response" / "GlobalNormalizedMeasurements.csv"))
    assert (np.diff(found.phase) >= 0).all() and found.left < 0.02
    halves = found.gray_of(np.pi * np.arange(1, 6))
    assert halves[::2] == pytest.approx([121, 172, 189], abs=5)  # where the power has its maxima
    table = np.loadtxt(real / "panel_response" / "SN5721_WL532_Global.lut")[:, 1] / 8
    phase, gray = np.interp(table, found.gray, found.phase), np.arange(256)
    slope, start = np.polyfit(gray, phase, 1)
    assert slope == pytest.approx(2 * np.pi / 256, rel=0.05)
    assert np.std(phase - start - slope * gray) < 0.1 < 2 * np.interp(table, found.gray, found.error).mean()


def test_a_corrected_panel_has_its_half_wave_near_the_middle(real: Path) -> None:
    found = fitted_to_powers(*read_powers(real / "panel_response" / "Raw0.csv"))
    assert found.gray_of(np.array([np.pi]))[0] == pytest.approx(122, abs=8)
    assert found.phase[-1] / (2 * np.pi) == pytest.approx(0.95, abs=0.06)


def test_the_command_writes_the_response(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gray = np.arange(0, 256, 4)
    lines = [f"{g},{(1 - np.cos(4 * np.pi * g / 255)) / 2:.6f}" for g in gray]
    powers = tmp_path / "powers.csv"
    powers.write_text("\n".join(["gray,power", *lines]))
    assert main(["response", str(powers), "--out", str(tmp_path / "response.csv")]) == 0
    assert "1.976 ± 0.000 waves" in capsys.readouterr().out
    table = np.loadtxt(tmp_path / "response.csv", delimiter=",", skiprows=1)
    assert np.abs(table[:, 1] - 4 * np.pi * gray / 255).max() < 0.05


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,1\n1,two", "line 2 is not 'gray,power'"),
        ("0,1\n1,2", "at least 16"),
        ("\n".join(f"{g},{g}" for g in range(32)), "no maximum"),
        ("0,1\n1,nan", "no finite number"),
    ],
)
def test_powers_that_cannot_be_used_get_a_sentence(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "powers.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        fitted_to_powers(*read_powers(tmp_path / "powers.csv"))


def field_bench(folder: Path, **arrays: np.ndarray) -> Path:
    np.savez(folder / "field.npz", **arrays)
    bench = folder / "bench.toml"
    bench.write_text(
        "[panel]\nwidth = 48\nheight = 32\n[propagation]\ndistance_mm = 0\n"
        '[[defect]]\nkind = "measured_field"\nfile = "field.npz"\nwavelength_nm = 520\n'
    )
    return bench


def test_a_measured_field_is_on_the_panel_as_it_is(tmp_path: Path) -> None:
    y, x = np.mgrid[-1:1:81j, -1:1:121j][:, 1::2, 1::2]  # centres of cells
    amplitude, phase = np.exp(-(x**2) - y**2), 3 * x * y + 2 * x**2
    headset = open_headset(str(field_bench(tmp_path, amplitude=amplitude, phase_rad=phase % (2 * np.pi))))
    lit = headset._optics.surface(520.0).lit
    y, x = np.mgrid[-1:1:257j, -1:1:385j][:, 1::2, 1::2]
    assert lit.shape == y.shape
    assert np.mean(np.abs(lit) ** 2) == pytest.approx(1, rel=1e-4)
    expected = np.exp(-(x**2) - y**2 + 1j * (3 * x * y + 2 * x**2))
    expected /= np.sqrt(np.mean(np.abs(expected) ** 2))
    inside = (slice(8, -8), slice(8, -8))
    assert np.abs(lit - expected)[inside].max() < 0.03


def test_a_real_benchs_beam_is_on_the_panel(real: Path, tmp_path: Path) -> None:
    bench = field_bench(tmp_path, nothing=np.zeros((2, 2)))
    file = real / "bench_field" / "santec_wavefront_calibration.npz"
    text = bench.read_text().replace("field.npz", str(file)).replace("= 520", "= 633")
    bench.write_text(
        text + 'amplitude = "amplitude_smooth"\n[[channel]]\nname = "red"\nwavelength_nm = 633\n'
    )
    headset = open_headset(str(bench))
    lit = np.abs(headset._optics.surface(633.0).lit)
    with np.load(file) as arrays:
        beam = np.asarray(
            Image.fromarray(arrays["amplitude_smooth"]).resize((192, 128), Image.Resampling.BILINEAR)
        )
    assert np.corrcoef(lit.ravel(), beam.ravel())[0, 1] > 0.999
    assert lit[4:12, 4:12].max() < 0.05 < 1.0 < lit.max()  # no light in the corners


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.ones((4, 4))}, "no array 'amplitude'; it has other"),
        ({"amplitude": np.ones(4), "phase_rad": np.ones((4, 4))}, "not a picture"),
        ({"amplitude": np.zeros((4, 4)), "phase_rad": np.ones((4, 4))}, "dark everywhere"),
    ],
)
def test_a_field_that_cannot_be_used_gets_a_sentence(tmp_path: Path, arrays: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_bench(str(field_bench(tmp_path, **arrays)))


def test_a_field_of_another_wavelength_is_refused(tmp_path: Path) -> None:
    bench = field_bench(tmp_path, amplitude=np.ones((4, 4)), phase_rad=np.ones((4, 4)))
    bench.write_text(bench.read_text().replace("= 520", "= 633"))
    with pytest.raises(InputError, match="measured at 633 nm and the bench has 520 nm"):
        load_bench(str(bench))


def test_two_real_planes_agree_at_the_gap_that_was_set(real: Path) -> None:
    """Two cameras 80 mm apart saw one wave of 632.8 nm; the second's frame is a pixel off."""
    waves = []
    for name in ("holo1", "holo2"):
        amplitude = np.sqrt(np.asarray(Image.open(real / "two_plane" / f"{name}.png"), float))
        waves.append(amplitude / gaussian_filter(amplitude, 40))
    side, pitch, wavelength = waves[0].shape[0], 10e-6, 632.8e-9
    f = np.fft.fftfreq(side, pitch)
    middle = (slice(side // 4, -side // 4),) * 2

    def agreement(gap: float) -> float:
        limit = band_limit(wavelength, gap, side * pitch)
        move = transfer_function(f[:, None], f[None, :], wavelength, gap, (limit, limit), "angular_spectrum")
        there = np.abs(np.fft.ifft2(np.fft.fft2(waves[0]) * move))[middle]
        one, other = (np.fft.fft2(w - w.mean()) for w in (there, waves[1][middle]))
        size = np.sqrt(np.mean(np.abs(one) ** 2) * np.mean(np.abs(other) ** 2)) * there.size / one.size
        return float(np.fft.ifft2(one * other.conj()).real.max() / size)

    gaps = np.array([60, 70, 76, 79, 80, 81, 84, 90, 100]) * 1e-3
    found = [agreement(gap) for gap in gaps]
    assert gaps[int(np.argmax(found))] == pytest.approx(80e-3)
    assert max(found) > 0.5 > 2 * found[0]


def test_a_real_off_axis_hologram_shows_its_die(real: Path) -> None:
    """632.8 nm, 6.8 um, 1.054 m: the Fresnel integral as a far field of the hologram times a lens."""
    picture = Image.open(real / "off_axis" / "ulf7.png").convert("L")
    hologram = np.asarray(picture, float) - np.asarray(picture, float).mean()
    wavelength, pitch, distance = 632.8e-9, 6.8e-6, 1.054
    x = (np.arange(1024) - 512) * pitch
    lens = np.exp(1j * np.pi / (wavelength * distance) * (x[:, None] ** 2 + x**2))
    step = wavelength * distance / (1024 * pitch)
    at = (np.arange(512) - 256) * 2 * step
    light = np.abs(far_field(hologram * lens, pitch, at, at, wavelength, distance)) ** 2
    light = gaussian_filter(light, 1)
    y, x = np.mgrid[:512, :512]
    from_die = np.hypot(y - 182, x - 255)
    die, above = light[from_die < 34].mean(), light[(from_die > 46) & (from_die < 60) & (y < 182)].mean()
    assert die > 8 * above
    pip, face = light[188:194, 253:259].mean(), light[[178, 178, 205, 205], [240, 262, 240, 275]].mean()
    assert pip < 0.5 * face
