from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.errors import InputError
from runtime.bundle import bundle_folder as module
from runtime.bundle.bundle_folder import Bundle, read_bundle, write_bundle

ARRAYS = {
    "source": (np.arange(12).reshape(3, 4) + 1j).astype(np.complex64),
    "response": np.linspace(0, 1, 256, dtype=np.float32)[None],
    "weights": np.array([1.0]),
    "levels": np.array(256),
}
DESCRIPTION = {"panel": {"height": 3, "width": 4}, "wavelength_nm": [532.0], "name": "grün"}
PROVENANCE = {"captures": "ab" * 32, "code": "0.1.0"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_bundle(tmp_path / "b", ARRAYS, DESCRIPTION, PROVENANCE, approximator=b"network")
    return tmp_path / "b"


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change bundle.json as someone would who knows how it is hashed."""
    path = folder / "bundle.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    manifest["sha256"] = module._manifest_hash(manifest)
    path.write_text(json.dumps(manifest))


def replace_arrays(folder: Path, data: bytes) -> None:
    (folder / "lightpath.safetensors").write_bytes(data)
    digest = hashlib.sha256(data).hexdigest()
    edit(folder, lambda manifest: manifest["files"].update({"lightpath.safetensors": digest}))


def test_what_is_written_is_read(folder: Path) -> None:
    bundle = read_bundle(folder, required=["source", "response"])
    assert isinstance(bundle, Bundle)
    assert bundle.description == DESCRIPTION
    assert bundle.provenance == PROVENANCE
    assert bundle.approximator_path == folder / "approximator.onnx"
    assert bundle.approximator == b"network"
    assert bundle.arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert bundle.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(bundle.arrays[name], array)
        assert not bundle.arrays[name].flags.writeable


def test_the_manifest_says_what_the_design_promises(folder: Path) -> None:
    manifest = json.loads((folder / "bundle.json").read_text())
    assert manifest["format"] == "hololoop-bundle"
    assert manifest["version"] == 1
    for name, digest in manifest["files"].items():
        assert digest == hashlib.sha256((folder / name).read_bytes()).hexdigest()


def test_views_and_foreign_byte_orders_are_stored_as_their_values(tmp_path: Path) -> None:
    a = np.arange(12, dtype=np.float32).reshape(3, 4)
    write_bundle(tmp_path / "b", {"t": a.T, "s": a[::2, 1:], "big": a.astype(">f4")}, {}, {})
    bundle = read_bundle(tmp_path / "b")
    np.testing.assert_array_equal(bundle.arrays["t"], a.T)
    np.testing.assert_array_equal(bundle.arrays["s"], a[::2, 1:])
    np.testing.assert_array_equal(bundle.arrays["big"], a)
    assert bundle.approximator_path is None
    assert bundle.approximator is None


@given(data=st.data())
def test_any_changed_byte_is_noticed(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("changed") / "b"
    write_bundle(folder, ARRAYS, DESCRIPTION, PROVENANCE, approximator=b"network")
    path = folder / data.draw(st.sampled_from(["bundle.json", "lightpath.safetensors", "approximator.onnx"]))
    contents = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(contents) - 1))
    contents[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(contents)
    try:
        bundle = read_bundle(folder)
    except InputError as error:
        assert str(folder) in str(error)
    else:  # only white space of bundle.json means the same when it is another
        assert path.name == "bundle.json"
        assert bundle.description == DESCRIPTION
        assert bundle.provenance == PROVENANCE


@pytest.mark.parametrize("name", ["bundle.json", "lightpath.safetensors", "approximator.onnx"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing; copy"):
        read_bundle(folder)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_bundle(tmp_path / "none")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda m: m.update(version=2), "version 2 and this release reads version 1"),
        (lambda m: m.update(version=True), "version True"),
        (lambda m: m.pop("version"), "version None"),
        (lambda m: m.update(format="other"), "format"),
        (lambda m: m.update(files=[]), "has no files"),
        (lambda m: m.pop("provenance"), "has no provenance"),
        (lambda m: m["files"].update({"../secret": "0" * 64}), "does not know: '../secret'"),
        (lambda m: m["files"].pop("lightpath.safetensors"), "does not list lightpath.safetensors"),
        (lambda m: m["files"].pop("approximator.onnx"), "approximator.onnx is not listed"),
        (lambda m: m["files"].update({"approximator.onnx": None}), "SHA-256 differs"),
    ],
)
def test_a_manifest_of_another_kind_is_refused(
    folder: Path, change: Callable[[dict[str, Any]], object], reason: str
) -> None:
    edit(folder, change)
    with pytest.raises(InputError, match=reason):
        read_bundle(folder)


@pytest.mark.parametrize("text", ["", "[]", "{", '{"format": NaN}', "\udcff", "[" * 100000])
def test_a_manifest_that_is_no_manifest_is_refused(folder: Path, text: str) -> None:
    (folder / "bundle.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match="bundle.json"):
        read_bundle(folder)


def test_an_edited_manifest_is_refused(folder: Path) -> None:
    path = folder / "bundle.json"
    path.write_text(path.read_text().replace("532.0", "638.0"))
    with pytest.raises(InputError, match="was changed after the export"):
        read_bundle(folder)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (pickle.dumps({"source": 1}), "cannot be read as arrays"),
        (b"", "cannot be read as arrays"),
        (
            safetensors.numpy.save({"source": np.array([1, np.nan], np.float32)}),
            r"'source' has 1 .* at \(1,\)",
        ),
        (safetensors.numpy.save({"source": np.array([1j * np.inf], np.complex64)}), "not finite"),
        (safetensors.numpy.save({"source": np.zeros((0, 3))}), "empty"),
    ],
)
def test_arrays_that_cannot_be_used_are_refused(folder: Path, data: bytes, reason: str) -> None:
    replace_arrays(folder, data)
    with pytest.raises(InputError, match=reason) as caught:
        read_bundle(folder)
    assert "lightpath.safetensors" in str(caught.value)


def test_a_required_array_that_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(InputError, match="no array 'leak'; it has levels, response, source, weights"):
        read_bundle(folder, required=["source", "leak"])


def test_shapes_may_be_required(folder: Path) -> None:
    read_bundle(folder, required={"source": ("y", "x"), "response": ("channel", 256), "weights": (None,)})
    read_bundle(
        folder, required={"response": ("mode", 256), "weights": ("mode",), "source": None, "levels": ()}
    )
    with pytest.raises(InputError, match=r"'source' has the shape \(3, 4\), expected \(3, 5\)"):
        read_bundle(folder, required={"source": (3, 5)})
    with pytest.raises(InputError, match=r"expected \(any\)"):
        read_bundle(folder, required={"source": (None,)})
    with pytest.raises(InputError, match=r"with n = 3 as in 'source'"):
        read_bundle(folder, required={"source": ("n", "m"), "weights": ("n",)})


@pytest.mark.parametrize(
    ("array", "reason"),
    [
        (np.array([np.nan]), "not finite"),
        (np.zeros(0), "empty"),
        (np.zeros(2, np.complex128), "make it complex64"),
        (np.array([object()]), "type object"),
        (np.array(["a"]), "type <U1"),
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, array: np.ndarray, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        write_bundle(tmp_path / "b", {"a": array}, {}, {})
    assert list(tmp_path.iterdir()) == []


def test_descriptions_are_plain_json(tmp_path: Path) -> None:
    write_bundle(tmp_path / "b", {"a": np.zeros(1)}, {"n": np.float32(0.5), "pair": (1, 2), 3: "key"}, {})
    assert read_bundle(tmp_path / "b").description == {"n": 0.5, "pair": [1, 2], "3": "key"}
    for bad in ({"x": float("nan")}, {"x": object()}, {"x": {1, 2}}):
        with pytest.raises(InputError, match="description cannot be written as JSON"):
            write_bundle(tmp_path / "c", {"a": np.zeros(1)}, bad, {})


def test_no_arrays_and_an_empty_network_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="without arrays"):
        write_bundle(tmp_path / "b", {}, {}, {})
    with pytest.raises(InputError, match="approximator is empty"):
        write_bundle(tmp_path / "b", {"a": np.zeros(1)}, {}, {}, approximator=b"")


def test_a_bundle_is_overwritten_only_when_asked(folder: Path) -> None:
    with pytest.raises(InputError, match="not empty"):
        write_bundle(folder, {"a": np.zeros(1)}, {}, {})
    write_bundle(folder, {"a": np.zeros(1)}, {}, {}, replace=True)
    assert read_bundle(folder).arrays.keys() == {"a"}
    assert read_bundle(folder).approximator is None
