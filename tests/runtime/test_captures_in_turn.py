"""`refine` and `calibrate` with fields in turn: each colour in its own field, and the results of one colour."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from firmware_iface.virtual import open_headset
from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.bundle.bundle_folder import write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.calibration.drift import Drift
from runtime.cli import main
from runtime.headset.colour_fields import ColourPanel
from runtime.lightpath import ideal_path as ideal
from runtime.refinement.panel_and_camera import PanelAndCamera
from runtime.service.shared_memory import crc32
from runtime.solver import quality
from tests.campaigns.headset import COLOURS, hardware, write_configuration
from tests.runtime.benches import converted, scene

DISTANCE_MM = 8.0


def written(folder: Path, shape: tuple[int, int], defect: str, networks: dict[str, bytes]) -> dict[str, Path]:
    """A bundle that knows no defect, a bench that has one, and a headset's configuration with and without fields."""
    in_turn = write_configuration(folder, colours=True)
    bench = f"[panel]\nheight = {shape[0]}\nwidth = {shape[1]}\n[propagation]\ndistance_mm = {DISTANCE_MM}\n"
    bench += "".join(f'[[channel]]\nname = "{name}"\nwavelength_nm = {nm}\n' for name, nm in COLOURS.items())
    (folder / "bench.toml").write_text(bench + f"[[defect]]\n{defect}\n")
    one = folder / "one_colour.toml"
    one.write_text(in_turn.read_text().replace("fields = 3\n", ""))
    paths = [
        (n, DISTANCE_MM, nm, converted(ideal.ideal_path(shape, 8e-6, nm * 1e-9, DISTANCE_MM * 1e-3, 1.0), np.float32))
        for n, nm in COLOURS.items()
    ]  # fmt: skip
    records, arrays = pack_light_paths(paths)
    bundle = folder / "measured"
    write_bundle(bundle, arrays, {"paths": records, "distance_mm": DISTANCE_MM}, {}, networks=networks)
    return {"in_turn": in_turn, "one": one, "bundle": bundle, "bench": folder / "bench.toml"}


def ran(capsys: pytest.CaptureFixture[str], *words: object) -> dict:
    assert main([str(word) for word in (*words, "--json")]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


@contextmanager
def noted(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[tuple[int, int]]]:
    """(CRC-32 of a pattern, mask of its own laser) of all that was to be shown, as the caller of a panel knows it."""
    own: set[tuple[int, int]] = set()
    show, light, both = ColourPanel.show, ColourPanel.light, PanelAndCamera.__call__
    lit: list[str] = []

    def note_light(panel: ColourPanel, colours: list[str]) -> None:
        lit[:] = colours
        light(panel, colours)

    def note(panel: ColourPanel, gray: np.ndarray) -> None:
        own.update((crc32(gray), 1 << list(COLOURS).index(colour)) for colour in lit)
        show(panel, gray)

    def note_all(display: PanelAndCamera, gray: np.ndarray) -> np.ndarray:
        own.update((crc32(field), 1 << k) for k, field in enumerate(gray))
        return both(display, gray)

    with monkeypatch.context() as patched:
        patched.setattr(ColourPanel, "light", note_light)
        patched.setattr(ColourPanel, "show", note)
        patched.setattr(PanelAndCamera, "__call__", note_all)
        yield own


def all_in_their_own_fields(remote: RemoteHardware, own: set[tuple[int, int]]) -> bool:
    """Whether every colour was lit, and never on another colour's pattern or in another's field; dark at the end."""
    lit = remote.lit()
    return lit <= own and {mask for _, mask in lit} == {1, 2, 4} and remote.light()[-1][1] == 0


def test_a_refinement_in_turn_is_what_it_is_in_one_colour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")
    from trainer.networks.approximator import Approximator, Architecture
    from trainer.networks.onnx_files import onnx_files

    shape = (48, 64)
    torch.manual_seed(0)
    networks = onnx_files(Approximator(Architecture("compact", 8, shape, 3)))
    files = written(tmp_path, shape, 'kind = "phase_response"', networks)
    target = np.stack([scene(shape), scene(shape)[:, ::-1], scene(shape)[::-1]])
    np.save(tmp_path / "picture.npy", target)
    words = ["refine", files["bundle"], tmp_path / "picture.npy", "--captures", 6]
    found = {}
    for name in ("in_turn", "one"):
        with hardware(tmp_path) as remote, noted(monkeypatch) as own:
            out = tmp_path / f"{name}.png"
            found[name] = ran(capsys, *words, "--headset", files[name], "--out", out)
            if name == "in_turn":
                assert all_in_their_own_fields(remote, own)
    in_turn, one = found["in_turn"]["psnr_db"], found["one"]["psnr_db"]
    assert in_turn["best"] > in_turn["first"] + 2
    assert in_turn["first"] == pytest.approx(
        one["first"], abs=0.1
    )  # the same patterns: only the noise differs
    assert in_turn["best"] == pytest.approx(one["best"], abs=0.5)
    truth = open_headset(str(files["bench"]))
    for colour, wanted in zip(COLOURS, target, strict=True):
        seen = {}
        for name, result in found.items():
            with Image.open(result["patterns"][colour]) as image:
                seen[name] = quality(truth.true_irradiance(np.asarray(image), colour), wanted).psnr_db
        assert seen["in_turn"] == pytest.approx(seen["one"], abs=1.0), colour


def test_a_calibration_in_turn_is_what_it_is_in_one_colour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = (48, 64)
    files = written(tmp_path, shape, 'kind = "panel_wavefront"', {})
    found = {}
    for name in ("in_turn", "one"):
        with hardware(tmp_path) as remote, noted(monkeypatch) as own:
            found[name] = ran(capsys, "calibrate", files["bundle"], "--headset", files[name], "--check")
            if name == "in_turn":
                assert all_in_their_own_fields(remote, own)
    in_turn, one = found["in_turn"], found["one"]
    assert in_turn["verdict"] == one["verdict"] == "recalibrated"
    assert in_turn["heldout"]["after"]["excess"] < 0.01 * in_turn["heldout"]["before"]["excess"]
    waves = [Drift(np.array(f["wavefront"]["terms_nm"])).wavefront(shape) for f in (in_turn, one)]
    noise_nm = np.hypot(*(f["wavefront"]["error_rms_nm"] for f in (in_turn, one)))
    assert (waves[0] - waves[1]).std() < max(4 * noise_nm, 0.02 * waves[1].std())
    assert waves[1].std() > 20
    for colour in COLOURS:
        shown = [f["channels"][colour]["picture_psnr_db"] for f in (in_turn, one)]
        assert shown[0]["after"] == pytest.approx(shown[1]["after"], abs=0.5)
        assert shown[0]["after"] > shown[0]["before"] + 1
