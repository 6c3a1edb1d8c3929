"""Capture sets are read whole or refused with one sentence; what is written is what is read."""

from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from firmware_iface.errors import InputError
from tests.trainer.made_sets import bench_tables, make_set, write_captures
from trainer.captures.bench_file import bench_tables as tables_of
from trainer.captures.bench_file import read_bench
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_writer import CaptureWriter

FUZZ = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    tables = bench_tables(channels=("green", "red"))
    return make_set(tmp_path_factory.mktemp("made") / "set", tables, patterns=2)


@pytest.fixture
def copy(made: CaptureSet, tmp_path: Path) -> Path:
    shutil.copytree(made.folder, tmp_path / "copy")
    return tmp_path / "copy"


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_bench_survives_being_written(made: CaptureSet) -> None:
    assert read_bench(tables_of(made.bench)) == made.bench
    camera = made.bench.camera
    assert camera.saturation == 4095 and camera.full_scale == 4031
    assert camera.counts_per_electron == pytest.approx(4031 / 10500)
    assert made.bench.channel("red").wavelength == pytest.approx(638e-9)
    assert made.bench.panel.shape == (64, 80) and made.bench.panel.pitch == pytest.approx(8e-6)


def test_set_tells_what_it_holds(made: CaptureSet) -> None:
    assert made.channels == ("green", "red") and made.planes == (5.0,) and len(made) == 6
    green = replace(made, captures=tuple(c for c in made.captures if c.channel == "green"))
    assert green.channels == ("green",) and green.bench is made.bench


@pytest.mark.parametrize("there", [True, False])
def test_a_table_of_many_rows_is_read_or_refused_in_seconds(copy: Path, there: bool) -> None:
    header, first, *_ = (copy / "captures.csv").read_text().splitlines()
    _, _, rest = first.partition(",")
    if not there:
        rest = rest.replace("image/0000", "image/lost")
    rows = [f"{k},{rest}" for k in range(30000)]
    (copy / "captures.csv").write_text("\n".join([header, *rows]) + "\n")
    begin = time.process_time()
    if there:
        assert len(read_captures(copy)) == len(rows)
    else:
        with pytest.raises(InputError, match="'image/lost.png' is not there"):
            read_captures(copy)
    assert time.process_time() - begin < 6


def test_signal_is_counts_above_black_without_saturated_pixels(made: CaptureSet, copy: Path) -> None:
    counts = made.counts(made.captures[0]).copy()
    counts[3, 5] = 4095
    Image.fromarray(counts).save(copy / "image/0000.png")
    copied = read_captures(copy)
    signal, valid = copied.signal(copied.captures[0])
    assert signal.dtype == np.float32 and np.array_equal(valid, counts < 4095) and not valid[3, 5]
    assert np.array_equal(signal, counts.astype(np.float32) - 64)


def test_noise_variance_matches_repeats(made: CaptureSet) -> None:
    a, b = (made.signal(c)[0].astype(float) for c in made.captures[:2])
    ratio = ((a - b) ** 2 / 2).mean() / made.noise_variance((a + b) / 2).mean()
    assert ratio == pytest.approx(1, abs=0.06)


def test_content_hash_follows_every_file(made: CaptureSet, copy: Path) -> None:
    first = read_captures(copy).content_hash()
    assert first == made.content_hash() and len(first) == 64
    edit(copy / "captures.csv", "10.0", "11.0")
    second = read_captures(copy).content_hash()
    Image.fromarray(made.gray(made.captures[2])).save(copy / "phase/0000.png")
    assert len({first, second, read_captures(copy).content_hash()}) == 3


def test_defaults_of_optional_columns(made: CaptureSet, copy: Path) -> None:
    (copy / "captures.csv").write_text(
        "capture,channel,phase,image,note\n"
        'a,green,phase/0000.png,image/0000.png,"x, y"\n'
        "\n"
        "b,red,phase\\0001.png,image/0001.png,\n"
    )
    a, b = read_captures(copy).captures
    assert (a.plane_mm, a.pattern, b.pattern, a.extra) == (5.0, "a", "b", {"note": "x, y"})
    assert b.phase == copy / "phase" / "0001.png" and b.time_s == 1.0


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("schema = 1", "schema = 2", "schema"),
        ("pitch_um", "pich_um", "panel.pich_um is not known in bench.toml: did you mean 'pitch_um'"),
        ("pitch_um = 8.0", "pitch_um = nan", "panel.pitch_um"),
        ("pitch_um = 8.0", 'pitch_um = "8"', "panel.pitch_um"),
        ("pitch_um = 8.0", "pitch_um = true", "panel.pitch_um"),
        ("pitch_um = 8.0", "pitch_um = 8e-6", "panel.pitch_um"),
        ("levels = 256", "levels = 256.0", "panel.levels"),
        ("fill_factor = 1.0", "fill_factor = 0.0", "panel.fill_factor"),
        ("fill_factor = 1.0", "phase_sign = 2", "panel.phase_sign"),
        ("wavelength_nm = 520", "wavelength_nm = 0.52", "channel.wavelength_nm"),
        ('name = "red"', 'name = "green"', "channel.name 'green' is given twice"),
        ("distance_mm = 5.0", "distance_mm = inf", "propagation.distance_mm"),
        ('shape = "square"', 'shape = "round"', "iris.shape"),
        ("black_level = 64", "black_level = 5000", "camera.black_level"),
        ("registered = true", "registered = false", "camera.homography is missing"),
        ("registered = true", "registered = 1", "camera.registered"),
        ("read_noise_e = 5", "", "camera.read_noise_e is missing"),
        ("[iris]", "[irsi]", "did you mean 'iris'"),
        ("[camera]\nwidth = 80", "[camera]\nwidth = 64", "registered = true"),
        ("bit_depth = 12", "bit_depth = " + "9" * 5000, "bench.toml"),
        ('name = "made"', "name = ", "is not TOML"),
    ],
)
def test_bench_faults_are_named(copy: Path, old: str, new: str, named: str) -> None:
    edit(copy / "bench.toml", old, new)
    with pytest.raises(InputError) as error:
        read_captures(copy)
    assert named in str(error.value) and "\n" not in str(error.value)


def test_homography_is_read_as_rows_or_flat() -> None:
    rows = [[0.5, 0, 1], [0, 0.5, 2], [0, 0, 1]]
    flat = [v for row in rows for v in row]
    benches = [read_bench(bench_tables(width=120, registered=False, homography=h)) for h in (rows, flat)]
    assert benches[0] == benches[1] and benches[0].camera.homography[1] == (0.0, 0.5, 2.0)
    assert read_bench(tables_of(benches[0])) == benches[0]
    for wrong in (
        [[1, 0, 0], [2, 0, 0], [0, 0, 1]],
        [1, 2, 3],
        "one",
        [[1, 0, 0], [0, float("nan"), 0], [0, 0, 1]],
    ):
        with pytest.raises(InputError, match="camera.homography"):
            read_bench(bench_tables(registered=False, homography=wrong))


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("capture,channel", "captur,channel", "no column 'capture'"),
        ("0001,green", "0000,green", "repeats the id"),
        ("0001,green", "0001,gren", "did you mean 'green'"),
        ("0001,green,5.0", "0001,green,nan", "plane_mm"),
        ("0001,green,5.0", "0001,green,far", "plane_mm"),
        ("0001,green,5.0", "0001,green,5.0,6.0", "cells"),
        ("image/0001.png", "image/none.png", "is not there"),
        ("image/0001.png", "../image/0001.png", "not inside the set"),
        ("image/0001.png,10.0", "image/0001.png,0", "exposure_ms"),
        ("image/0001.png", "", "image is empty"),
    ],
)
def test_row_faults_name_the_capture(copy: Path, old: str, new: str, named: str) -> None:
    edit(copy / "captures.csv", old, new)
    with pytest.raises(InputError) as error:
        read_captures(copy)
    assert named in str(error.value)
    assert "capture 000" in str(error.value) or "no column" in named


def test_semicolons_and_emptiness_are_explained(copy: Path) -> None:
    path = copy / "captures.csv"
    text = path.read_text()
    path.write_text(text.replace(",", ";"))
    with pytest.raises(InputError, match="commas"):
        read_captures(copy)
    for short in ("", text.splitlines()[0] + "\n"):
        path.write_text(short)
        with pytest.raises(InputError):
            read_captures(copy)
    with pytest.raises(InputError, match="not a folder"):
        read_captures(copy / "nowhere")


def broken_pictures(counts: np.ndarray) -> dict[str, Any]:
    return {
        "8-bit": Image.fromarray((counts >> 4).astype(np.uint8)),
        "of mode RGB": Image.fromarray(np.zeros((*counts.shape, 3), np.uint8)),
        "63 x 80": Image.fromarray(counts[1:]),
        "counts up to": Image.fromarray(counts << 4),
    }


@pytest.mark.parametrize("named", ["8-bit", "of mode RGB", "63 x 80", "counts up to"])
def test_wrong_pictures_are_refused_by_id(made: CaptureSet, copy: Path, named: str) -> None:
    broken_pictures(made.counts(made.captures[1]))[named].save(copy / "image/0001.png")
    broken = read_captures(copy)
    with pytest.raises(InputError, match="capture 0001") as error:
        broken.signal(broken.captures[1])
    assert named in str(error.value)


@FUZZ
@given(data=st.data())
def test_a_damaged_picture_is_never_read_in_part(made: CaptureSet, copy: Path, data: st.DataObject) -> None:
    for which, read in (("image", CaptureSet.counts), ("phase", CaptureSet.gray)):
        whole = (made.folder / which / "0000.png").read_bytes()
        if data.draw(st.booleans()):
            damaged = whole[: data.draw(st.integers(0, len(whole) - 1))]
        else:
            place = data.draw(st.integers(0, len(whole) - 1))
            other = whole[place] ^ data.draw(st.integers(1, 255))
            damaged = whole[:place] + bytes([other]) + whole[place + 1 :]
        (copy / which / "0000.png").write_bytes(damaged)
        broken = read_captures(copy)
        with pytest.raises(InputError, match="capture 0000"):
            read(broken, broken.captures[0])


@FUZZ
@given(data=st.data())
def test_damaged_tables_raise_nothing_but_input_errors(
    made: CaptureSet, copy: Path, data: st.DataObject
) -> None:
    for name in ("bench.toml", "captures.csv"):
        text = (made.folder / name).read_text()
        start = data.draw(st.integers(0, len(text)))
        end = start + data.draw(st.integers(0, 12))
        known = st.sampled_from(["nan", "-1", "1e400", "\0", '"', "[", "true", "\n"])
        put = data.draw(st.text(max_size=8) | known)
        (copy / name).write_bytes((text[:start] + put + text[end:]).encode("utf-8", "surrogatepass"))
    try:
        read_captures(copy)
    except InputError as error:
        assert str(error)


def test_writer_keeps_everything_and_names_files_in_order(made: CaptureSet, tmp_path: Path) -> None:
    rows = (
        {
            "gray": made.gray(c),
            "counts": made.counts(c),
            "channel": c.channel,
            "pattern": c.pattern,
            "capture": f"c{n}",
            "time_s": n / 3,
            "temperature_c": 21.5 + n,
        }
        for n, c in enumerate(made.captures)
    )
    folder = write_captures(tmp_path / "deep" / "set", made.bench, rows)
    written = read_captures(folder)
    assert written.bench == made.bench
    for old, new in zip(made.captures, written.captures, strict=True):
        assert np.array_equal(made.counts(old), written.counts(new))
        assert np.array_equal(made.gray(old), written.gray(new))
    assert written.captures[1].extra == {"temperature_c": "22.5"} and written.captures[1].time_s == 1 / 3
    assert sorted(p.name for p in folder.parent.iterdir()) == ["set"]


def test_writer_leaves_nothing_behind_when_it_fails(made: CaptureSet, tmp_path: Path) -> None:
    def rows() -> Any:
        c = made.captures[0]
        yield {"gray": made.gray(c), "counts": made.counts(c), "channel": "green"}
        raise RuntimeError("the camera was unplugged")

    with pytest.raises(RuntimeError):
        write_captures(tmp_path / "set", made.bench, rows())
    with pytest.raises(InputError, match="no captures"):
        write_captures(tmp_path / "set", made.bench, [])
    assert list(tmp_path.iterdir()) == []


def test_writer_refuses_to_overwrite_and_to_write_nonsense(made: CaptureSet, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exists already"):
        CaptureWriter(made.folder, made.bench)
    (tmp_path / "empty").mkdir()
    gray, counts = made.gray(made.captures[0]), made.counts(made.captures[0])
    with CaptureWriter(tmp_path / "empty", made.bench) as writer:
        writer.add(gray, counts, "green")
        for wrong in (
            {"gray": gray[1:]},
            {"counts": counts.astype(float)},
            {"counts": counts + 4096},
            {"channel": "violet"},
            {"capture": "0000"},
            {"plane_mm": float("nan")},
            {"capture": " "},
        ):
            with pytest.raises(InputError):
                writer.add(**({"gray": gray, "counts": counts, "channel": "green"} | wrong))
    assert len(read_captures(tmp_path / "empty")) == 1


def test_practice_sets_are_read(shared: Path) -> None:
    for folder in sorted((shared / "practice").iterdir()):
        practice = read_captures(folder)
        capture = practice.captures[0]
        assert practice.gray(capture).shape == practice.counts(capture).shape == (240, 320)
