"""A model as a bundle for the headset: each colour and plane's light path as arrays.

Only effects that act on the display go in; those that act on the camera explain the measurement and are left out.
Arrays are computed in double precision and stored as float32 and complex64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.lightpath.grid import Grid
from runtime.lightpath.light_path import LightPath
from runtime.program.version import installed_version
from trainer.captures.batches import moments_of
from trainer.captures.capture_set import CaptureSet
from trainer.captures.capture_table import Moment
from trainer.captures.held_out import scenes
from trainer.device import array_of
from trainer.effects.definition import Effect
from trainer.model.model import Model
from trainer.model.model_stages import scene_for, stages_of
from trainer.model.parameters import json_values
from trainer.prediction.predict import light_path

NEGLIGIBLE = 1e-5  # share that a neighbour has in a sub-pixel's phase, which a camera would not see


def export_bundle(
    model: Model,
    captures: CaptureSet | None,
    folder: Path | str,
    *,
    network: Path | None = None,
    replace_folder: bool = False,
) -> dict[str, Any]:
    """Write a model's light paths as a bundle.

    Parameters
    ----------
    captures : CaptureSet or None
        What the model was fitted to, for its planes and its hash; without it the bench's own distance, for every
        colour.
    network : Path, optional
        File of a trained approximator, which goes in as ONNX.
    replace_folder : bool
        Replace a bundle that is in the folder.

    Returns
    -------
    dict
        Keys `bundle`, `channels`, `planes_mm`, `effects`, `effects_left_out`, `panel_field`, `learned`, `heldout`,
        `arrays`, `network` and `megabytes`, for `export --json`.

    Raises
    ------
    InputError
        Where the folder is not empty (unless `replace_folder`), where a plane cannot be computed, and where the
        network was trained for another panel, other colours or other effects.
    """
    if model.method == "fraunhofer":
        raise InputError(
            "a far-field model cannot be exported: the headset's light path is angular_spectrum or fresnel; change "
            "method under [propagation] in the model file"
        )
    exported = acting_on_display(model)
    # What changes from capture to capture stays as it was last; without captures nothing is known of it.
    last = moments_of(captures, captures.captures[-1:])[0] if captures else None
    if last is None:
        exported = replace(exported, present=tuple(p for p in exported.present if not p.effect.takes_moment))
    left_out = [p.effect for p in model.present if p.effect.name not in exported.names]
    scene_list = _colours_and_planes(model, captures)
    baked = [
        (
            channel,
            plane,
            model.bench.channel(channel).wavelength_nm,
            baked_path(exported, channel, plane, last),
        )
        for channel, plane in scene_list
    ]
    records, arrays = pack_light_paths(baked)
    panel, share = model.bench.panel, _slow_share(exported, *scene_list[0], last)
    description: dict[str, Any] = {
        "panel": {
            "height": panel.height,
            "width": panel.width,
            "pitch_um": panel.pitch_um,
            "levels": panel.levels,
            "phase_sign": panel.phase_sign,
            **({"gray_levels": list(panel.gray_levels)} if panel.gray_levels else {}),
            **({"slow_response_share": share} if share else {}),
        },
        "channels": [
            {"name": c.name, "wavelength_nm": c.wavelength_nm}
            for c in model.bench.channels
            if c.name in {channel for channel, _ in scene_list}
        ],
        "distance_mm": model.bench.distance_mm,
        "planes_mm": sorted({plane for _, plane in scene_list}),
        "method": model.method,
        "paths": records,
    }
    provenance: dict[str, Any] = {
        "bench": model.bench.name,
        "captures_sha256": captures.content_hash() if captures else None,
        "code_version": installed_version(),
        "heldout": _last_errors(model),
        "history": list(model.history),
        "effects": [
            {"effect": p.effect.name, "stage": p.effect.stage, "parameters": json_values(p, model.bench)}
            for p in exported.present
        ],
        "effects_left_out": [_named(e) for e in left_out],
        "panel_field": exported.panel_field is not None,
        "learned": list(exported.learned),
    }
    files: dict[str, bytes] = {}
    if network is not None:
        files, provenance["network"] = _network_files(
            network, model, [c["name"] for c in description["channels"]]
        )
    write_bundle(folder, arrays, description, provenance, networks=files, replace=replace_folder)
    return {
        "bundle": str(folder),
        "channels": [c["name"] for c in description["channels"]],
        "planes_mm": description["planes_mm"],
        "effects": list(exported.names),
        "effects_left_out": [e.name for e in left_out],
        "panel_field": exported.panel_field is not None,
        "learned": list(exported.learned),
        "heldout": provenance["heldout"],
        "arrays": len(arrays),
        "network": None if network is None else str(network),
        "megabytes": round((sum(a.nbytes for a in arrays.values()) + sum(map(len, files.values()))) / 1e6, 3),
    }


def _network_files(path: Path, model: Model, channels: list[str]) -> tuple[dict[str, bytes], dict[str, Any]]:
    """ONNX files of a trained approximator, and the facts that its file records."""
    from trainer.networks.approximator import read_approximator
    from trainer.networks.onnx_files import onnx_files

    network, about = read_approximator(path)
    shape = network.architecture.shape
    if shape != model.bench.panel.shape:
        raise InputError(
            f"{path} was trained for a panel of {shape[0]} x {shape[1]} and the model's has "
            f"{model.bench.panel.height} x {model.bench.panel.width} pixels: train one for it"
        )
    learned = about.get("channels", [])
    if learned != channels or network.architecture.planes != len(channels):
        raise InputError(
            f"{path} was trained on {', '.join(learned) or 'no known colours'} and the bundle has "
            f"{', '.join(channels)}: give the captures of the same colours"
        )
    beyond = about.get("effects", list(model.parts))
    if sorted(beyond) != sorted(model.parts):
        raise InputError(
            f"{path} was trained beyond {', '.join(beyond) or 'the ideal model'} and the model has "
            f"{', '.join(model.parts) or 'no effects'}: give the model that it was trained with"
        )
    return onnx_files(network), about


def acting_on_display(model: Model) -> Model:
    """The model with only what acts on the display, which the eye sees too."""
    return replace(
        model,
        present=tuple(p for p in model.present if p.effect.acts_on == "display"),
        learned={stage: maps for stage, maps in model.learned.items() if stage != "sensor"},
    )


def baked_path(model: Model, channel: str, plane_mm: float, moment: Moment | None = None) -> LightPath:
    """A model's light path for one colour and plane, as float32 and complex64 NumPy arrays.

    Parameters
    ----------
    moment : Moment, optional
        At which effects that change from capture to capture are taken; without it they are left out.
    """
    with torch.no_grad():
        scene = scene_for(model, channel, plane_mm, torch.float64)
        path = light_path(scene, stages_of(scene, model, moment=moment))
        if path.crosstalk is not None:
            rows, columns = path.crosstalk
            path = replace(path, crosstalk=(_without_far(rows), _without_far(columns)))
    return LightPath(**{f.name: _single(getattr(path, f.name)) for f in fields(path)})


def _without_far(taps: Tensor) -> Tensor:
    """Shares of neighbours without the outermost that are negligible, which a headset need not add up."""
    while taps.shape[1] > 1 and float(taps[:, [0, -1]].max()) < NEGLIGIBLE:
        taps = taps[:, 1:-1]
    return taps / taps.sum(dim=1, keepdim=True)


def _slow_share(model: Model, channel: str, plane_mm: float, moment: Moment | None) -> float:
    """Share of the phase before that is left when a pattern's time is over; cells turn alike in all colours."""
    with torch.no_grad():
        scene = scene_for(model, channel, plane_mm, torch.float64)
        left = stages_of(scene, model, moment=moment).drive.persistence
    return 0.0 if left is None else float(left)


def _single(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_single(part) for part in value)
    if isinstance(value, Tensor):
        return array_of(value.to(torch.complex64 if value.is_complex() else torch.float32))
    if value is None or isinstance(value, Grid | int):
        return value
    raise TypeError(f"a light path does not hold {type(value).__name__}")


def _colours_and_planes(model: Model, captures: CaptureSet | None) -> Sequence[tuple[str, float]]:
    if captures is not None and len(captures):
        return scenes(captures.captures)
    return [(c.name, model.bench.distance_mm) for c in model.bench.channels]


def _last_errors(model: Model) -> dict[str, float] | None:
    for record in reversed(model.history):
        errors = {k: record[k] for k in ("nrmse", "noise_nrmse", "excess") if k in record}
        if errors:
            return errors
    return None


def _named(effect: Effect) -> dict[str, str]:
    return {"effect": effect.name, "stage": effect.stage, "acts_on": effect.acts_on}
