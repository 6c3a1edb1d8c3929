"""Commands of TI's DLPC900 controller over USB HID (DLPU018): power, mode, pattern table, status, errors."""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.fields import Field
from firmware_iface.usb_link import UsbLink

OUT, IN, PACKET = 0x01, 0x81, 64
LOCK_S = 2.0  # until the receiver has found the picture
LONGEST_DATA = 504  # bytes of an image in one command

POWER, LAST_ERROR, FIRMWARE = 0x0200, 0x0100, 0x0206
HARDWARE_STATUS, SYSTEM_STATUS, MAIN_STATUS = 0x1A0A, 0x1A0B, 0x1A0C
RECEIVER, SOURCE, LED_ENABLES = 0x1A01, 0x1A00, 0x1A07
DISPLAY_MODE, PATTERN, PATTERN_LUT, PATTERN_ENTRY = 0x1A1B, 0x1A24, 0x1A31, 0x1A34
IMAGE_BEGIN, IMAGE_DATA = (0x1A2A, 0x1A2C), (0x1A2B, 0x1A2D)  # primary and secondary controller
STOP, START = 0, 2
RUNNING = 0x02  # of the main status
BY_SEQUENCER = 0x08  # LED enables follow the colour bits of the pattern table, and nothing else
EVERY_COLOUR = 0b111  # bit 0 red, 1 green, 2 blue
SHORTEST_US = 105  # exposure of a one-bit pattern
POWERS = ("normal", "standby")
RECEIVERS = ("off", "hdmi", "displayport")
MODES = ("video", "pre-stored", "video-pattern", "on-the-fly")
ERRORS = {
    1: "a batch file's checksum is wrong",
    3: "it does not know the command",
    5: "the command is not for this mode",
    6: "a parameter is wrong",
    9: "the image's compression is wrong",
    14: "the exposure is out of range",
    15: "the pattern's number is out of range",
    255: "an internal error",
}
HARDWARE = {2: "DMD reset controller error", 3: "forced swap", 6: "sequence aborted", 7: "sequence error"}

_READ, _REPLY, _FAILED = 0x80, 0x40, 0x20


@dataclass(frozen=True)
class PatternLine:
    """One line of the pattern table, for a one-bit pattern of image 0.

    Attributes
    ----------
    exposure_us, dark_us : int, µs
        How long it is exposed, and the darkness after that.
    colours : int
        Which LED enables are active during the exposure: bit 0 red, 1 green, 2 blue.
    trigger : bool
        Whether trigger output 2 fires with it.
    """

    exposure_us: int
    dark_us: int = 0
    colours: int = EVERY_COLOUR
    trigger: bool = True

    def as_bytes(self, position: int, waits: bool = False) -> bytes:
        """The 12 bytes of the table's line for the image's bit at `position`, which is also the line's number.

        Where it waits for a trigger, which is the display's next frame in video-pattern mode, the pattern stays until
        then; otherwise it is cleared after its exposure.
        """
        options = self.colours << 4 | (0x80 if waits else 1)  # one bit deep
        return (
            struct.pack("<H", position)
            + self.exposure_us.to_bytes(3, "little")
            + bytes([options])
            + self.dark_us.to_bytes(3, "little")
            + bytes([not self.trigger])  # 1 disables trigger output 2
            + struct.pack("<H", position << 11)
        )


def lines_of(fields: Sequence[Field], field_us: int, name: str) -> list[PatternLine]:
    """The pattern table of a frame of fields: each is exposed as long as its light lasts, and dark for the rest.

    The mirrors move within microseconds, so the light begins with the field, whatever its delay. Trigger output 2 fires
    with the first field alone, for a camera.

    Raises
    ------
    InputError
        For a laser without an LED enable.
    """
    lines = []
    for number, field in enumerate(fields):
        if field.lasers > EVERY_COLOUR:
            raise InputError(f"{name} has LED enables for lasers 0 to 2; field {number} asks for others.")
        lit = bool(field.lasers) and field.width_us >= SHORTEST_US
        exposure_us = field.width_us if lit else SHORTEST_US
        dark_us = field_us - exposure_us
        lines.append(PatternLine(exposure_us, dark_us, field.lasers if lit else 0, trigger=number == 0))
    return lines


class Dlpc900Control:
    """Commands of the controller: power, mode, status, errors.

    Parameters
    ----------
    link : UsbLink
    receiver : str
        "hdmi" or "displayport" for frames that come over that link, "off" for uploaded ones.
    exposure_us : int, µs
        Exposure of each pattern.
    colours : bool
        Whether the LED enables, and with them the lasers, follow the colours of the pattern table.

    Attributes
    ----------
    lines : tuple of PatternLine
        The pattern table that is shown; empty while patterns are stopped.
    """

    def __init__(
        self, link: UsbLink, receiver: str = "off", exposure_us: int = 16667, colours: bool = False
    ) -> None:
        if receiver not in RECEIVERS:
            raise InputError(f"there is no receiver '{receiver}'; use one of {', '.join(RECEIVERS)}.")
        if not SHORTEST_US <= exposure_us < 1 << 24:
            raise InputError(
                f"exposure {exposure_us} µs is out of range; give {SHORTEST_US} to {(1 << 24) - 1} µs."
            )
        self.name = link.name
        self._link = link
        self._receiver, self.exposure_us, self._colours = receiver, exposure_us, colours
        self.lines: tuple[PatternLine, ...] = ()
        self._defined: tuple[PatternLine, ...] = ()
        self._sequence = 0
        self._incomplete = False  # whether the last command broke off
        link.opened.append(self._set_up)
        link.open()

    def command(self, code: int, data: bytes = b"", read: bool = False) -> bytes:
        """Send one command and return the data of its answer; DeviceError with the controller's reason."""
        flags, answer = self._exchange(code, data, read)
        if flags & _FAILED:
            number = self._exchange(LAST_ERROR, b"", True)[1][:1]
            reason = ERRORS.get(number[0], f"error {number[0]}") if number else "it gives no reason"
            raise DeviceError(f"{self.name} refused command 0x{code:04x}: {reason}.")
        return answer

    def set_power(self, power: str) -> None:
        """Switch to one of POWERS."""
        if power not in POWERS:
            raise InputError(f"{self.name} has no power mode '{power}'; use one of {', '.join(POWERS)}.")
        self.command(POWER, bytes([POWERS.index(power)]))

    def set_mode(self, mode: str) -> None:
        """Go into one of MODES; patterns are stopped first, as the controller demands."""
        if mode not in MODES:
            raise InputError(f"{self.name} has no mode '{mode}'; use one of {', '.join(MODES)}.")
        self.stop()
        self.command(DISPLAY_MODE, bytes([MODES.index(mode)]))
        end = time.monotonic() + 2
        while self._byte(DISPLAY_MODE) != MODES.index(mode):
            if time.monotonic() > end:
                raise DeviceError(f"{self.name} does not go into mode {mode}; power it off and on.")
            time.sleep(0.05)

    def define(self, lines: Sequence[PatternLine]) -> None:
        """Fill the pattern table, while patterns are stopped: line k shows bit k of image 0; all in turn, without end.

        Of a picture on the display link, all are shown in turn once, from the begin of each of its frames on.
        """
        by_display = self._receiver != "off"
        for position, line in enumerate(lines):
            self.command(PATTERN_ENTRY, line.as_bytes(position, by_display and position == 0))
        self.command(PATTERN_LUT, struct.pack("<HI", len(lines), 0))
        self._defined = tuple(lines)

    def stop(self) -> None:
        """Stop the patterns: no LED enable is active."""
        self.lines = ()
        self.command(PATTERN, bytes([STOP]))

    def start(self) -> None:
        """Show the patterns of the table."""
        self.command(PATTERN, bytes([START]))
        self.lines = self._defined

    def check_running(self) -> None:
        """Raise DeviceError where it does not show its patterns."""
        if not self._byte(MAIN_STATUS) & RUNNING:
            self.lines = ()
            raise DeviceError(f"{self.name} does not run its patterns; show the frame again.")

    def status(self) -> dict[str, Any]:
        hardware, system, main = map(self._byte, (HARDWARE_STATUS, SYSTEM_STATUS, MAIN_STATUS))
        mode, power = self._byte(DISPLAY_MODE), self._byte(POWER)
        faults = [text for bit, text in HARDWARE.items() if hardware >> bit & 1]
        faults += [] if hardware & 1 else ["not initialised"]
        faults += [] if system & 1 else ["memory test failed"]
        return {
            "mode": MODES[mode] if mode < len(MODES) else f"mode {mode}",
            "power": POWERS[power] if power < len(POWERS) else f"power {power}",
            "parked": bool(main & 1),
            "running": bool(main & RUNNING),
            "frozen": bool(main & 4),
            "video_locked": bool(main & 8),
            "faults": faults,
            "firmware": self.command(FIRMWARE, read=True)[1:].split(b"\0")[0].decode("ascii", "replace"),
        }

    def close(self) -> None:
        if self._link.is_open:
            with suppress(DeviceError):  # an unplugged controller shows nothing
                self.stop()
                self.set_power("standby")
        self._link.close()

    def _set_up(self) -> None:
        self.set_power("normal")
        if self._colours:
            self.command(LED_ENABLES, bytes([BY_SEQUENCER]))
        if self._receiver == "off":
            self.set_mode("on-the-fly")
            return
        self.command(RECEIVER, bytes([RECEIVERS.index(self._receiver)]))
        self.command(SOURCE, bytes([0]))  # the receiver's parallel port, 24 bits
        self.set_mode("video")
        end = time.monotonic() + LOCK_S
        while not self._byte(MAIN_STATUS) & 8:
            if time.monotonic() > end:
                raise DeviceError(f"{self.name} detects no picture on {self._receiver}; check that cable.")
            time.sleep(0.05)
        self.set_mode("video-pattern")
        self.define([PatternLine(self.exposure_us, colours=0 if self._colours else EVERY_COLOUR)])
        self.start()

    def _byte(self, code: int) -> int:
        answer = self.command(code, read=True)
        if not answer:
            raise DeviceError(f"{self.name} answered command 0x{code:04x} with nothing; power it off and on.")
        return answer[0]

    def _exchange(self, code: int, data: bytes, read: bool) -> tuple[int, bytes]:
        """One command and its answer, (flags, data); answers to earlier commands that come late are dropped."""
        self._link.open()  # before the number is drawn: setting up has commands of its own
        if self._incomplete:
            self._recover()
        self._sequence = sequence = (self._sequence + 1) % 256
        flags = _REPLY | (_READ if read else 0)
        packets = struct.pack("<BBHH", flags, sequence, len(data) + 2, code) + data
        self._incomplete = True
        for at in range(0, len(packets), PACKET):
            self._link.write(OUT, packets[at : at + PACKET].ljust(PACKET, b"\0"))
        for _ in range(8):
            try:
                flags, answered, answer = parse_answer(self._link.read(IN, PACKET))
            except ValueError as error:
                raise DeviceError(f"{self.name}: {error}; check its cable.") from error
            if answered == sequence:
                self._incomplete = False
                return flags, answer
        raise DeviceError(f"{self.name} answers other commands than were sent; power it off and on.")

    def _recover(self) -> None:
        """After an incomplete command: send empty commands for the bytes that the controller may still wait for.

        They request no answer and do nothing. Not tried on hardware.
        """
        self._link.clear_halt(OUT)
        self._link.clear_halt(IN)
        for _ in range(LONGEST_DATA // PACKET + 2):
            self._link.write(OUT, bytes(PACKET))
        self._incomplete = False


def parse_answer(packet: bytes) -> tuple[int, int, bytes]:
    """Parse an answer.

    Parameters
    ----------
    packet : bytes

    Returns
    -------
    (int, int, bytes)
        Flags, sequence, data.

    Raises
    ------
    ValueError
        Where the packet is no answer.
    """
    if len(packet) < 4:
        raise ValueError(f"its answer has {len(packet)} bytes")
    flags, sequence, length = struct.unpack_from("<BBH", packet)
    if length > len(packet) - 4:
        raise ValueError(f"its answer claims {length} bytes and has {len(packet) - 4}")
    return flags, sequence, packet[4 : 4 + length]
