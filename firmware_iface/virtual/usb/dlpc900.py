"""A model of a DLPC900 with a phase light modulator, after TI's programmer's guide (DLPU018): bytes in, bytes out.

It shares no code with the driver; third-party drivers upload into it as well (see the marked tests).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.usb.run_length_decoding import CommandError, decode_image
from firmware_iface.virtual.usb.usb_model import (
    INTERRUPT,
    Nak,
    Stall,
    UsbModel,
    configuration_descriptor,
    device_descriptor,
    endpoint_descriptor,
    interface_descriptor,
)

# vendor page, 64 bytes in and out
_HID_REPORT = bytes.fromhex("0600ff0901a101150026ff007508954009018102954009019102c0")
_HID = struct.pack("<BBHBBBH", 9, 0x21, 0x0111, 0, 1, 0x22, len(_HID_REPORT))

# height of each value of a mirror's four memory bits, as share of the highest
_HEIGHT = {3: 0.0, 2: 0.0126, 1: 0.0259, 7: 0.0495, 0: 0.071, 6: 0.0878, 5: 0.1382, 4: 0.2153}
_HEIGHT |= {11: 0.3274, 10: 0.361, 9: 0.4204, 8: 0.5046, 15: 0.5916, 14: 0.673, 13: 0.8254, 12: 1.0}


@dataclass(frozen=True)
class PatternEntry:
    """One line of the pattern table.

    `colours` are the LED enables that are active during its exposure; `waits`: for a trigger, which is the next frame
    of the video in video-pattern mode.
    """

    exposure_us: int
    bits: int
    image: int
    position: int
    colours: int = 0b111
    dark_us: int = 0
    trigger_2: bool = True
    waits: bool = False


class Dlpc900Model(UsbModel):
    """The controller and its mirrors.

    Parameters
    ----------
    memory_shape : (int, int)
        (rows, columns) of memory bits; four of them, 2 x 2, are one mirror.
    electrodes : (int, int, int, int)
        Which bit of a mirror's value lies top left, top right, bottom left, bottom right.
    mirrored : bool
        Whether the memory's columns run the other way.
    controllers : int
        2 where a second one holds the right half.
    faults : Faults or None
        See UsbModel.

    Attributes
    ----------
    video : callable or None
        Gives the picture on the display link, uint32 array [rows, columns] of 24 bits; None: no signal.
    gray : uint8 array [H, W]
    shape : (int, int)
        (H, W), mirrors.
    power, mode : int
    running : bool
    led_enables : int
        As command 0x1A07 sets it: bit 3 follows the pattern table, else bits 0 to 2 are red, green and blue.
    entries : dict of int to PatternEntry
    images : dict of (int, int) to uint32 array
        By image and controller, as loaded.
    video_frame_us : int, µs
        Of the video. A table that takes longer is aborted at the next frame, and status bit 6 says so.
    commands : int
        How many were received.
    """

    def __init__(
        self,
        memory_shape: tuple[int, int] = (1080, 1920),
        electrodes: tuple[int, int, int, int] = (2, 3, 0, 1),
        mirrored: bool = False,
        controllers: int = 1,
        faults: Faults | None = None,
    ) -> None:
        self.memory_shape = memory_shape
        self.shape = memory_shape[0] // 2, memory_shape[1] // 2
        self.video: Callable[[], NDArray[np.uint32]] | None = None
        self.video_frame_us = 16667
        self._electrodes, self._mirrored, self._controllers = electrodes, mirrored, controllers
        super().__init__(
            device_descriptor(0x0451, 0xC900),
            configuration_descriptor(
                interface_descriptor(2, 3),
                _HID,
                endpoint_descriptor(0x81, INTERRUPT, 64, 1),
                endpoint_descriptor(0x01, INTERRUPT, 64, 1),
            ),
            ("Texas Instruments", "DLPC900", "LCR"),
            faults,
        )
        self.on_reset()

    @property
    def gray(self) -> NDArray[np.uint8]:
        """The phase shown, as gray levels of 1/256 wave, uint8 [H, W]; flat while no pattern runs."""
        with self._lock:
            if not self.present or not self.running or self.power or not self.entries:
                return np.zeros(self.shape, np.uint8)
            bits = self.plane(0)
        if self._mirrored:
            bits = bits[:, ::-1]
        corners = (bits[::2, ::2], bits[::2, 1::2], bits[1::2, ::2], bits[1::2, 1::2])
        value = sum(c.astype(int) << bit for c, bit in zip(corners, self._electrodes, strict=True))
        heights = np.array([_HEIGHT[v] for v in range(16)])
        return np.rint(heights[value] * 15 / 16 * 256).astype(np.uint8)

    def plane(self, number: int) -> NDArray[np.uint8]:
        """The memory's bits of pattern `number` of the table, 0 or 1."""
        entry = self.entries[number]
        if self.mode == 2 and self.video is not None:
            image = self.video()
        else:
            image = np.hstack([self.images[entry.image, side] for side in range(self._controllers)])
        return (image >> entry.position & 1).astype(np.uint8)

    def leds(self, number: int) -> int:
        """LED enables, bit 0 red, 1 green, 2 blue, during the exposure of pattern `number` of the table."""
        with self._lock:
            if not self.present or not self.running or self.power:
                return 0
            return self.entries[number].colours if self.led_enables & 8 else self.led_enables & 7

    def on_reset(self) -> None:
        self.led_enables = 8
        self.power = self.mode = self.error = self.commands = 0
        self.running = False
        self.entries: dict[int, PatternEntry] = {}
        self.images: dict[tuple[int, int], NDArray[np.uint32]] = {}
        self._table = (0, 0)
        self._loading: dict[int, tuple[int, int, bytearray]] = {}
        self._answers: deque[bytes] = deque()
        self._partial = b""

    def on_control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        if (kind, request) == (0x21, 0x0A):  # SET_IDLE
            return b""
        raise Stall

    def on_read(self, endpoint: int, length: int) -> bytes:
        if not self._answers:
            raise Nak
        return self._answers.popleft()

    def on_write(self, endpoint: int, data: bytes) -> None:
        for at in range(0, len(data), 64):
            self._partial += data[at : at + 64].ljust(64, b"\0")
            flags, sequence, length = struct.unpack_from("<BBH", self._partial)
            if len(self._partial) >= 4 + length:
                command, self._partial = self._partial[4 : 4 + length], b""
                self._obey(flags, sequence, command)

    def _obey(self, flags: int, sequence: int, command: bytes) -> None:
        reply, failed = b"", 0
        self.commands += 1
        code = int.from_bytes(command[:2], "little")
        try:
            reply = self._answer(code) if flags & 0x80 else self._do(code, command[2:])
        except CommandError as error:
            self.error, failed = error.number, 0x20
        except (struct.error, IndexError):
            self.error, failed = 6, 0x20
        else:
            if code != 0x0100:
                self.error = 0
        if flags & 0x40:
            head = struct.pack("<BBH", flags & 0x80 | failed, sequence, len(reply))
            self._answers.append((head + reply).ljust(64, b"\0"))

    def _answer(self, code: int) -> bytes:
        main = (1 if self.power else 0) | (2 if self.running else 0) | (8 if self.video else 0)
        known = {
            0x0100: bytes([self.error]),
            0x0200: bytes([self.power]),
            0x0205: struct.pack("<4I", 0x06000000, 0, 0, 0),
            0x0206: b"\x02DLPC900 model\0",
            0x1100: bytes(6),
            0x1A07: bytes([self.led_enables]),
            0x1A0A: bytes([1 | (64 if self._aborted() else 0)]),
            0x1A0B: b"\x01",
            0x1A0C: bytes([main]),
            0x1A1B: bytes([self.mode]),
        }
        if code not in known:
            raise CommandError(3)
        return known[code]

    def _aborted(self) -> bool:
        """Whether the patterns last longer than a frame of the video that they are in."""
        shown = [self.entries[k] for k in range(self._table[0])] if self.running and self.mode == 2 else []
        return sum(entry.exposure_us + entry.dark_us for entry in shown) > self.video_frame_us

    def _do(self, code: int, data: bytes) -> bytes:
        match code:
            case 0x0200:
                if data[0] == 2:
                    self.on_reset()
                else:
                    self.power = _within(data[0], 1)
            case 0x0201 | 0x1100 | 0x1A00 | 0x1A01 | 0x1A03:
                pass
            case 0x1A07:
                self.led_enables = _within(data[0], 15)
            case 0x1A1B:
                if self.running:
                    raise CommandError(5)
                self.mode = _within(data[0], 3)
            case 0x1A24:
                self._run(_within(data[0], 2))
            case 0x1A31:
                self._table = struct.unpack_from("<HI", data)
            case 0x1A34:
                self._define(data)
            case 0x1A2A | 0x1A2C:
                side, (image, length) = int(code == 0x1A2C), struct.unpack_from("<HI", data)
                if self.mode != 3 or side >= self._controllers:
                    raise CommandError(5)
                self._loading[side] = (image, length, bytearray())
            case 0x1A2B | 0x1A2D:
                self._load(int(code == 0x1A2D), data)
            case _:
                raise CommandError(3)
        return b""

    def _define(self, data: bytes) -> None:
        index, low, high, options = struct.unpack_from("<HHBB", data)
        exposure_us, where = low | high << 16, struct.unpack_from("<H", data, 10)[0]
        if index >= 400:
            raise CommandError(15)
        if exposure_us < 105:
            raise CommandError(14)
        dark_us = int.from_bytes(data[6:9], "little")
        self.entries[index] = PatternEntry(
            exposure_us,
            (options >> 1 & 7) + 1,
            where & 0x7FF,
            where >> 11,
            options >> 4 & 7,
            dark_us,
            not data[9] & 1,
            bool(options >> 7),
        )

    def _load(self, side: int, data: bytes) -> None:
        if side not in self._loading:
            raise CommandError(5)
        image, length, got = self._loading[side]
        (size,) = struct.unpack_from("<H", data)
        if size > 504 or size > len(data) - 2:
            raise CommandError(6)
        got += data[2 : 2 + size]
        if len(got) >= length:
            del self._loading[side]
            rows, columns = self.memory_shape
            self.images[image, side] = decode_image(bytes(got), rows, columns // self._controllers)

    def _run(self, what: int) -> None:
        if what == 2:
            used = [self.entries.get(k) for k in range(self._table[0])]
            sides = range(self._controllers)
            loaded = all(e and all((e.image, side) in self.images for side in sides) for e in used)
            if (self.mode >= 2 and not (used and all(used))) or (self.mode == 3 and not loaded):
                raise CommandError(5)
        self.running = what == 2


def _within(value: int, highest: int) -> int:
    if value > highest:
        raise CommandError(6)
    return value
