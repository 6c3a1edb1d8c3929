"""Every built-in effect: nothing when absent, derivatives, what it acts on, and the physics of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import j0, jv
from torch import Tensor

from runtime.lightpath.fft import irfft2
from runtime.lightpath.grid import FINE
from runtime.lightpath.legendre import legendre_maps
from trainer.captures.bench_file import Bench, read_bench
from trainer.effects import catalogue
from trainer.effects.zernike import zernike_count, zernike_surface
from trainer.model.model import EffectInstance, Model, absent
from trainer.model.model_stages import scene_for, stages_for
from trainer.prediction.camera_light import counts, light_on_camera
from trainer.prediction.predict import light_path, trace
from trainer.prediction.scene import Scene, Stages

TABLE = {
    "phase_response": ("drive", "display"),
    "phase_nonuniformity": ("drive", "display"),
    "crosstalk": ("drive", "display"),
    "zero_order": ("panel", "display"),
    "illumination": ("panel", "display"),
    "panel_wavefront": ("panel", "display"),
    "distance": ("pupil", "display"),
    "pupil_aberration": ("pupil", "display"),
    "iris": ("pupil", "display"),
    "temporal_coherence": ("pupil", "display"),
    "spatial_coherence": ("pupil", "display"),
    "sensor_blur": ("sensor", "camera"),
    "misregistration": ("sensor", "camera"),
    "vignetting": ("sensor", "camera"),
    "stray_light": ("sensor", "camera"),
    "sensor_response": ("sensor", "camera"),
    "laser_drift": ("sensor", "camera"),
    "ghost": ("sensor", "display"),
}
KNOWN = catalogue()
HEIGHT, WIDTH, PLANE = 56, 64, 6.0


@cache
def bench(colours: bool = False) -> Bench:
    nominal = {"red": 638.0, "green": 520.0} if colours else {"green": 520.0}
    camera = {
        "width": WIDTH,
        "height": HEIGHT,
        "pixel_um": 8.0,
        "registered": True,
        "bit_depth": 12,
        "black_level": 64.0,
        "full_well_e": 10500.0,
        "read_noise_e": 5.0,
    }
    return read_bench(
        {
            "schema": 1,
            "name": "effects",
            "panel": {"width": WIDTH, "height": HEIGHT, "pitch_um": 8.0, "fill_factor": 0.96},
            "channel": [{"name": n, "wavelength_nm": w} for n, w in nominal.items()],
            "propagation": {"distance_mm": PLANE},
            "iris": {"shape": "square", "half_width": 0.9},
            "camera": camera,
        }
    )


@cache
def gray() -> Tensor:
    rng = np.random.default_rng(0)
    smooth = torch.as_tensor(rng.normal(size=(2, 1, HEIGHT, WIDTH)))
    smooth = torch.nn.functional.avg_pool2d(smooth, 3, 1, 1)[:, 0]
    return torch.remainder((smooth * 160 + 128).long(), 256)


def present(name: str, order: int | None = None, colours: bool = False, **values: Any) -> EffectInstance:
    start = absent(KNOWN[name], bench(colours), order)
    given = {k: np.array(np.broadcast_to(v, start.values[k].shape), float) for k, v in values.items()}
    return start.with_values({**start.values, **given})


def scene_of(
    *effects: EffectInstance, channel: str = "green", plane: float = PLANE, colours: bool = False
) -> Scene:
    return scene_for(Model(bench(colours), effects), channel, plane, torch.float64)


def predicted(scene: Scene, stages: Stages, measured: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Counts above black [2, h, w]."""
    light = light_on_camera(scene, stages, trace(scene, stages, gray()).image)
    return counts(scene, stages, light, torch.full((2, 1, 1), 400.0, dtype=torch.float64), measured)


def seen(*effects: EffectInstance, plane: float = PLANE, bare: bool = False) -> Tensor:
    """Counts with effects; `bare`: on the same grid, without them."""
    scene = scene_of(*effects, plane=plane)
    return predicted(scene, stages_for(scene, () if bare else effects))


def moved(name: str, order: int | None = None) -> EffectInstance:
    """An effect well away from absent: every number a few scales off, each by another amount."""
    start = absent(KNOWN[name], bench(), order)
    values = {}
    for p in KNOWN[name].parameters:
        value = start.values[p.name]
        away = p.scale * (2.0 + 0.3 * np.arange(value.size).reshape(value.shape))
        values[p.name] = np.where(value + away <= p.high, value + away, value - away)
    return start.with_values(values)


def test_the_catalogue_is_the_one_that_is_described() -> None:
    built_in = {n: (e.stage, e.acts_on) for n, e in KNOWN.items() if n in TABLE}
    assert built_in == TABLE
    assert list(built_in) == list(TABLE)  # in the order that light meets them
    for one in KNOWN.values():
        assert one.about.endswith(".")
        assert all(p.unit and p.scale > 0 and p.low < p.high for p in one.parameters)


@pytest.mark.parametrize("name", TABLE)
def test_absent_changes_nothing(name: str) -> None:
    for order in KNOWN[name].orders:
        with_it = absent(KNOWN[name], bench(), order)
        expected = seen(with_it, bare=True)
        assert float((seen(with_it) - expected).abs().max()) < 1e-6 * float(expected.max())


@pytest.mark.parametrize("name", TABLE)
def test_present_changes_something(name: str) -> None:
    if name == "laser_drift":
        pytest.skip("its size is measured from each capture: see the test of the switch")
    one = moved(name)
    expected = seen(one, bare=True)
    assert float((seen(one) - expected).abs().max()) > 1e-5 * float(expected.max())


@pytest.mark.parametrize("name", [n for n in TABLE if n != "laser_drift"])
def test_every_number_of_every_effect_has_a_derivative(name: str) -> None:
    """Finite and not zero away from absent, at the lowest and the highest order, and that of finite
    differences.

    laser_drift has none: it is a switch that lets each capture have its own gain, which is then measured. How much of
    added light follows that gain shows only then (`test_capture_gain`), and how much the exposure only where that
    differs (`test_added_light`).
    """
    weight = torch.as_tensor(np.random.default_rng(1).normal(size=(2, HEIGHT, WIDTH)))
    for order in {KNOWN[name].orders[0], KNOWN[name].orders[-1]}:
        one = moved(name, order)
        scene = scene_of(one)
        tensors = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in one.values.items()}
        value = (predicted(scene, stages_for(scene, (one,), {name: tensors})) * weight).sum()
        value.backward()
        told = [p for p in one.effect.parameters if p.name not in {"laser_share", "constant"}]
        for p in told:
            if tensors[p.name].numel() == 0:  # a map that has no terms at the lowest order
                continue
            slope = tensors[p.name].grad
            assert slope is not None, p.name
            assert torch.isfinite(slope).all(), p.name
            assert (slope != 0).all(), p.name
    for p in told:  # of the highest order, the first number of each
        # the taps of crosstalk may be of single precision
        step, near = (3e-2 * p.scale, 2e-2) if name == "crosstalk" else (1e-5 * p.scale, 1e-3)
        ends = []
        for sign in (1, -1):
            other = {k: v.copy() for k, v in one.values.items()}
            other[p.name].reshape(-1)[0] += sign * step
            changed = stages_for(scene, (one.with_values(other),))
            ends.append(float((predicted(scene, changed) * weight).sum()))
        slope = float(tensors[p.name].grad.reshape(-1)[0])  # type: ignore[union-attr]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope, rel=near, abs=1e-3 / p.scale), p.name


def flat_light(*effects: EffectInstance) -> Tensor:
    """Light in the middle of the picture of a panel that shows gray 0."""
    scene = scene_of(*effects)
    stages = stages_for(scene, effects)
    image = trace(scene, stages, torch.zeros((1, HEIGHT, WIDTH), dtype=torch.int64)).image
    return light_on_camera(scene, stages, image)[0]


def test_a_leak_adds_to_the_field_of_a_flat_panel() -> None:
    leak = present("zero_order", leak_real=0.2, leak_imaginary=-0.15, fill_factor=0.96)
    ratio = flat_light(leak) / flat_light()
    torch.testing.assert_close(ratio, torch.full_like(ratio, abs(1.2 - 0.15j) ** 2))


def test_a_smaller_pixel_lets_more_of_the_band_pass() -> None:
    path = {
        f: light_path(scene_of(), stages_for(scene_of(), (present("zero_order", fill_factor=f),)))
        for f in (0.5, 1)
    }
    assert float(path[0.5].aperture[0]) == pytest.approx(math.sqrt(0.5))
    assert float(path[1].aperture[1]) == pytest.approx(1)


@pytest.mark.parametrize("offset", [0.7, -1.1])
def test_a_distance_offset_is_another_plane(offset: float) -> None:
    a, b = seen(present("distance", offset=offset)), seen(plane=PLANE + offset)
    assert float(((a - b) ** 2).mean() / b.var()) < 3e-3  # the grids' rooms, and so their borders, differ


def test_a_ghost_is_the_picture_displaced() -> None:
    ghost = present("ghost", amplitude=0.1, shift_y=3.0, shift_x=-5.0)
    base = seen()
    copied = 0.1 * base.roll((3, -5), (-2, -1))
    inside = (slice(None), slice(8, -8), slice(8, -8))
    torch.testing.assert_close(seen(ghost)[inside], (base + copied)[inside], rtol=1e-9, atol=1e-9)


def second_moments(transfer: Tensor, scene: Scene) -> tuple[float, float]:
    """rms width of the kernel of an irradiance filter along rows and columns, panel pixels."""
    height, width = scene.grid.image_shape
    full = transfer + torch.zeros((height, width // 2 + 1), dtype=torch.float64)
    kernel = irfft2(full.to(torch.complex128), (height, width))
    y, x = (torch.as_tensor(np.fft.fftfreq(n) * n / FINE) for n in (height, width))
    assert float(kernel.sum()) == pytest.approx(1)
    return float((kernel.sum(1) * y**2).sum()) ** 0.5, float((kernel.sum(0) * x**2).sum()) ** 0.5


@pytest.mark.parametrize("kurtosis", [0.6, 0.0, -0.8, -1.3])
def test_a_blur_has_the_width_that_it_says(kurtosis: float) -> None:
    widths = {"width_y": 1.6, "width_x": 2.3}
    scene = scene_of()
    stages = stages_for(scene, (present("sensor_blur", kurtosis=kurtosis, **widths),))
    assert stages.sensor.blur is not None
    measured = second_moments(stages.sensor.blur, scene)
    assert measured == pytest.approx((1.6, 2.3), rel=1e-2)


@pytest.mark.parametrize(
    ("kurtosis", "expected"),
    [(-1.0, lambda x: j0(2 * x) + jv(2, 2 * x)), (-1.5, lambda x: j0(np.sqrt(2) * x))],
)
def test_a_blur_can_be_a_disc_or_a_ring(
    kurtosis: float, expected: Callable[[np.ndarray], np.ndarray]
) -> None:
    """The camera out of focus, or a source that is evenly bright. The transforms are 2 J1(r) / r and J0(r).

    r is the angular frequency times the radius: twice the rms width along an axis for a disc, sqrt(2) times for a ring.
    """
    width = 1.4
    scene = scene_of()
    stages = stages_for(scene, (present("sensor_blur", kurtosis=kurtosis, width_y=width, width_x=width),))
    height, columns = scene.grid.image_shape
    iy, ix = np.fft.fftfreq(height) * FINE, np.fft.rfftfreq(columns) * FINE
    assert stages.sensor.blur is not None
    frequency = 2 * np.pi * width * np.hypot(iy[:, None], ix)
    np.testing.assert_allclose(stages.sensor.blur.numpy(), expected(frequency), atol=2e-4)


def test_a_source_displaces_the_picture_by_distance_times_angle() -> None:
    angles = {"extent_y": 3.0, "extent_x": 2.0}
    scene = scene_of()
    stages = stages_for(scene, (present("spatial_coherence", **angles),))
    transfer = light_path(scene, stages).irradiance_filter
    to_pixels = 1e-3 * PLANE * 1e-3 / 8e-6  # of one mrad
    expected = (3.0 * to_pixels, 2.0 * to_pixels)
    assert second_moments(transfer, scene) == pytest.approx(expected, rel=1e-3)


def test_the_iris_passes_what_its_half_width_and_place_say() -> None:
    iris = present("iris", half_width=0.5, centre_y=0.1, centre_x=-0.2)
    scene = scene_of(iris)
    path = light_path(scene, stages_for(scene, (iris,)))
    opened = path.transfers[0].abs()
    v, u = (np.arange(-b, b + 1) * 2 / n for b, n in zip(scene.grid.band, scene.grid.padded, strict=True))
    for coordinate, centre, light in ((v, 0.1, opened.amax(1)), (u, -0.2, opened.amax(0))):
        bin_width = coordinate[1] - coordinate[0]
        outside = np.abs(coordinate - centre) - 0.5
        assert (light.numpy()[outside <= -1e-9] > 0.999).all()
        assert (light.numpy()[outside > bin_width * 1.001] == 0).all()


def _zernike_polynomials(y: torch.Tensor, without_defocus: bool) -> torch.Tensor:
    """Polynomials up to n = 6 over a square grid, [count, n, n]."""
    each = torch.eye(zernike_count(6, without_defocus), dtype=y.dtype)
    return torch.stack([zernike_surface(one, y[:, None], y[None, :], 6, without_defocus) for one in each])


def test_aberrations_are_orthonormal_on_the_disc() -> None:
    y = torch.linspace(-1, 1, 401, dtype=torch.float64)
    maps = _zernike_polynomials(y, without_defocus=False)
    inside = (y[:, None] ** 2 + y[None, :] ** 2) <= 1
    on_disc = maps[:, inside]
    products = on_disc @ on_disc.T / on_disc.shape[1]
    assert float((products - torch.eye(len(maps))).abs().max()) < 0.03  # the disc's edge on a grid
    assert float(on_disc.mean(1).abs().max()) < 0.01  # no piston
    without = _zernike_polynomials(y, without_defocus=True)
    r2 = (y[:, None] ** 2 + y[None, :] ** 2)[inside]
    for one in without[:, inside]:
        for held in (
            r2 - r2.mean(),
            y[:, None].expand(401, 401)[inside],
            y[None, :].expand(401, 401)[inside],
        ):
            assert abs(float((one * held).mean())) < 0.01


def test_maps_of_legendre_terms_are_orthogonal() -> None:
    y, x = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) / (n / 2) for n in (300, 400))
    maps = legendre_maps(y[:, None], x[None, :], 4, lowest=0).reshape(15, -1)
    products = maps @ maps.T / maps.shape[1]
    sizes = products.diagonal().sqrt()
    off = products / (sizes[:, None] * sizes[None, :]) - torch.eye(15)
    assert float(off.abs().max()) < 1e-3


def test_an_aberration_is_a_path_difference_and_so_a_smaller_phase_in_red() -> None:
    one = present("pupil_aberration", colours=True, zernike=0.05)
    angle = {}
    for channel in ("red", "green"):
        scene = scene_of(one, channel=channel, colours=True)
        delay = stages_for(scene, (one,)).pupil.path_difference
        assert delay is not None
        angle[channel] = float(delay.abs().max()) / scene.wavelength
    # the same pupil is spanned by other frequencies in each grid, so the largest delays differ a little
    assert angle["red"] / angle["green"] == pytest.approx(520 / 638, rel=0.05)


def test_a_wavefront_is_a_path_difference_too() -> None:
    one = present("panel_wavefront", colours=True, wavefront=0.2)
    phase = {}
    for channel in ("red", "green"):
        scene = scene_of(one, channel=channel, colours=True)
        phase[channel] = stages_for(scene, (one,)).panel.source.angle()
    torch.testing.assert_close(phase["green"], phase["red"] * 638 / 520)


def test_a_response_keeps_its_sign_and_its_ends() -> None:
    turned = replace(bench(), panel=replace(bench().panel, phase_sign=-1))
    response = present("phase_response", gain=0.9, curvature=0.2)
    scene = scene_for(Model(turned, (response,)), "green", PLANE, torch.float64)
    drive = stages_for(scene, (response,)).drive
    assert float(drive.response[0]) == 0
    assert float(drive.response[-1]) == pytest.approx(-2 * math.pi * 0.9 * 255 / 256, rel=0.02)


def test_a_shift_of_whole_pixels_is_a_shift() -> None:
    shifted = seen(present("misregistration", shift_y=2.0, shift_x=-3.0))
    expected = seen().roll((-2, 3), (-2, -1))
    inside = (slice(None), slice(6, -6), slice(6, -6))
    assert float((shifted - expected)[inside].abs().max()) < 1e-6 * float(expected.max())


def test_a_rotation_and_a_size_move_the_corners_as_they_say() -> None:
    one = present("misregistration", rotation=10.0, magnification=2.0)
    moves = stages_for(scene_of(), (one,)).sensor.displacement
    assert moves is not None
    y, x = -(HEIGHT - 1) / 2, -(WIDTH - 1) / 2
    assert float(moves[0][0, 0]) == pytest.approx(0.02 * y + 0.01 * x)
    assert float(moves[1][0, 0]) == pytest.approx(0.02 * x - 0.01 * y)


def test_what_the_camera_does_to_counts() -> None:
    base = seen()
    added = seen(present("stray_light", counts=np.array([7.0, 0, 0])))
    torch.testing.assert_close(added, base + 7)
    vignette = seen(present("vignetting", log_gain=0.2))
    y, x = stages_for(scene_of(), ()).sensor.y, stages_for(scene_of(), ()).sensor.x
    torch.testing.assert_close(vignette, base * torch.exp(0.2 * legendre_maps(y, x, 2).sum(0)))
    bent = seen(present("sensor_response", bend=-0.3))
    assert bool((bent <= base + 1e-9).all())
    middle = (base > 200) & (base < 2000)
    assert bool((bent[middle] < base[middle]).all())


def test_illumination_lights_the_panel_and_its_leak() -> None:
    leak, beam = (
        present("zero_order", leak_real=0.1, fill_factor=0.96),
        present("illumination", log_amplitude=0.2),
    )
    panel = stages_for(scene_of(), (leak, beam)).panel
    expected = torch.exp(0.2 * legendre_maps(panel.y, panel.x, 2).sum(0))
    torch.testing.assert_close(panel.source.abs(), expected)
    assert panel.leak is not None
    torch.testing.assert_close(panel.leak.real, 0.1 * expected)
