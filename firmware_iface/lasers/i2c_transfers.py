"""I2C transfers through smbus2: open a bus, write, read. Every driver of a part uses these functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smbus2 import SMBus


def open_bus(bus: str) -> SMBus:
    """Open a bus.

    Parameters
    ----------
    bus : str
        A path such as `/dev/i2c-1`, or `virtual:SOCKET` for a board that another process emulates.

    Returns
    -------
    smbus2.SMBus

    Raises
    ------
    OSError
        Where it cannot be opened.
    """
    from smbus2 import SMBus

    if bus.startswith("virtual:"):
        from firmware_iface.virtual.i2c.bus_server import connect

        return SMBus(connect(bus.removeprefix("virtual:")))
    return SMBus(bus)


def write(bus: SMBus, address: int, data: bytes) -> None:
    """One write message.

    Raises
    ------
    OSError
        Where the part or the adapter does not carry it out.
    """
    from smbus2 import i2c_msg

    bus.i2c_rdwr(i2c_msg.write(address, data))


def read(bus: SMBus, address: int, length: int) -> bytes:
    """One read message of `length` bytes.

    Raises
    ------
    OSError
        As `write` does.
    """
    from smbus2 import i2c_msg

    message = i2c_msg.read(address, length)
    bus.i2c_rdwr(message)
    return bytes(message)


def write_read(bus: SMBus, address: int, data: bytes, length: int) -> bytes:
    """Write, then read `length` bytes after a repeated START.

    Raises
    ------
    OSError
        As `write` does.
    """
    from smbus2 import i2c_msg

    message = i2c_msg.read(address, length)
    bus.i2c_rdwr(i2c_msg.write(address, data), message)
    return bytes(message)
