"""Opens the lasers on a bus."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_iface.errors import InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.i2c_transfers import open_bus
from firmware_iface.lasers.lasers import Lasers


def open_lasers(bus: str, channels: Sequence[LaserChannel], gated: GatedLight | None = None) -> Lasers:
    """Open the lasers on a bus.

    Parameters
    ----------
    bus : str
        See `i2c_transfers.open_bus`.
    channels : sequence of LaserChannel
        One to three, in the order of the DAC's outputs.
    gated : GatedLight or None
        As `Lasers` takes it.

    Returns
    -------
    Lasers

    Raises
    ------
    InputError
        Where the bus cannot be opened or the channels do not fit the board.
    DeviceError
        Where a part of the board fails.
    """
    try:
        opened = open_bus(bus)
    except OSError as error:
        raise InputError(
            f"the bus {bus} cannot be opened ({error.strerror or error}); give another one."
        ) from error
    try:
        return Lasers(opened, channels, gated=gated)
    except BaseException:
        opened.close()
        raise
