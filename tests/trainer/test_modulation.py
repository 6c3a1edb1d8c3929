"""Light of a panel that does more than delay it, where a map scales the delay."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import bundle_paths, load_light_path
from runtime.lightpath.light_path import LightPath, image_field, irradiance, panel_spectrum
from tests.trainer.hidden import bench_file, ran, with_few_effects, without_probes
from tests.trainer.test_effects import bench, gray, present, scene_of
from trainer.model.bundle_export import export_bundle
from trainer.model.model import EffectInstance, Model
from trainer.model.model_stages import stages_for
from trainer.prediction.predict import driven_phase, light_path, trace

MAP = present("phase_nonuniformity", map=0.1)
UNEVEN = ("phase_nonuniformity", "polarisation_leak")
LEAK, GAIN = 0.2 + 0.1j, 0.4
SWING, SHARES = torch.tensor([-1.304, 0.0, 1.304]), (0.294, 0.412, 0.294)


def path_of(*effects: EffectInstance) -> tuple[LightPath, Tensor]:
    """The light path of effects, and the phase (rad) that they drive the panel to."""
    scene = scene_of(*effects)
    stages = stages_for(scene, effects)
    path = light_path(scene, stages)
    return path, driven_phase(path, stages, gray(), None)


def seen(*effects: EffectInstance) -> Tensor:
    scene = scene_of(*effects)
    return trace(scene, stages_for(scene, effects), gray()).image


def off(found: Tensor, expected: Tensor) -> float:
    return float(((found - expected) ** 2).mean() / expected.var())


@pytest.mark.parametrize("crossed", [0.0, 0.3])
def test_a_second_polarisation_is_delayed_where_the_panel_delays(crossed: float) -> None:
    """Its phase is a share of the light's own there, not of what the gray level would have elsewhere."""
    path, phase = path_of(MAP)
    first, second = panel_spectrum(path, phase), panel_spectrum(path, GAIN * phase)
    lights = [abs(image_field(path, spectrum, 0)) ** 2 for spectrum in (first + LEAK * second, second)]
    leak = present("polarisation_leak", real=LEAK.real, imaginary=LEAK.imag, gain=GAIN, crossed=crossed)
    assert off(seen(MAP, leak), lights[0] + crossed**2 * lights[1]) < 1e-6
    assert off(seen(leak), lights[0] + crossed**2 * lights[1]) > 1e-3  # the map shows


def test_a_ripple_swings_the_light_s_own_phase() -> None:
    path, phase = path_of(MAP)
    swings = [0.1 * float(s) for s in SWING]
    expected = sum(w * irradiance(path, (1 + s) * phase) for s, w in zip(swings, SHARES, strict=True))
    assert off(seen(MAP, present("phase_ripple", rms=0.1)), expected) < 1e-6


def test_a_bundle_says_that_components_follow_the_panel_s_phase(tmp_path: Path) -> None:
    leak = present("polarisation_leak", real=0.2, gain=GAIN)
    for effects, follows in (
        ((MAP, leak), True),
        ((MAP, present("amplitude_modulation", amplitude=0.2)), False),
    ):
        folder = tmp_path / str(follows)
        export_bundle(Model(bench(), effects, {"green": 1.0}), None, folder)
        bundle = read_bundle(folder)
        assert load_light_path(bundle).modulation_by_phase is follows
    bundle_paths(bundle)[0]["modulation_by_phase"] = "yes"
    with pytest.raises(InputError, match="modulation_by_phase of light path green.*true or false"):
        load_light_path(bundle)


def test_a_leak_behind_an_uneven_panel_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the leak's phase that of the gray level, 0.0026 is left of a larger bench, outside the catalogue."""
    with_few_effects(
        monkeypatch, *UNEVEN, "zero_order", "amplitude_modulation", "phase_response", "illumination"
    )
    without_probes(monkeypatch)
    bench = bench_file(
        tmp_path,
        'kind = "polarisation_leak"\namplitude = 0.2',
        'kind = "phase_nonuniformity"\nwedge = 0.06\ndome = 0.14',
    )
    captures = tmp_path / "captures"
    ran(capsys, "capture", "--bench", bench, "--out", captures, "--patterns", 8)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    added = [s["added"] for s in found["steps"] if s["added"]]
    removed = [s["removed"] for s in found["steps"] if s.get("removed")]
    assert sorted(set(added) - set(removed)) == list(UNEVEN)
    assert found["steps"][-1]["excess"] < 2e-4
