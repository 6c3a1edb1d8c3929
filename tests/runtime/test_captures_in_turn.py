"""`refine` and `calibrate` with fields in turn: each colour in its own field, and the results of one colour."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.virtual import BenchDescription, VirtualHeadset
from firmware_iface.virtual.bench_description import ChannelDescription
from firmware_iface.virtual.defects import make_defect
from runtime.bundle.bundle_folder import write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.calibration.colour_captures import ColourCaptures, ColourPatterns, colour_captures
from runtime.calibration.drift import Drift
from runtime.calibration.shown_patterns import grains, grating
from runtime.calibration.taking import Taker
from runtime.cli import main
from runtime.headset import colour_fields
from runtime.headset.open_devices import Devices
from runtime.lightpath import ideal_path as ideal
from runtime.refinement.panel_and_camera import PanelAndCamera
from runtime.service.shared_memory import crc32
from runtime.solver import quality
from tests.campaigns.headset import COLOURS
from tests.runtime.benches import converted, scene
from tests.runtime.calibration.drifting import devices

SHAPE, DISTANCE_MM = (48, 64), 8.0


class Headset:
    """A virtual headset of three colours with a defect, opened with fields in turn or without.

    It keeps what was lit in each picture of the camera: the patterns, by the lasers that shone on them.
    """

    def __init__(self, defect: str, fields: int, seed: int = 2) -> None:
        channels = tuple(ChannelDescription(name, nm) for name, nm in COLOURS.items())
        bench = BenchDescription(defects=(make_defect(defect),), channels=channels)
        self.bench, self.fields = VirtualHeadset(bench.resized(*SHAPE, DISTANCE_MM), seed), fields
        self.seen: set[tuple[int, int]] = set()
        self.frames: set[tuple[int, ...]] = set()
        self._capture = self.bench.camera.capture
        self.bench.camera.capture = self.capture  # type: ignore[method-assign]

    def capture(self) -> np.ndarray:
        on = sum(1 << k for k, name in enumerate(COLOURS) if self.bench.lasers.power(name) > 0)
        for field in self.bench.panel.fields:
            if field.lasers & on:
                self.seen.add((crc32(field.gray), field.lasers & on))
        self.frames.add(tuple(field.lasers for field in self.bench.panel.fields))
        return self._capture()

    @contextmanager
    def opened(self, spec: str, colours: Sequence[str], seed: int = 0) -> Iterator[Devices]:
        plain = devices(self.bench)
        yield plain if self.fields == 1 else colour_fields.gated(plain, colours, self.fields)

    @property
    def dark(self) -> bool:
        return all(self.bench.lasers.power(name) == 0 for name in COLOURS)


def bundle_of_three(folder: Path, networks: dict[str, bytes]) -> Path:
    """A bundle that knows no defect."""
    paths = [
        (n, DISTANCE_MM, nm, converted(ideal.ideal_path(SHAPE, 8e-6, nm * 1e-9, DISTANCE_MM * 1e-3, 1.0), np.float32))
        for n, nm in COLOURS.items()
    ]  # fmt: skip
    records, arrays = pack_light_paths(paths)
    write_bundle(
        folder / "bundle", arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {}, networks=networks
    )
    return folder / "bundle"


def ran(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], headset: Headset, *words: object
) -> dict:
    with monkeypatch.context() as patched:
        patched.setattr(colour_fields, "open_colours", headset.opened)
        code = main([str(word) for word in (*words, "--headset", "virtual:colour", "--json")])
    out, err = capsys.readouterr()
    assert code == 0, err
    assert headset.dark
    return json.loads(out)


ALONE = {(1, 0, 0), (0, 2, 0), (0, 0, 4)}  # frames in which one colour has light, in its own field


def test_a_refinement_in_turn_is_what_it_is_in_one_colour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")
    from trainer.networks.approximator import Approximator, Architecture
    from trainer.networks.onnx_files import onnx_files

    torch.manual_seed(0)
    bundle = bundle_of_three(tmp_path, onnx_files(Approximator(Architecture("compact", 8, SHAPE, 3))))
    target = np.stack([scene(SHAPE), scene(SHAPE)[:, ::-1], scene(SHAPE)[::-1]])
    np.save(tmp_path / "picture.npy", target)
    own: set[tuple[int, int]] = set()
    whole = PanelAndCamera.__call__

    def note(display: PanelAndCamera, gray: np.ndarray) -> np.ndarray:
        own.update((crc32(field), 1 << k) for k, field in enumerate(gray))
        return whole(display, gray)

    monkeypatch.setattr(PanelAndCamera, "__call__", note)
    found, headsets = {}, {}
    for fields in (3, 1):
        headsets[fields] = Headset("phase_response", fields)
        out = tmp_path / f"{fields}.png"
        words = ["refine", bundle, tmp_path / "picture.npy", "--captures", 6, "--out", out]
        found[fields] = ran(monkeypatch, capsys, headsets[fields], *words)
    assert {mask for _, mask in headsets[3].seen} == {1, 2, 4}
    assert headsets[3].seen <= own, "a colour had light on a pattern that was not its own"
    assert (
        headsets[3].frames - {(-1,)} == ALONE
    )  # before the first frame the panel has none, and no laser is on
    in_turn, one = found[3]["psnr_db"], found[1]["psnr_db"]
    assert in_turn["best"] > in_turn["first"] + 2
    assert in_turn["first"] == pytest.approx(
        one["first"], abs=0.1
    )  # the same patterns: only the noise differs
    assert in_turn["best"] == pytest.approx(one["best"], abs=0.5)
    for colour, wanted in zip(COLOURS, target, strict=True):
        seen = {}
        for fields, result in found.items():
            with Image.open(result["patterns"][colour]) as image:
                light = headsets[1].bench.true_irradiance(np.asarray(image), colour)
            seen[fields] = quality(light, wanted).psnr_db
        assert seen[3] == pytest.approx(seen[1], abs=1.0), colour


def calibration_captures(fields: int, seed: int) -> tuple[Headset, dict[str, ColourCaptures]]:
    """What a calibration would capture, of few patterns."""
    headset = Headset("phase_response", fields, seed)
    patterns = ColourPatterns(
        grains(SHAPE, 4, 1), [grating(SHAPE, 8, 100)], [grains(SHAPE, 4, 2)], [grains(SHAPE, 8, 3)]
    )
    with headset.opened("", tuple(COLOURS)) as lit:
        taker = Taker(lit, lambda what: None)
        black, floor = taker.darkness()
        return headset, {c: colour_captures(taker, c, patterns, black, floor) for c in COLOURS}


def difference(some: ColourCaptures, others: ColourCaptures) -> float:
    """Mean squared difference of captures of the same patterns, over what their noise makes it."""
    ratio, found = some.exposure_ms / others.exposure_ms, []
    shots = ([c.dots, *c.sweep, *c.fitted, *c.heldout] for c in (some, others))
    for a, b in zip(*shots, strict=True):
        use = (a.weight > 0) & (b.weight > 0)
        variance = 1 / a.weight[use] + ratio**2 / b.weight[use]
        found.append(np.mean((a.signal[use] - ratio * b.signal[use]) ** 2 / variance))
    return float(np.mean(found))


def test_a_calibrations_captures_in_turn_are_those_of_one_colour_to_the_noise() -> None:
    """They differ from those of one colour as those of one colour differ from one another."""
    (headset, in_turn), (_, one), (_, again) = (
        calibration_captures(*which) for which in ((3, 1), (1, 2), (1, 3))
    )
    assert headset.frames - {(-1,)} == ALONE and {mask for _, mask in headset.seen} == {1, 2, 4}
    for colour in COLOURS:
        assert in_turn[colour].exposure_ms == pytest.approx(one[colour].exposure_ms, rel=0.05)
        assert in_turn[colour].noise.slope == pytest.approx(one[colour].noise.slope, rel=0.1)
        noise = difference(again[colour], one[colour])
        assert noise == pytest.approx(1, abs=0.3)
        assert difference(in_turn[colour], one[colour]) == pytest.approx(noise, rel=0.06)


@pytest.mark.slow
def test_a_calibration_in_turn_is_what_it_is_in_one_colour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = bundle_of_three(tmp_path, {})
    found = {}
    for fields in (3, 1):
        headset = Headset("panel_wavefront", fields)
        found[fields] = ran(monkeypatch, capsys, headset, "calibrate", bundle, "--check")
        if fields == 3:
            assert headset.frames - {(-1,)} == ALONE and {mask for _, mask in headset.seen} == {1, 2, 4}
    in_turn, one = found[3], found[1]
    assert in_turn["verdict"] == one["verdict"] == "recalibrated"
    assert in_turn["heldout"]["after"]["excess"] < 0.01 * in_turn["heldout"]["before"]["excess"]
    waves = [Drift(np.array(f["wavefront"]["terms_nm"])).wavefront(SHAPE) for f in (in_turn, one)]
    noise_nm = np.hypot(*(f["wavefront"]["error_rms_nm"] for f in (in_turn, one)))
    assert waves[1].std() > 20
    assert (waves[0] - waves[1]).std() < max(4 * noise_nm, 0.02 * waves[1].std())
    for colour in COLOURS:
        shown = [f["channels"][colour]["picture_psnr_db"] for f in (in_turn, one)]
        assert shown[0]["after"] == pytest.approx(shown[1]["after"], abs=0.5)
        assert shown[0]["after"] > shown[0]["before"] + 1
