"""The bundle: the folder in which a calibrated light path goes from the trainer to the headset. It has

    bundle.json             {"format": "hololoop-bundle", "version": 1, "files": {name: SHA-256},
                            "description": {...}, "provenance": {...},
                            "sha256": SHA-256 of all the rest of this object}
    lightpath.safetensors   the arrays: real, integer, boolean or complex64
    approximator.onnx       the network after the optics; may be absent, as all that follow may
    approximator_gradient.onnx, approximator_adapters.safetensors
                            the gradient of its penalty, and the weights that it takes as inputs
    initialiser.onnx        a network that proposes a start

`sha256` is over the object without that key as JSON with sorted keys, no spaces, and ASCII only. Everything
is verified before anything is used, the bytes that were verified are the ones used, and nothing in a bundle
can carry code: pickle is never read.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from firmware_iface.errors import InputError
from runtime.bundle.whole_files import whole_folder

FORMAT = "hololoop-bundle"
VERSION = 1
MANIFEST = "bundle.json"
ARRAYS = "lightpath.safetensors"
APPROXIMATOR = "approximator.onnx"
GRADIENT = "approximator_gradient.onnx"
ADAPTERS = "approximator_adapters.safetensors"
INITIALISER = "initialiser.onnx"
NETWORKS = (APPROXIMATOR, GRADIENT, ADAPTERS, INITIALISER)

DTYPES = frozenset(np.dtype(code) for code in "?bBhHiIqQefdF")  # what both NumPy and safetensors have

Shape = Sequence[int | str | None]


@dataclass(frozen=True)
class Bundle:
    """A verified bundle.

    Attributes
    ----------
    description : dict
    arrays : dict of str to array
        Read-only.
    provenance : dict
    approximator_path : path or None
    approximator : bytes or None
        What was verified at approximator_path; load this and not the file, which may have changed since.
    networks : dict of str to bytes
        The same for each of NETWORKS that the bundle has, by name.
    """

    description: dict[str, Any]
    arrays: dict[str, np.ndarray]
    provenance: dict[str, Any]
    approximator_path: Path | None = None
    approximator: bytes | None = None
    networks: dict[str, bytes] = field(default_factory=dict)


def write_bundle(
    folder: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    description: Mapping[str, Any],
    provenance: Mapping[str, Any],
    approximator: bytes | None = None,
    *,
    networks: Mapping[str, bytes] | None = None,
    replace: bool = False,
    keep: str | os.PathLike[str] | None = None,
) -> None:
    """Write a bundle, whole or not at all.

    Parameters
    ----------
    folder : path
    arrays : mapping of str to array
        Of the light path, as `read_bundle` returns them.
    description, provenance : mapping
        Plain JSON.
    approximator : bytes or None
        The network after the optics, in ONNX.
    networks : mapping of str to bytes, or None
        Further files of NETWORKS, by name.
    replace : bool
        Replace a folder that is not empty, which is refused otherwise.
    keep : path or None
        Where the bundle that is replaced goes; None: it is removed.

    Raises
    ------
    InputError
        For arrays that a bundle does not hold, for what is not JSON, and where the folder cannot be written.
    """
    if not arrays:
        raise InputError(f"{folder}: a bundle without arrays does not describe a light path")
    laid_out = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    for name, array in laid_out.items():
        _check_array(f"{folder}: array {name!r}", array)
    contents = {ARRAYS: safetensors.numpy.save(laid_out)}
    given = dict(networks or {}) | ({} if approximator is None else {APPROXIMATOR: approximator})
    for name, data in given.items():
        if name not in NETWORKS:
            raise ValueError(f"{name} is not one of {', '.join(NETWORKS)}")
        if not data:
            raise InputError(f"{folder}: the {Path(name).stem} is empty")
        contents[name] = data
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "files": {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()},
        "description": _plain_json(f"{folder}: description", description),
        "provenance": _plain_json(f"{folder}: provenance", provenance),
    }
    manifest["sha256"] = _manifest_hash(manifest)
    contents[MANIFEST] = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    with whole_folder(folder, replace=replace, keep=keep) as temporary:
        for name, data in contents.items():
            (temporary / name).write_bytes(data)


def read_bundle(
    folder: str | os.PathLike[str], required: Iterable[str] | Mapping[str, Shape | None] = ()
) -> Bundle:
    """Read and verify a bundle.

    Parameters
    ----------
    folder : path
    required : iterable of str, or mapping of str to shape
        Arrays that the bundle must have, and their shapes. A dimension is a number, None for any, or a word that
        stands for the same number wherever it appears: {"source": ("y", "x"), "leak": ("y", "x")}.

    Returns
    -------
    Bundle

    Raises
    ------
    InputError
        For anything wrong: it names the file and the reason.
    """
    folder = Path(folder)
    manifest = _read_manifest(folder)
    contents = {}
    for name, expected in manifest["files"].items():
        data = _read(folder / name)
        if hashlib.sha256(data).hexdigest() != expected:
            raise InputError(
                f"{folder / name} is not the file that was exported: its SHA-256 differs from the one in "
                f"{MANIFEST}; copy or export the bundle again"
            )
        contents[name] = data
    for name in NETWORKS:
        if name not in contents and (folder / name).exists():
            raise InputError(
                f"{folder / name} is not listed in {MANIFEST}; remove it or export the bundle again"
            )
    arrays = _read_arrays(folder / ARRAYS, contents[ARRAYS])
    _check_required(folder / ARRAYS, arrays, required)
    approximator = contents.get(APPROXIMATOR)
    return Bundle(
        description=manifest["description"],
        arrays=arrays,
        provenance=manifest["provenance"],
        approximator_path=None if approximator is None else folder / APPROXIMATOR,
        approximator=approximator,
        networks={name: contents[name] for name in NETWORKS if name in contents},
    )


def _read_manifest(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a bundle: there is no such folder")
    path = folder / MANIFEST
    data = _read(path)
    try:
        manifest = json.loads(data.decode(), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise InputError(f"{path} is not JSON: {error}; export the bundle again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f'{path} does not describe a bundle: its format is not "{FORMAT}"')
    version = manifest.get("version")
    if type(version) is not int or version != VERSION:
        raise InputError(
            f"{path} has version {version!r} and this release reads version {VERSION}; "
            "export the bundle with the release that is to read it"
        )
    if manifest.get("sha256") != _manifest_hash(manifest):
        raise InputError(f"{path} was changed after the export: its SHA-256 differs; export the bundle again")
    for key in ("files", "description", "provenance"):
        if not isinstance(manifest.get(key), dict):
            raise InputError(f"{path} has no {key}; export the bundle again")
    if unknown := sorted(manifest["files"].keys() - {ARRAYS, *NETWORKS}):
        raise InputError(f"{path} lists a file that version {VERSION} does not know: {unknown[0]!r}")
    if ARRAYS not in manifest["files"]:
        raise InputError(f"{path} does not list {ARRAYS}; export the bundle again")
    return manifest


def _read_arrays(path: Path, data: bytes) -> dict[str, np.ndarray]:
    try:
        arrays = safetensors.numpy.load(data)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} cannot be read as arrays: {error}") from error
    for name, array in arrays.items():
        _check_array(f"{path}: array {name!r}", array)
        array.flags.writeable = False
    return arrays


def _check_array(where: str, array: np.ndarray) -> None:
    if array.dtype.newbyteorder("=") not in DTYPES:
        hint = "; make it complex64" if array.dtype.kind == "c" else ""
        raise InputError(f"{where} has the type {array.dtype}, which a bundle does not hold{hint}")
    if array.size == 0:
        raise InputError(f"{where} is empty: its shape is {array.shape}")
    if array.dtype.kind in "fc" and not (finite := np.isfinite(array)).all():
        place = tuple(int(i) for i in np.argwhere(~finite)[0])
        count = finite.size - int(np.count_nonzero(finite))
        raise InputError(f"{where} has {count} values that are not finite, the first at {place}")


def _check_required(
    path: Path, arrays: Mapping[str, np.ndarray], required: Iterable[str] | Mapping[str, Shape | None]
) -> None:
    sizes: dict[str, tuple[int, str]] = {}
    shapes = required if isinstance(required, Mapping) else dict.fromkeys(required)
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{path} has no array {name!r}; it has {', '.join(sorted(arrays)) or 'none'}")
        if shape is None:
            continue
        actual = arrays[name].shape
        if len(actual) != len(shape):
            raise InputError(f"{path}: array {name!r} has the shape {actual}, expected {_shape_text(shape)}")
        for size, expected in zip(actual, shape, strict=True):
            if isinstance(expected, str):
                known, first = sizes.setdefault(expected, (size, name))
                if size != known:
                    raise InputError(
                        f"{path}: array {name!r} has the shape {actual}, expected {_shape_text(shape)} "
                        f"with {expected} = {known} as in {first!r}"
                    )
            elif expected is not None and size != expected:
                raise InputError(
                    f"{path}: array {name!r} has the shape {actual}, expected {_shape_text(shape)}"
                )


def _shape_text(shape: Shape) -> str:
    return "(" + ", ".join("any" if size is None else str(size) for size in shape) + ")"


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} is missing; copy or export the bundle again") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error


def _plain_json(where: str, value: Mapping[str, Any]) -> dict[str, Any]:
    """The value as it will be read back, so that its hash is the same on both sides."""

    def numpy_scalar(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        raise TypeError(f"{type(item).__name__} is not a JSON type")

    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(value), allow_nan=False, default=numpy_scalar))
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} cannot be written as JSON: {error}") from error
    return plain


def _manifest_hash(manifest: Mapping[str, Any]) -> str:
    content = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it holds {name}")
