"""`hololoop-runtime solve` end to end, and what it says of bad input."""

from __future__ import annotations

import json
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths
from runtime.cli import main
from runtime.solver import quality, quality_of, shown
from runtime.solver.targets import encode_srgb, read_target
from tests.runtime.benches import converted, ideal_path, scene

SHAPE = (40, 56)


def make_bundle(folder: Path, channels: dict[str, float], planes: tuple[float, ...] = (6.0,)) -> Path:
    paths = []
    for channel, wavelength in channels.items():
        for plane in planes:
            path = ideal_path(SHAPE, plane * 1e-3)
            path = replace(path, response=path.response * 520 / wavelength)
            paths.append((channel, plane, wavelength, converted(path, np.float32)))
    records, arrays = pack_light_paths(paths)
    write_bundle(folder, arrays, {"paths": records, "distance_mm": planes[-1]}, {})
    return folder


@pytest.fixture(scope="module")
def green(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("green") / "bundle", {"green": 520.0}, (4.0, 6.0))


@pytest.fixture(scope="module")
def colour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(
        tmp_path_factory.mktemp("colour") / "bundle", {"red": 638.0, "green": 520.0, "blue": 450.0}
    )


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A colour picture whose parts differ."""
    path = tmp_path_factory.mktemp("pictures") / "picture.png"
    planes = np.stack([scene(SHAPE, seed) for seed in range(3)], -1)
    Image.fromarray(np.rint(255 * encode_srgb(planes)).astype(np.uint8)).save(path)
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(w) for w in words])
    done = capsys.readouterr()
    return code, done.out, done.err


def solved(capsys: pytest.CaptureFixture[str], *words: object) -> list[dict[str, Any]]:
    code, out, err = run(capsys, "solve", *words, "--json", "--overwrite")
    assert (code, err) == (0, "")
    result = json.loads(out)
    assert out.count("\n") == 1
    patterns: list[dict[str, Any]] = result["patterns"]
    return patterns


def test_one_picture_to_one_file(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "phase.png"
    (pattern,) = solved(capsys, green, picture, "--out", out, "--iterations", 15)
    with Image.open(out) as image:
        assert image.mode == "L"
        gray = np.asarray(image)
    assert gray.shape == SHAPE
    target = read_target(picture, SHAPE)
    seen = quality_of(load_light_path(read_bundle(green), "green", 6.0), gray, target)
    assert pattern["psnr_db"] == pytest.approx(seen.psnr_db, abs=1e-3)
    assert seen.psnr_db > 18
    assert (pattern["plane_mm"], pattern["channel"], pattern["iterations"]) == (6.0, "green", 15)
    assert pattern["phase"] == str(out)
    assert list(tmp_path.iterdir()) == [out]


def test_without_a_picture_one_that_ships_is_shown_and_the_result_says_so(
    green: Path, colour: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (pattern,) = solved(capsys, green, "--out", tmp_path / "p.png", "--iterations", 2)
    assert (
        Path(pattern["target"]).name == "test_picture.png" and Path(pattern["target"]).stat().st_size < 10_000
    )
    assert len(solved(capsys, colour, "--out", tmp_path / "c.png", "--iterations", 1)) == 3
    code, out, _ = run(capsys, "solve", green, "--out", tmp_path / "q.png", "--iterations", 0)
    assert code == 0 and "No picture is given: the patterns show hololoop's own test picture." in out
    assert "test picture" in " ".join(run(capsys, "solve", "--help")[1].split())


def test_a_missed_deadline_is_reported(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (green, picture, "--out", tmp_path / "p.png", "--deadline-ms")
    (missed,) = solved(capsys, *words, 0.001)
    assert missed["deadline_missed"] is True
    (met,) = solved(
        capsys, green, picture, "--out", tmp_path / "n.png", "--deadline-ms", 60000, "--iterations", 1
    )
    assert met["deadline_missed"] is False
    code, out, _ = run(capsys, "solve", green, picture, "--out", tmp_path / "m.png", "--deadline-ms", 0.001)
    assert code == 0 and "the deadline of 0.001 ms was missed" in out


def test_another_plane_gives_another_pattern(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (near,) = solved(capsys, green, picture, "--out", tmp_path / "n.png", "--plane", 4)
    (far,) = solved(capsys, green, picture, "--out", tmp_path / "f.png", "--plane", "6.0")
    assert (near["plane_mm"], far["plane_mm"]) == (4.0, 6.0)
    assert (tmp_path / "n.png").read_bytes() != (tmp_path / "f.png").read_bytes()


def test_colours_get_a_pattern_each_of_their_own_part_of_the_picture(
    colour: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    patterns = solved(capsys, colour, picture, "--out", tmp_path / "p.png", "--iterations", 12)
    names = [f"p-{c}.png" for c in ("red", "green", "blue")]
    assert [Path(p["phase"]).name for p in patterns] == names
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)
    bundle, parts = read_bundle(colour), read_target(picture, SHAPE, 3)
    for k, pattern in enumerate(patterns):
        gray = np.asarray(Image.open(pattern["phase"]))
        path = load_light_path(bundle, pattern["channel"])
        own = [quality_of(path, gray, part).psnr_db for part in parts]
        assert int(np.argmax(own)) == k
    (one,) = solved(
        capsys, colour, picture, "--out", tmp_path / "b.png", "--iterations", 12, "--channel", "blue"
    )
    assert one["phase"] == str(tmp_path / "b.png")
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "p-blue.png").read_bytes()


def test_frames_of_a_picture_are_numbered_and_their_mean_is_judged(
    green: Path, colour: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    patterns = solved(capsys, green, picture, "--out", tmp_path / "p.png", "--iterations", 8, "--frames", 2)
    assert [p["phase"] for p in patterns] == [str(tmp_path / f"p-{n}.png") for n in (1, 2)]
    assert [p["frame"] for p in patterns] == [1, 2]
    path = load_light_path(read_bundle(green), "green", 6.0)
    light = [shown(path, np.asarray(Image.open(p["phase"]))) for p in patterns]
    seen = quality((light[0] + light[1]) / 2, read_target(picture, SHAPE))
    assert all(p["psnr_db"] == pytest.approx(seen.psnr_db, abs=1e-3) for p in patterns)
    (one,) = solved(capsys, green, picture, "--out", tmp_path / "one.png", "--iterations", 8, "--frames", 1)
    (plain,) = solved(capsys, green, picture, "--out", tmp_path / "plain.png", "--iterations", 8)
    assert Path(one["phase"]).read_bytes() == Path(plain["phase"]).read_bytes()
    assert one["frame"] == plain["frame"] == 1
    assert seen.psnr_db > one["psnr_db"] + 1
    many = solved(capsys, colour, picture, "--out", tmp_path / "d", "--iterations", 1, "--frames", 10)
    assert len(many) == 30
    assert Path(many[0]["phase"]).name == "picture-red-01.png"
    code, said, _ = run(
        capsys, "solve", green, picture, "--out", tmp_path / "q", "--iterations", 1, "--frames", 2
    )
    assert code == 0
    assert said.count("(the mean of 2 frames)") == 1


def test_a_deadline_names_of_solvers_and_an_iris_beside_the_axis(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "p.png"
    (timed,) = solved(capsys, green, picture, "--out", out, "--deadline-ms", 400)
    assert timed["iterations"] > 2
    assert (
        timed["psnr_db"] > solved(capsys, green, picture, "--out", out, "--iterations", 0)[0]["psnr_db"] + 2
    )
    (alone,) = solved(capsys, green, picture, "--out", out, "--solver", "double_phase")
    assert alone["iterations"] == 0
    kinds = [
        ("--solver", "adam"), ("--solver", "gerchberg_saxton"), ("--penalty", "l1"), ("--grid", "panel"),
        ("--beside-zero-order",),
    ]  # fmt: skip
    patterns = {out.read_bytes()}
    for words in kinds:
        solved(capsys, green, picture, "--out", out, "--iterations", 4, *words)
        patterns.add(out.read_bytes())
    assert len(patterns) == len(
        kinds
    )  # Gerchberg-Saxton finds nothing better than the double phase it begins with
    same = set()
    for name in ("bfgs", "default"):  # the older spelling
        solved(capsys, green, picture, "--out", out, "--iterations", 4, "--solver", name)
        same.add(out.read_bytes())
    assert len(same) == 1


def test_several_pictures_go_to_a_folder(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.npy"
    np.save(other, scene(SHAPE, 5))
    out = tmp_path / "deep" / "patterns"
    code, said, err = run(capsys, "solve", green, picture, other, "--out", out, "--iterations", 2)
    assert (code, err) == (0, "")
    assert sorted(p.name for p in out.iterdir()) == ["other.png", "picture.png"]
    assert said.count("\n") == 2
    assert "dB after 2 iterations" in said


def test_a_picture_of_another_size_is_fitted_when_asked(
    green: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = tmp_path / "large.npy"
    np.save(large, scene((100, 120)))
    code, _, err = run(capsys, "solve", green, large, "--out", tmp_path / "p.png")
    assert code == 2
    assert "is 100 high and 120 wide and 40 high and 56 wide is needed" in err
    assert len(solved(capsys, green, large, "--out", tmp_path / "p.png", "--fit", "--iterations", 1)) == 1


def test_bad_input_is_one_line_and_exit_code_2(
    green: Path, colour: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("x")
    np.save(tmp_path / "dark.npy", np.zeros(SHAPE))
    np.save(tmp_path / "picture.npy", scene(SHAPE))
    out = ("--out", tmp_path / "p.png")
    for words, reason in [
        (("solve", tmp_path / "none", picture, *out), "no such folder"),
        (("solve", green, tmp_path / "none.png", *out), "none.png is missing"),
        (("solve", green, picture), "--out"),
        (("solve", green, picture, *out, "--iterations", "-1"), "'-1' is not a whole number from 0"),
        (("solve", green, picture, *out, "--frames", "0"), "'0' is not a whole number from 1 to 32"),
        (("solve", green, picture, *out, "--frames", "two"), "'two' is not a whole number from 1 to 32"),
        (
            ("solve", green, picture, *out, "--frames", "2", "--solver", "gerchberg_saxton"),
            "one pattern a picture",
        ),
        (("solve", green, picture, *out, "--plane", "near"), "'near' is not a distance in mm"),
        (("solve", green, picture, *out, "--plane", "5"), "no plane at 5 mm for green: use one of 4, 6"),
        (("solve", green, picture, *out, "--channel", "gren"), "did you mean 'green'"),
        (("solve", green, picture, picture, *out), "one file and there are 2 pictures"),
        (("solve", green, picture, picture, "--out", tmp_path / "d"), "would both be written to"),
        (("solve", green, picture, tmp_path / "picture.npy", "--out", tmp_path / "d"), "rename one"),
        (("solve", green, picture, "--out", tmp_path / "p.jpg"), "ends in .png"),
        (("solve", green, picture, "--out", tmp_path / "no" / "p.png"), "there is no folder"),
        (("solve", green, picture, "--out", tmp_path / "file" / "d"), "cannot be made"),
        (("solve", green, picture, "--out", picture), "overwritten by its own pattern"),
        (("solve", green, tmp_path / "dark.npy", *out), "all dark"),
        (("solve", green, picture, *out, "--magic"), "--magic"),
        (("solve", green, picture, *out, "--deadline-ms", "0"), "'0' is not a time in ms"),
        (("solve", green, picture, *out, "--solver", "newton"), "invalid choice: 'newton'"),
        (("slove", green), "did you mean 'solve'"),
    ]:
        code, said, err = run(capsys, *words)
        assert code == 2, words
        assert said == ""
        assert err.count("\n") == 1, err
        assert reason in err, (words, err)
    assert not (tmp_path / "p.png").exists()


def test_a_bundle_that_was_changed_is_refused(
    green: Path, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records, arrays = pack_light_paths(
        [("green", 6.0, 520.0, converted(ideal_path(SHAPE, 0.006), np.float32))]
    )
    write_bundle(tmp_path / "b", arrays, {"paths": records}, {})
    data = bytearray((tmp_path / "b" / "lightpath.safetensors").read_bytes())
    data[-100] ^= 1
    (tmp_path / "b" / "lightpath.safetensors").write_bytes(data)
    code, _, err = run(capsys, "solve", tmp_path / "b", picture, "--out", tmp_path / "p.png")
    assert code == 2
    assert "not the file that was exported" in err


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    code, said, _ = run(capsys, "solve", "--help")
    assert code == 0
    assert "examples:" in said and "--iterations N" in said
    code, said, _ = run(capsys)
    assert code == 0 and "hololoop-trainer export" in said
    code, said, _ = run(capsys, "--version")
    assert code == 0 and said.startswith("hololoop-runtime ")


def test_the_python_of_the_help_runs_as_it_stands(
    green: Path,
    picture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, said, _ = run(capsys, "solve", "--help")
    lines = said.split("in Python:\n")[1].split("next:")[0]
    (tmp_path / "bundle").symlink_to(green)
    (tmp_path / "picture.png").symlink_to(picture)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(textwrap.dedent(lines), names)
    assert names["gray"].dtype == np.uint8
    assert names["gray"].shape == SHAPE
