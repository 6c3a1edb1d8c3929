"""Bundles: what goes in, what stays out, and that the headset computes what the trainer does."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import ADAPTERS, APPROXIMATOR, GRADIENT, Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import bundle_channels, load_light_path, plane_of, slow_response_share
from runtime.lightpath.light_path import irradiance, panel_phase
from tests.trainer.made_sets import write_captures
from tests.trainer.test_effects import HEIGHT, PLANE, WIDTH, bench, gray, present
from tests.trainer.test_networks import disturbed
from trainer.captures.bench_file import bench_tables, read_bench
from trainer.captures.capture_set import read_captures
from trainer.effects import catalogue
from trainer.model.bundle_export import export_bundle
from trainer.model.model import EffectInstance, Model, absent
from trainer.model.model_stages import scene_for, stages_for
from trainer.networks.approximator import write_approximator
from trainer.prediction.predict import light_path

CAMERA = (
    "sensor_blur",
    "misregistration",
    "vignetting",
    "stray_light",
    "sensor_response",
    "laser_drift",
    "vibration",
    "frame_motion",
    "fixed_pattern",
)


def every_effect(colours: bool = False) -> tuple[EffectInstance, ...]:
    """Each built-in effect a little away from absent."""
    effects = []
    for one in catalogue().values():
        start = absent(one, bench(colours))
        values = {}
        for p in one.parameters:
            value = start.values[p.name]
            values[p.name] = np.where(value + p.scale <= p.high, value + p.scale, value - p.scale)
        effects.append(start.with_values(values))
    return tuple(effects)


def trained_irradiance(model: Model, channel: str, plane: float) -> np.ndarray:
    """What the trainer computes for the patterns, with the model's effects that act on the display."""
    exported = replace(model, present=tuple(p for p in model.present if p.effect.acts_on == "display"))
    scene = scene_for(exported, channel, plane)
    with torch.no_grad():
        path = light_path(scene, stages_for(scene, exported.present))
        return irradiance(path, panel_phase(path, gray())).numpy()


def headset_irradiance(bundle: Bundle, channel: str, plane: float) -> np.ndarray:
    path = load_light_path(bundle, channel, plane)
    return irradiance(path, panel_phase(path, gray().numpy()))


@pytest.mark.parametrize("half_width", [1.0, 1.5])
def test_the_headset_computes_what_the_trainer_does(half_width: float, tmp_path: Path) -> None:
    """With every effect of the catalogue present: irradiance to single precision, for each colour."""
    ours = bench(True)
    model = Model(replace(ours, iris=replace(ours.iris, half_width=half_width)), every_effect(True))
    export_bundle(model, None, tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    assert bundle_channels(bundle) == ["red", "green"]
    for channel in ("red", "green"):
        ours, theirs = headset_irradiance(bundle, channel, PLANE), trained_irradiance(model, channel, PLANE)
        assert ours.dtype == np.float32
        assert np.abs(ours - theirs).max() < 2e-5 * theirs.max()


def test_neighbours_that_no_camera_would_see_are_left_out(tmp_path: Path) -> None:
    """A field that hardly reaches beyond its pixel costs the headset fewer sums, and the picture is the same."""
    taps = {}
    for width in (0.1, 0.6):
        model = Model(bench(), (present("crosstalk", width_y=width, width_x=width),))
        export_bundle(model, None, tmp_path / f"{width}")
        bundle = read_bundle(tmp_path / f"{width}")
        rows, _ = load_light_path(bundle, "green", PLANE).crosstalk
        taps[width] = rows.shape[1]
        np.testing.assert_allclose(rows.sum(axis=1), 1, atol=1e-6)
        ours, theirs = headset_irradiance(bundle, "green", PLANE), trained_irradiance(model, "green", PLANE)
        assert np.abs(ours - theirs).max() < 1e-4 * theirs.max()
    assert taps[0.1] < taps[0.6]


def test_camera_effects_stay_out(tmp_path: Path) -> None:
    full = Model(bench(), every_effect())
    summary = export_bundle(full, None, tmp_path / "full")
    exported = tuple(p for p in full.present if p.effect.name not in CAMERA)
    export_bundle(replace(full, present=exported), None, tmp_path / "display")
    assert summary["effects_left_out"] == list(CAMERA)
    assert summary["effects"] == [p.effect.name for p in exported]
    names = ("full", "display")
    arrays = [read_bundle(tmp_path / n).arrays for n in names]
    assert arrays[0].keys() == arrays[1].keys()
    for name, array in arrays[0].items():
        np.testing.assert_array_equal(array, arrays[1][name])
    provenance = read_bundle(tmp_path / "full").provenance
    assert [e["effect"] for e in provenance["effects_left_out"]] == list(CAMERA)
    assert {e["acts_on"] for e in provenance["effects_left_out"]} == {"camera"}
    assert "ghost" in [e["effect"] for e in provenance["effects"]]


def test_ghosts_and_the_sources_extent_go_in_as_one_filter(tmp_path: Path) -> None:
    def stored(*effects: EffectInstance) -> np.ndarray | None:
        folder = tmp_path / ("-".join(e.effect.name for e in effects) or "none")
        export_bundle(Model(bench(), effects), None, folder)
        return load_light_path(read_bundle(folder)).irradiance_filter

    ghost = present("ghost", amplitude=0.1, shift_x=4.0)
    start = absent(catalogue()["spatial_coherence"], bench())
    source = start.with_values(
        {k: np.full_like(v, 0.5) if k.startswith("extent") else v for k, v in start.values.items()}
    )
    a, b, both = stored(ghost), stored(source), stored(ghost, source)
    assert stored() is None
    assert a is not None and b is not None and both is not None
    np.testing.assert_allclose(both, a * b, atol=1e-6)


def test_planes_come_from_the_captures_and_share_their_arrays(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    patterns = rng.integers(0, 256, (4, HEIGHT, WIDTH), dtype=np.uint8)
    images = rng.integers(64, 4000, (4, HEIGHT, WIDTH), dtype=np.uint16)
    planes = (4.0, 6.0, 4.0, 8.0)
    make_captures(tmp_path / "captures", patterns, images, planes)
    captures = read_captures(tmp_path / "captures")
    errors = {"nrmse": 0.05, "noise_nrmse": 0.04, "excess": 0.001}
    model = Model(
        bench(),
        (present("illumination", log_amplitude=0.1), present("zero_order", leak_real=0.1, fill_factor=0.9)),
        history=({"added": "", "nrmse": 0.5}, {"added": "zero_order", **errors}),
    )
    summary = export_bundle(model, captures, tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    assert summary["planes_mm"] == bundle.description["planes_mm"] == [4.0, 6.0, 8.0]
    assert summary["heldout"] == bundle.provenance["heldout"] == errors
    assert bundle.provenance["captures_sha256"] == captures.content_hash()
    kinds = [name.split(".")[0] for name in bundle.arrays]
    assert kinds.count("source") == kinds.count("leak") == kinds.count("response") == 1
    assert kinds.count("transfers") == 3
    for plane in (4.0, 6.0, 8.0):
        ours, theirs = headset_irradiance(bundle, "green", plane), trained_irradiance(model, "green", plane)
        assert np.abs(ours - theirs).max() < 2e-5 * theirs.max()
    assert plane_of(bundle) == PLANE  # the bench's own distance
    with pytest.raises(InputError, match=r"no plane at 5 mm for green: use one of 4, 6, 8"):
        load_light_path(bundle, "green", 5.0)


def make_captures(folder: Path, patterns: np.ndarray, images: np.ndarray, planes: tuple[float, ...]) -> None:
    rows = [
        {"gray": p, "counts": i, "channel": "green", "plane_mm": z, "exposure_ms": 10.0}
        for p, i, z in zip(patterns, images, planes, strict=True)
    ]
    write_captures(folder, bench(), rows)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("bundle") / "b"
    export_bundle(Model(bench(True), every_effect(True)), None, made)
    return made


def test_a_folder_that_is_taken_is_refused_unless_asked(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "b"
    shutil.copytree(folder, copy)
    with pytest.raises(InputError, match="is not empty"):
        export_bundle(Model(bench()), None, copy)
    export_bundle(Model(bench()), None, copy, replace_folder=True)
    assert bundle_channels(read_bundle(copy)) == ["green"]


def test_the_description_says_what_the_panel_is(folder: Path) -> None:
    description = json.loads((folder / "bundle.json").read_text())["description"]
    assert description["panel"] == {
        "height": HEIGHT, "width": WIDTH, "pitch_um": 8.0, "levels": 256, "phase_sign": 1, "slow_response_share": 0.02,
    }  # fmt: skip
    assert [c["name"] for c in description["channels"]] == ["red", "green"]
    assert {a.dtype for a in read_bundle(folder).arrays.values()} <= {np.dtype("f4"), np.dtype("c8")}


def test_a_panel_of_few_gray_levels_is_one_for_the_trainer_and_for_the_headset(tmp_path: Path) -> None:
    """bench.toml says which it has; a model file and a bundle keep it; prediction and headset round alike."""
    few = read_bench(
        {**bench_tables(bench()), "panel": {**bench_tables(bench())["panel"], "gray_levels": [0, 40, 128]}}
    )
    assert few.panel.gray_levels == (0, 40, 128) and read_bench(bench_tables(few)) == few
    assert "gray_levels" not in bench_tables(bench())["panel"]
    model = Model(few, every_effect())
    export_bundle(model, None, tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    assert bundle.description["panel"]["gray_levels"] == [0, 40, 128]
    ours, theirs = headset_irradiance(bundle, "green", PLANE), trained_irradiance(model, "green", PLANE)
    assert np.abs(ours - theirs).max() < 2e-5 * theirs.max()
    assert len(np.unique(load_light_path(bundle).response)) == 3
    smooth = trained_irradiance(Model(bench(), every_effect()), "green", PLANE)
    assert np.abs(smooth - theirs).max() > 0.1 * theirs.max()
    with pytest.raises(InputError, match=r"panel\.gray_levels in bench\.toml"):
        read_bench({**bench_tables(few), "panel": {**bench_tables(few)["panel"], "gray_levels": [40, 0]}})


def test_channels_must_be_named_where_there_are_several(folder: Path) -> None:
    bundle = read_bundle(folder)
    with pytest.raises(InputError, match="several channels: choose one of red, green"):
        load_light_path(bundle)
    with pytest.raises(InputError, match="no channel 'gren': did you mean 'green'"):
        load_light_path(bundle, "gren")


def test_a_bundle_that_does_not_fit_together_is_refused_with_a_reason(folder: Path, tmp_path: Path) -> None:
    good = read_bundle(folder)
    record = good.description["paths"][0]
    names = record["arrays"]
    number = iter(range(1000))

    def refusal(other: dict[str, np.ndarray] | None = None, **changes: Any) -> str:
        broken = {**good.description, "paths": [{**record, **changes}]}
        target = tmp_path / str(next(number))
        write_bundle(target, {**good.arrays, **(other or {})}, broken, {})
        with pytest.raises(InputError) as caught:
            load_light_path(read_bundle(target), record["channel"])
        return str(caught.value)

    def grid(**changes: Any) -> dict[str, Any]:
        return {"grid": {**record["grid"], **changes}}

    for bad in (
        grid(shape=[0, WIDTH]), grid(shape=[HEIGHT]), grid(padded=[10, 10]), grid(band=[10**6, 3]),
        grid(margin=-1), grid(pitch_m=0), grid(pitch_m="8 um"), grid(padded=[1e9, 1e9]), {"grid": None},
        grid(padded=[1 << 20, 1 << 20]), grid(samples_a_pixel=3), grid(samples_a_pixel="4"),
    ):  # fmt: skip
        assert "the grid of light path red, 6 mm cannot be computed" in refusal(**bad)
    assert "transfers of light path red, 6 mm has the shape" in refusal(**grid(band=[4, 4]))
    assert "lists no arrays" in refusal(arrays=3)
    fewer = {k: v for k, v in names.items() if k != "source"}
    assert "has no source" in refusal(arrays=fewer)
    assert "has crosstalk along one axis only" in refusal(
        arrays={k: v for k, v in names.items() if k != "crosstalk_rows"}
    )
    assert "has an array 'magic' that this release does not know" in refusal(arrays={**names, "magic": "x"})
    assert "has no array 'nowhere'" in refusal(arrays={**names, "leak": "nowhere"})
    assert "is complex64, and response of light path red, 6 mm must be float32" in refusal(
        arrays={**names, "response": names["source"]}
    )
    small = {names["gain"]: np.ones((3, 3), np.float32)}
    assert "gain of light path red, 6 mm has the shape (3, 3), expected" in refusal(small)
    even = {names["crosstalk_rows"]: np.ones((3, 4), np.float32)}
    assert "odd number of taps" in refusal(even)


@pytest.mark.parametrize("paths", [None, [], {}, [3], [{"channel": "red"}], [{"plane_mm": 3.0}]])
def test_a_bundle_without_light_paths_is_refused(folder: Path, tmp_path: Path, paths: Any) -> None:
    good = read_bundle(folder)
    write_bundle(tmp_path / "b", good.arrays, {**good.description, "paths": paths}, {})
    with pytest.raises(InputError, match="light path"):
        load_light_path(read_bundle(tmp_path / "b"), "red")


def test_a_trained_network_goes_in_as_onnx(tmp_path: Path) -> None:
    """What onnxruntime gives from the bundle is what the trainer's network gives; its origin is kept."""
    import onnxruntime

    network = disturbed("compact", (HEIGHT, WIDTH), 2, 1)
    write_approximator(tmp_path / "network.safetensors", network, {"steps": 3, "channels": ["green"]})
    export_bundle(Model(bench()), None, tmp_path / "b", network=tmp_path / "network.safetensors")
    bundle = read_bundle(tmp_path / "b")
    assert set(bundle.networks) == {APPROXIMATOR, GRADIENT, ADAPTERS}
    assert bundle.provenance["network"]["steps"] == 3
    given = torch.rand(1, 1, HEIGHT, WIDTH)
    (found,) = onnxruntime.InferenceSession(bundle.networks[APPROXIMATOR]).run(
        None, {"irradiance": given.numpy()}
    )
    assert np.abs(found - network(given).detach().numpy()).max() < 1e-6
    (tmp_path / "b" / GRADIENT).write_bytes(b"another")
    with pytest.raises(InputError, match="SHA-256"):
        read_bundle(tmp_path / "b")


@pytest.mark.parametrize(
    ("shape", "channels", "effects"),
    [((8, 8), ["green"], []), ((HEIGHT, WIDTH), ["red"], []), ((HEIGHT, WIDTH), ["green"], ["ghost"])],
)
def test_a_network_of_another_bench_is_refused(
    tmp_path: Path, shape: tuple[int, int], channels: list[str], effects: list[str]
) -> None:
    about = {"channels": channels, "effects": effects}
    write_approximator(tmp_path / "n.safetensors", disturbed("compact", shape, 2, 1), about)
    with pytest.raises(InputError, match="trained"):
        export_bundle(Model(bench()), None, tmp_path / "b", network=tmp_path / "n.safetensors")
    assert not (tmp_path / "b").exists()


def test_what_a_slow_panel_keeps_goes_into_the_bundle(tmp_path: Path) -> None:
    export_bundle(Model(bench(), (present("slow_response", share=0.12),)), None, tmp_path / "slow")
    export_bundle(Model(bench()), None, tmp_path / "plain")
    slow, plain = (read_bundle(tmp_path / name) for name in ("slow", "plain"))
    assert slow_response_share(slow) == pytest.approx(0.12, abs=1e-12) and slow_response_share(plain) == 0
    assert "slow_response_share" not in plain.description["panel"]
    assert slow.arrays.keys() == plain.arrays.keys()
    for name, array in plain.arrays.items():  # the light path is for patterns that stay
        np.testing.assert_array_equal(array, slow.arrays[name])
