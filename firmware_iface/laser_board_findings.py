"""What a configuration says of its lasers, compared with the board."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from firmware_iface.configured_devices import laser_channels
from firmware_iface.lasers.channels import MA_PER_V, PHOTODIODE_FULL_V, LaserChannel
from firmware_iface.lasers.photodiode_watch import TOLERANCE

SAME_COLOUR_NM = 15.0  # wavelengths that differ by less may be of one laser


def laser_problems(table: Mapping[str, Any]) -> list[str]:
    """What of [[lasers.channel]] is not so on the board.

    Only an emulated board says which laser is at which output; of a real one, nothing is reported.

    Parameters
    ----------
    table : mapping
        [lasers] of a configuration.

    Returns
    -------
    list of str
        Each a sentence with what to change.

    Raises
    ------
    InputError
        Where the table is wrong.
    DeviceGoneError
        Where there is no board.
    """
    from firmware_iface.virtual.remote_hardware import reach

    bus = str(table.get("bus"))
    if not bus.startswith("virtual:"):
        return []
    with closing(reach(bus)) as board:
        outputs = board.built_in_lasers()
    found = (_problem(k, *pair) for k, pair in enumerate(zip(laser_channels(table), outputs, strict=False)))
    return [problem for problem in found if problem]


def _problem(k: int, laser: LaserChannel, there: Mapping[str, Any]) -> str:
    """What is wrong with the description of a laser, whose output has the keys of `laser_board.Diode`; or nothing."""
    if abs(laser.wavelength_nm - there["wavelength_nm"]) > SAME_COLOUR_NM:
        return (
            f"output {k + 1} of the board is {there['name']}, {there['wavelength_nm']:g} nm, and [[lasers.channel]] "
            f"{k} is '{laser.name}', {laser.wavelength_nm:g} nm, so it cannot be lit: list the lasers in the order of "
            "the board's outputs"
        )
    full_uw = there["slope_uw_per_ma"] * max(0.0, laser.drive_v(1.0) * MA_PER_V - there["threshold_ma"])
    full_v = there["photodiode_v_per_uw"] * full_uw
    if abs(full_v - PHOTODIODE_FULL_V) <= TOLERANCE * PHOTODIODE_FULL_V:
        return ""
    return (
        f"'{laser.name}' would make {full_v:.2f} V at its photodiode at full power, not {PHOTODIODE_FULL_V:g} V, so it "
        f"would be switched off: correct threshold_ma (the board's is {there['threshold_ma']:g}), slope_uw_per_ma "
        f"({there['slope_uw_per_ma']:g}) and full_power_uw ({1 / there['photodiode_v_per_uw']:.4g}) in "
        f"[[lasers.channel]] {k}"
    )
