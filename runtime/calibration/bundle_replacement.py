"""Writes a calibrated bundle in place of the one that was there, which is kept; and puts that one back."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface.errors import InputError
from runtime.bundle.bundle_folder import Bundle, read_bundle, write_bundle
from runtime.bundle.light_path_arrays import bundle_paths, load_light_path, pack_light_paths
from runtime.calibration.drift import drifted
from runtime.calibration.self_calibration import Calibration
from runtime.calibration.summary import numbers


def previous(folder: Path) -> Path:
    """Where the bundle is kept that a calibration replaces."""
    whole = Path(os.path.realpath(folder))
    return whole.with_name(f"{whole.name}.previous")


def replace_bundle(folder: Path, bundle: Bundle, found: Calibration) -> Path:
    """Write a bundle whose light paths have the calibration's drift applied, at every colour and plane.

    The folder holds the old bundle or the new one at every moment. The old one is kept next to it, in place of one kept
    before. The camera's view goes into the description, and the calibration's numbers are added to the provenance. The
    network D goes along as the calibration has decided.

    Parameters
    ----------
    folder : Path
        Of the bundle.
    bundle : Bundle
        What the folder holds.
    found : Calibration

    Returns
    -------
    Path
        Where the old bundle is.
    """
    drift, paths = found.estimate.drift, []
    for record in bundle_paths(bundle):
        channel, plane, wavelength = record["channel"], record["plane_mm"], record["wavelength_nm"]
        path = load_light_path(bundle, channel, plane)
        paths.append((channel, plane, wavelength, drifted(path, channel, wavelength, drift)))
    records, arrays = pack_light_paths(paths)
    counts = {channel: value for channel, (value, _) in found.counts_per_ms.items()}
    camera = {"view": found.estimate.view.as_json(), "counts_per_ms": counts}
    provenance = dict(bundle.provenance)
    done = {"time": datetime.now(UTC).isoformat(timespec="seconds"), **numbers(found)}
    provenance["calibrations"] = [*provenance.get("calibrations", []), done]
    kept = previous(folder)
    write_bundle(
        folder,
        arrays,
        {**bundle.description, "paths": records, "camera": camera},
        provenance,
        networks=found.network.networks(bundle.networks) if found.network else bundle.networks,
        replace=True,
        keep=kept,
    )
    return kept


def restore_bundle(folder: Path) -> None:
    """Put back the bundle that the last calibration replaced; the calibrated one goes to where that was.

    Raises
    ------
    InputError
        Where none was kept, or it is not whole.
    """
    kept = previous(folder)
    if not kept.is_dir():
        raise InputError(
            f"{kept} is not there: no calibration of {folder} has replaced anything that could be put back"
        )
    old = read_bundle(kept)
    write_bundle(
        folder, old.arrays, old.description, old.provenance, networks=old.networks, replace=True, keep=kept
    )
