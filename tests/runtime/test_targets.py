from __future__ import annotations

import io
import pickle
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from firmware_iface.errors import InputError
from runtime.solver.targets import decode_srgb, encode_srgb, fit_area, read_target

RGB = np.array(
    [[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[0, 0, 0], [255, 255, 255], [188, 188, 188]]], np.uint8
)


def save_png(path: Path, pixels: np.ndarray) -> Path:
    """PNG by its definition: 8 or 16 bits; gray, gray and alpha, RGB or RGBA."""
    planes = pixels.reshape(*pixels.shape[:2], -1)
    depth = 8 * pixels.dtype.itemsize
    colour_type = {1: 0, 2: 4, 3: 2, 4: 6}[planes.shape[-1]]

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], depth, colour_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(row.dtype.newbyteorder(">")).tobytes() for row in planes)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
    return path


def test_srgb_is_the_standards() -> None:
    assert decode_srgb(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)
    assert decode_srgb(np.array([0.0, 1.0])).tolist() == [0, 1]
    assert encode_srgb(np.array([-1.0, 2.0])).tolist() == [0, pytest.approx(1)]


@given(st.floats(0, 1))
def test_srgb_survives_a_round_trip(value: float) -> None:
    assert float(encode_srgb(decode_srgb(np.array(value)))) == pytest.approx(value, abs=1e-6)


def test_a_gray_png_is_decoded_to_linear(tmp_path: Path) -> None:
    gray = np.array([[0, 128, 255]], np.uint8)
    target = read_target(save_png(tmp_path / "a.png", gray))
    assert target.dtype == np.float32
    np.testing.assert_allclose(target, [[0, 0.215861, 1]], atol=1e-6)
    fine = read_target(save_png(tmp_path / "b.png", gray.astype(np.uint16) * 257))
    np.testing.assert_allclose(fine, target, atol=1e-7)


def test_sixteen_bits_are_not_cut_to_eight(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    levels = np.arange(30000, 30012, dtype=np.uint16)
    gray = read_target(save_png(tmp_path / "g.png", levels.reshape(3, 4)))
    colour = read_target(save_png(tmp_path / "c.png", levels.reshape(2, 2, 3)), channels=3)
    assert len(np.unique(gray)) == 12
    expected = decode_srgb(levels.reshape(2, 2, 3) / 65535)
    np.testing.assert_allclose(np.moveaxis(colour, 0, -1), expected, rtol=1e-6)
    both = read_target(save_png(tmp_path / "a.png", np.full((2, 2, 2), 65535, np.uint16)))
    assert both.tolist() == [[1, 1], [1, 1]]


def test_a_colour_picture_has_a_luminance_and_three_channels(tmp_path: Path) -> None:
    path = save_png(tmp_path / "a.png", RGB)
    luminance = read_target(path)
    np.testing.assert_allclose(luminance, [[0.2126, 0.7152, 0.0722], [0, 1, 0.502886]], atol=1e-5)
    planes = read_target(path, channels=3)
    assert planes.shape == (3, 2, 3)
    assert planes[:, 0].tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    swapped = read_target(path, channels=["blue", "red"])
    np.testing.assert_array_equal(swapped, planes[[2, 0]])
    assert read_target(path, channels=["green"]).shape == (1, 2, 3)


def test_a_gray_picture_is_the_same_in_every_channel(tmp_path: Path) -> None:
    path = save_png(tmp_path / "a.png", np.array([[9, 80]], np.uint8))
    planes = read_target(path, channels=3)
    assert planes.shape == (3, 1, 2)
    assert (planes == read_target(path)).all()


@pytest.mark.parametrize("channels", [2, 0, [], ["cyan"], ["red", "ch0"]])
def test_channels_have_names(tmp_path: Path, channels: object) -> None:
    path = save_png(tmp_path / "a.png", RGB)
    with pytest.raises(InputError, match="channels"):
        read_target(path, channels=channels)  # type: ignore[arg-type]


def test_palettes_and_single_bits_are_read(tmp_path: Path) -> None:
    Image.fromarray(RGB).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "p.png")
    np.testing.assert_array_equal(
        read_target(tmp_path / "p.png", channels=3),
        read_target(save_png(tmp_path / "a.png", RGB), channels=3),
    )
    Image.fromarray(np.array([[True, False]])).save(tmp_path / "1.png")
    assert read_target(tmp_path / "1.png").tolist() == [[1, 0]]


def test_opaque_alpha_is_ignored_and_transparency_refused(tmp_path: Path) -> None:
    pixels = np.dstack([RGB, np.full(RGB.shape[:2], 255, np.uint8)])
    opaque = read_target(save_png(tmp_path / "a.png", pixels), channels=3)
    np.testing.assert_array_equal(opaque, read_target(save_png(tmp_path / "b.png", RGB), channels=3))
    pixels[1, 1, 3] = 254
    with pytest.raises(InputError, match="transparent"):
        read_target(save_png(tmp_path / "a.png", pixels))


@pytest.mark.parametrize("name", ["a.jpg", "a.tif", "a.png", "a.npy"])
def test_a_file_is_read_as_what_it_is_under_any_name(tmp_path: Path, name: str) -> None:
    expected = read_target(save_png(tmp_path / "rgb.png", RGB), channels=3)
    gray = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (32, 1))
    smooth = read_target(save_png(tmp_path / "gray.png", gray))
    for kind, options in (("PNG", {}), ("TIFF", {}), ("TIFF", {"compression": "tiff_lzw"})):
        Image.fromarray(RGB).save(tmp_path / name, kind, **options)
        np.testing.assert_array_equal(read_target(tmp_path / name, channels=3), expected)
    Image.fromarray(gray).save(tmp_path / name, "JPEG", quality=98)
    np.testing.assert_allclose(read_target(tmp_path / name), smooth, atol=0.03)
    with (tmp_path / name).open("wb") as file:
        np.save(file, expected)
    np.testing.assert_array_equal(read_target(tmp_path / name, channels=3), expected)


def test_a_tiff_of_16_bits_is_srgb_and_one_of_floats_is_linear(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    gray = np.arange(30000, 30012, dtype=np.uint16).reshape(3, 4)
    Image.fromarray(gray).save(tmp_path / "g.tif")
    np.testing.assert_allclose(read_target(tmp_path / "g.tif"), decode_srgb(gray / 65535), rtol=1e-6)
    colour = np.random.default_rng(0).integers(0, 65536, (4, 5, 3)).astype(np.uint16)
    assert cv2.imwrite(str(tmp_path / "c.tif"), colour[..., ::-1])
    planes = read_target(tmp_path / "c.tif", channels=3)
    np.testing.assert_allclose(np.moveaxis(planes, 0, -1), decode_srgb(colour / 65535), atol=1e-6)
    linear = np.random.default_rng(0).random((4, 5)).astype(np.float32)
    Image.fromarray(linear).save(tmp_path / "f.tif")
    np.testing.assert_array_equal(read_target(tmp_path / "f.tif"), linear)
    (tmp_path / "c.tif").write_bytes((tmp_path / "c.tif").read_bytes()[:60])
    with pytest.raises(InputError, match="cannot be read as TIFF"):
        read_target(tmp_path / "c.tif")


def test_a_photograph_is_the_right_way_up(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    Image.fromarray(np.zeros((8, 16), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert read_target(tmp_path / "a.jpg").shape == (16, 8)


def test_an_array_that_is_too_large_is_refused_by_its_name(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (99999999, 99999999)}
    )
    (tmp_path / "a.npy").write_bytes(header.getvalue())
    with pytest.raises(InputError, match="a.npy"):
        read_target(tmp_path / "a.npy")


def test_npy_is_linear_as_it_is(tmp_path: Path) -> None:
    planes = np.random.default_rng(0).random((3, 4, 5)) * 7
    np.save(tmp_path / "a.npy", planes)
    np.testing.assert_allclose(read_target(tmp_path / "a.npy", channels=3), planes, rtol=1e-6)
    np.save(tmp_path / "b.npy", planes[0])
    np.testing.assert_allclose(read_target(tmp_path / "b.npy"), planes[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        (np.array([[1.0, np.nan]]), "not finite"),
        (np.array([[1e300]]), "too large"),
        (np.array([[1.0, -0.25]]), "negative values .down to -0.25"),
        (np.zeros((0, 3)), "is empty: its size is 0 high and 3 wide"),
        (np.zeros((4, 5, 3)), r"shape \(4, 5, 3\); give \[H, W\] or \[3, H, W\]"),
        (np.zeros(3), "shape"),
        (np.zeros((2, 2), complex), "real numbers"),
        (np.array([["a"]]), "real numbers"),
    ],
)
def test_an_array_that_is_no_picture_is_refused(tmp_path: Path, array: np.ndarray, reason: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=reason):
        read_target(tmp_path / "a.npy")


def test_pickle_is_never_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[{}]], object), allow_pickle=True)
    (tmp_path / "b.npy").write_bytes(pickle.dumps(np.zeros((2, 2))))
    for name in ("a.npy", "b.npy"):
        with pytest.raises(InputError, match="cannot be read as NPY"):
            read_target(tmp_path / name)


def test_files_that_are_something_else_are_refused(tmp_path: Path) -> None:
    whole = save_png(
        tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (40, 40), np.uint8)
    ).read_bytes()
    for name, contents, reason in [
        ("cut.png", whole[: len(whole) // 2], "cannot be read as PNG"),
        ("other.png", b"GIF89a" + bytes(40), "is not a PNG"),
        ("empty.png", b"", "is not a PNG"),
        ("empty.npy", b"", "cannot be read as NPY"),
        ("cut.jpg", b"\xff\xd8\xff" + bytes(40), "cannot be read as JPEG"),
        ("cut.tif", b"II*\0" + bytes(40), "cannot be read as TIFF"),
        ("a.gif", b"GIF89a" + bytes(40), "give PNG, JPEG, TIFF, EXR or NPY"),
    ]:
        (tmp_path / name).write_bytes(contents)
        with pytest.raises(InputError, match=reason) as refused:
            read_target(tmp_path / name)
        assert "0x" not in str(refused.value)
    archive = io.BytesIO()
    np.savez(archive, a=np.zeros((2, 2)))
    (tmp_path / "z.npy").write_bytes(archive.getvalue())
    with pytest.raises(InputError, match="does not hold an array"):
        read_target(tmp_path / "z.npy")
    with pytest.raises(InputError, match="is missing"):
        read_target(tmp_path / "none.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match="not a file"):
        read_target(tmp_path / "folder.png")


def test_a_cut_16_bit_colour_png_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    pixels = np.random.default_rng(0).integers(0, 65536, (40, 40, 3)).astype(np.uint16)
    path = save_png(tmp_path / "a.png", pixels)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match="cannot be read"):
        read_target(path)


def test_the_size_must_be_right_or_is_fitted(tmp_path: Path) -> None:
    path = save_png(tmp_path / "a.png", np.full((4, 6), 255, np.uint8))
    assert read_target(path, shape=(4, 6)).shape == (4, 6)
    with pytest.raises(InputError, match="is 4 high and 6 wide and 2 high and 2 wide is needed"):
        read_target(path, shape=(2, 2))
    np.testing.assert_allclose(read_target(path, shape=(3, 5), fit=True), 1, rtol=1e-6)
    assert read_target(path, shape=(9, 2), channels=3, fit=True).shape == (3, 9, 2)


def test_fitting_takes_means_of_the_central_crop() -> None:
    picture = np.arange(24.0).reshape(4, 6)
    halves = picture.reshape(2, 2, 3, 2).mean((1, 3))
    np.testing.assert_allclose(fit_area(picture, (2, 3)), halves)
    np.testing.assert_allclose(fit_area(picture, (2, 2)), picture[:, 1:5].reshape(2, 2, 2, 2).mean((1, 3)))
    np.testing.assert_allclose(fit_area(picture, (8, 12)), picture.repeat(2, 0).repeat(2, 1))
    np.testing.assert_allclose(fit_area(picture[None], (4, 6))[0], picture)


@given(
    st.tuples(st.integers(1, 12), st.integers(1, 12)),
    st.tuples(st.integers(1, 12), st.integers(1, 12)),
    st.integers(0, 99),
)
def test_fitting_keeps_the_light(size: tuple[int, int], shape: tuple[int, int], seed: int) -> None:
    picture = np.random.default_rng(seed).random(size)
    fitted = fit_area(picture, shape)
    assert fitted.shape == shape
    assert fitted.min() >= 0
    assert fitted.max() <= picture.max() + 1e-9
    if size[0] * shape[1] == size[1] * shape[0]:  # nothing is cropped
        assert fitted.mean() == pytest.approx(picture.mean(), rel=1e-6)


def test_exr_is_linear_as_it_is(tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    planes = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32) * 9
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}

    def save(name: str, channels: dict[str, np.ndarray]) -> Path:
        openexr.File(header, channels).write(str(tmp_path / name))
        return tmp_path / name

    rgb = save("rgb.exr", dict(zip("RGB", planes, strict=True)))
    np.testing.assert_array_equal(read_target(rgb, channels=3), planes)
    np.testing.assert_array_equal(read_target(rgb, channels=["blue"]), planes[2:])
    gray = save("y.exr", {"Y": planes[1].astype(np.float16)})
    np.testing.assert_allclose(read_target(gray), planes[1], rtol=1e-3)
    with pytest.raises(InputError, match="neither R, G, B nor Y; its channels are Z"):
        read_target(save("z.exr", {"Z": planes[0]}))
    (tmp_path / "bad.exr").write_bytes(rgb.read_bytes()[:100])
    with pytest.raises(InputError, match="cannot be read as EXR"):
        read_target(tmp_path / "bad.exr")


def test_what_to_install_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    monkeypatch.setitem(sys.modules, "cv2", None)
    (tmp_path / "a.exr").write_bytes(b"")
    with pytest.raises(InputError, match=r"pip install 'hololoop\[trainer\]'"):
        read_target(tmp_path / "a.exr")
    with pytest.raises(InputError, match=r"pip install 'hololoop\[trainer\]'"):
        read_target(save_png(tmp_path / "a.png", RGB.astype(np.uint16)), channels=3)


def test_an_npy_file_is_judged_by_its_header_first(tmp_path: Path) -> None:
    def with_header(shape: tuple[int, ...], size: int) -> Path:
        path = tmp_path / "picture.npy"
        with path.open("wb") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "<f8", "fortran_order": False, "shape": shape}
            )
            file.truncate(size)  # a sparse file, as a tool may leave it
        return path

    huge = 128 + 8 * 99999**2
    for size in (1000, huge):
        with pytest.raises(InputError, match="99999 high and 99999 wide and 4 high and 6 wide is needed"):
            read_target(with_header((99999, 99999), size), (4, 6))
    with pytest.raises(InputError, match="too large for a picture: 99999 high"):
        read_target(with_header((99999, 99999), huge), (4, 6), fit=True)
    with pytest.raises(InputError, match="cut off"):
        read_target(with_header((4, 6), 200), (4, 6))
