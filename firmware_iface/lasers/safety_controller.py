"""The safety controller of the laser board; safety_controller.md next to this file is its protocol."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING

from firmware_iface.errors import DeviceError
from firmware_iface.lasers.i2c_transfers import write, write_read

if TYPE_CHECKING:
    from smbus2 import SMBus

IDENTITY, VERSION, STATE, FAULTS, INPUTS, COMMAND, TOKEN = range(7)
DRIVE_CEILING, PHOTODIODE_CEILING, DRIVE_MAXIMUM, PHOTODIODE_MAXIMUM = 0x10, 0x18, 0x20, 0x28
VOLTS_PER_STEP = 1e-4
KNOWN = (0x4C, 1)


class State(IntEnum):
    """State of the controller, register STATE."""

    OFF, ARMED, EMIT, FAULT = range(4)


class Fault(IntFlag):
    """Latched faults, register FAULTS."""

    KEY, INTERLOCK, HEARTBEAT = 1, 2, 4
    OVERPOWER_0, OVERPOWER_1, OVERPOWER_2 = 8, 16, 32
    ALERT, TEMPERATURE, CONFIG, BUS, HOST = 64, 128, 256, 512, 1024


class Input(IntFlag):
    """Conditions that hold now, register INPUTS; all are needed to arm."""

    KEY, INTERLOCK, HEARTBEAT, DARK, COOL, QUIET, CEILINGS = 1, 2, 4, 8, 16, 32, 64


TO_DO = {
    Input.KEY: "turn the key on",
    Input.INTERLOCK: "close the interlock",
    Input.HEARTBEAT: "send the heartbeat at least every 50 ms",
    Input.DARK: "the DAC is not dark; switch the board off and on",
    Input.COOL: "let the lasers cool down",
    Input.QUIET: "the photodiodes see too much light",
    Input.CEILINGS: "the ceilings are not written; open the lasers again",
}  # where a condition does not hold


class Command(IntEnum):
    """Commands, register COMMAND."""

    OFF, CLEAR, ARM_FIRST, ARM_SECOND, FAULT = 0x00, 0xC3, 0xA5, 0x5A, 0xF0


def packet_error_code(data: bytes) -> int:
    """CRC-8 of SMBus (x^8 + x^2 + x + 1) over all bytes of a transfer, addresses included."""
    code = 0
    for byte in data:
        code ^= byte
        for _ in range(8):
            code = (code << 1 ^ (0x07 if code & 0x80 else 0)) & 0xFF
    return code


class SafetyController:
    """The controller.

    Parameters
    ----------
    bus : smbus2.SMBus
        Open.
    address : int

    Raises
    ------
    OSError
        From every method, where the bus does not carry a message.
    DeviceError
        From every method that reads, where a reply is garbled.
    """

    def __init__(self, bus: SMBus, address: int = 0x36) -> None:
        self._bus, self._address = bus, address

    def check_identity(self) -> None:
        """Check that it is a controller of this protocol.

        Raises
        ------
        DeviceError
            Where it is not.
        """
        found = (self._read(IDENTITY, 1), self._read(VERSION, 1))
        if found != KNOWN:
            raise DeviceError(
                f"the safety controller reports identity {found[0]:#04x}, version {found[1]}, and this driver needs "
                f"{KNOWN[0]:#04x}, version {KNOWN[1]}; check the address and the board's firmware."
            )

    def state(self) -> State:
        """Its state."""
        value = self._read(STATE, 1)
        if value not in State.__members__.values():
            raise DeviceError(f"the safety controller is in the unknown state {value}; update its firmware.")
        return State(value)

    def faults(self) -> Fault:
        """Its latched faults."""
        return Fault(self._read(FAULTS, 2))

    def inputs(self) -> Input:
        """The conditions that hold now."""
        return Input(self._read(INPUTS, 1))

    def fault_names(self) -> list[str]:
        """The names of its latched faults."""
        return [f.name.lower() for f in self.faults() if f.name]

    def missing_text(self, needed: Input) -> str:
        """What to do about those of the needed conditions that do not hold now; empty where all hold."""
        inputs = self.inputs()
        return "; ".join(TO_DO[i] for i in needed if not inputs & i)

    def command(self, command: Command) -> None:
        """Send a command; the controller ignores what its conditions forbid."""
        self._write(COMMAND, bytes([command]))

    def beat(self, token: int) -> None:
        """Write the heartbeat's token, 0 to 255, different from the last."""
        self._write(TOKEN, bytes([token]))

    def token(self) -> int:
        """The token it received last; 0: none."""
        return self._read(TOKEN, 1)

    def ceilings_v(self, laser: int) -> tuple[float, float]:
        """(drive, photodiode) ceilings of laser 0 to 2, V; 0: not written."""
        return self._volts(DRIVE_CEILING + laser), self._volts(PHOTODIODE_CEILING + laser)

    def maxima_v(self, laser: int) -> tuple[float, float]:
        """The highest ceilings it takes for laser 0 to 2, V."""
        return self._volts(DRIVE_MAXIMUM + laser), self._volts(PHOTODIODE_MAXIMUM + laser)

    def set_ceilings(self, laser: int, drive_v: float, photodiode_v: float) -> None:
        """Write the ceilings of laser 0 to 2; it takes them once after a reset."""
        for register, volts in ((DRIVE_CEILING, drive_v), (PHOTODIODE_CEILING, photodiode_v)):
            self._write(register + laser, round(volts / VOLTS_PER_STEP).to_bytes(2, "little"))

    def _volts(self, register: int) -> float:
        return self._read(register, 2) * VOLTS_PER_STEP

    def _write(self, register: int, value: bytes) -> None:
        data = bytes([register]) + value
        write(self._bus, self._address, data + bytes([packet_error_code(bytes([self._address << 1]) + data)]))

    def _read(self, register: int, length: int) -> int:
        reply = write_read(self._bus, self._address, bytes([register]), length + 1)
        sent = bytes([self._address << 1, register, self._address << 1 | 1])
        if packet_error_code(sent + reply[:-1]) != reply[-1]:
            raise DeviceError(
                f"the safety controller's reply {reply.hex(' ')} fails its packet error code; check the wiring."
            )
        return int.from_bytes(reply[:-1], "little")
