"""Linux's usbfs for the real libusb, in user space: umockdev's preload library sends a program's ioctls here.

The preload library (Debian packages umockdev and libusb-1.0-0) sends every call on an opened device node to a
Unix socket as three 64-bit words, command and two arguments; memory of the program is read and written by
request. So the kernel's side can be plain Python over a UsbModel, and no root is needed.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from firmware_iface.virtual.usb import UsbModel
from firmware_iface.virtual.usb.usb_model import Nak, NoDevice, Stall

_WORDS = struct.Struct("<QQQ")
_IOCTL, _DONE, _READ_MEMORY, _WRITE_MEMORY = 1, 3, 5, 6
_URB = struct.Struct("<BB2xiI4xQii")  # type, endpoint, status, flags, buffer, length, done
_CONTROL = 2
_MEANINGS = {Stall: errno.EPIPE, NoDevice: errno.ENODEV, Nak: errno.ENOENT}


class _IoctlError(Exception):
    def __init__(self, number: int) -> None:
        self.number = number


@dataclass
class _OpenFile:
    """One file descriptor of the program."""

    connection: socket.socket
    generation: int
    cancelled: set[int] = field(default_factory=set)
    running: dict[int, int] = field(default_factory=dict)  # URB to the buffer it fills
    finished: deque[tuple[int, int, int, bytes]] = field(default_factory=deque)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def receive(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.connection.recv(size - len(data))
            if not part:
                raise EOFError
            data += part
        return data

    def memory(self, address: int, size: int) -> bytes:
        self.connection.sendall(_WORDS.pack(_READ_MEMORY, address, size))
        return self.receive(size)

    def put(self, address: int, data: bytes) -> None:
        self.connection.sendall(_WORDS.pack(_WRITE_MEMORY, address, len(data)) + data)


class UsbFs:
    """A tree for UMOCKDEV_DIR with one device on bus 1, and the server behind its node."""

    def __init__(self, root: Path, model: UsbModel) -> None:
        self.root, self.model = root, model
        self._events = 0
        self._node = root / "dev/bus/usb/001/002"
        self._sys = root / "sys/devices/pci0000:00/usb1/1-1"
        self._link = root / "sys/bus/usb/devices/1-1"
        for folder in ("dev/.node", "sys/class", "sys/bus/usb/devices", "ioctl/dev/bus/usb/001"):
            (root / folder).mkdir(parents=True)
        self._node.parent.mkdir(parents=True)
        (root / "dev/.node/bus_usb_001_002").symlink_to("189:1")
        self.plug()
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(root / "ioctl/dev/bus/usb/001/002"))
        self._server.listen(4)
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def environment(self) -> dict[str, str]:
        """What a program needs to see the device."""
        preload = {"LD_PRELOAD": "libumockdev-preload.so.0", "UMOCKDEV_DIR": str(self.root)}
        return os.environ | preload

    def plug(self) -> None:
        """Files as the kernel makes them for a device."""
        model = self.model
        vendor, product, release = struct.unpack_from("<HHH", model.descriptor, 8)
        raw = model.descriptor + model.configuration
        uevent = (
            "MAJOR=189\nMINOR=1\nDEVNAME=bus/usb/001/002\nDEVTYPE=usb_device\n"
            f"PRODUCT={vendor:x}/{product:x}/{release:x}\nTYPE=0/0/0\nBUSNUM=001\nDEVNUM=002\n"
        )
        texts = {
            "busnum": "1",
            "devnum": "2",
            "speed": "480",
            "bConfigurationValue": "1",
            "idVendor": f"{vendor:04x}",
            "idProduct": f"{product:04x}",
            "bDeviceClass": "00",
            "bNumConfigurations": "1",
            "bcdDevice": f"{release:04x}",
            "dev": "189:1",
            "devpath": "1",
        }
        self._sys.mkdir(parents=True)
        for name, text in texts.items():
            (self._sys / name).write_text(text + "\n", encoding="ascii")
        (self._sys / "uevent").write_text(uevent, encoding="ascii")
        (self._sys / "descriptors").write_bytes(raw)
        (self._sys / "subsystem").symlink_to("../../../../bus/usb")
        self._link.symlink_to("../../../devices/pci0000:00/usb1/1-1")
        self._node.write_bytes(raw)

        self._announce("add")

    def unplug(self) -> None:
        """Take these files away."""
        self._announce("remove")
        self._link.unlink()
        shutil.rmtree(self._sys)
        self._node.unlink()

    def _announce(self, action: str) -> None:
        """What udev would tell every program that listens: libusb keeps its list of devices by that."""
        self._events += 1
        body = {
            "ACTION": action,
            "DEVPATH": str(self._sys).removeprefix(str(self.root / "sys")),
            "SUBSYSTEM": "usb",
            "DEVNAME": "/dev/bus/usb/001/002",
            "DEVTYPE": "usb_device",
            "SEQNUM": self._events,
            "MAJOR": 189,
            "MINOR": 1,
            "BUSNUM": "001",
            "DEVNUM": "002",
        }
        text = b"".join(f"{name}={value}\0".encode() for name, value in body.items())
        head = b"libudev\0" + struct.pack(">I", 0xFEEDCAFE) + struct.pack("<III", 40, 40, len(text))
        head += struct.pack(">IIII", _murmur(b"usb"), _murmur(b"usb_device"), 0, 0)
        for path in self.root.glob("event*"):
            with socket.socket(socket.AF_UNIX, socket.SOCK_RAW) as listener, suppress(OSError):
                listener.connect(str(path))
                listener.send(head + text)

    def _accept(self) -> None:
        while True:
            connection, _ = self._server.accept()
            opened = _OpenFile(connection, self.model.generation if self.model.present else -1)
            threading.Thread(target=self._serve, args=(opened,), daemon=True).start()

    def _serve(self, opened: _OpenFile) -> None:
        try:
            while True:
                command, request, argument = _WORDS.unpack(opened.receive(_WORDS.size))
                result, number = 0, 0
                if command == _IOCTL:
                    try:
                        result = self._ioctl(opened, request & 0xFFFFFFFF, argument)
                    except _IoctlError as failure:
                        result, number = -1, failure.number
                opened.connection.sendall(_WORDS.pack(_DONE, result & (1 << 64) - 1, number))
        except (EOFError, OSError):
            opened.cancelled.update(opened.running)

    def _ioctl(self, opened: _OpenFile, request: int, argument: int) -> int:
        model = self.model
        unplugged = not model.present or model.generation != opened.generation
        match request & 0xFF:
            case 10:
                if unplugged:
                    raise _IoctlError(errno.ENODEV)
                return self._submit(opened, argument)
            case 11:  # discard
                with opened.lock:
                    if argument not in opened.running:
                        raise _IoctlError(errno.EINVAL)
                    opened.cancelled.add(argument)
            case 12 | 13:  # reap, at once
                return self._reap(opened, argument, unplugged)
            case _ if unplugged:
                raise _IoctlError(errno.ENODEV)
            case (
                26
            ):  # capabilities: zero packets, continued bulk, no packet limit, scatter-gather, reap after loss
                opened.put(argument, struct.pack("<I", 0x1F))
            case 5:
                (value,) = struct.unpack("<i", opened.memory(argument, 4))
                self._standard(0x00, 9, max(value, 0), 0)
            case 21:
                (endpoint,) = struct.unpack("<I", opened.memory(argument, 4))
                self._standard(0x02, 1, 0, endpoint)
            case 20:
                model.reset()
            case 8 | 18:  # no kernel driver has it
                raise _IoctlError(errno.ENODATA)
            case 31:
                return 3  # high speed
            case 4 | 15 | 16:  # alternate setting, claim, release
                pass
            case _:
                raise _IoctlError(errno.ENOTTY)
        return 0

    def _standard(self, kind: int, request: int, value: int, index: int) -> None:
        self.model.control(kind, request, value, index, b"", lambda: True)

    def _submit(self, opened: _OpenFile, urb: int) -> int:
        kind, endpoint, _, _, buffer, length, _ = _URB.unpack(opened.memory(urb, _URB.size))
        data = opened.memory(buffer, length) if kind == _CONTROL or not endpoint & 0x80 else b""
        with opened.lock:
            opened.running[urb] = buffer + (8 if kind == _CONTROL else 0)

        def give_up() -> bool:
            return urb in opened.cancelled

        def control() -> tuple[int, bytes]:
            setup = struct.unpack_from("<BBHHH", data)
            asked = setup[4] if setup[0] & 0x80 else data[8:]
            reply = self.model.control(*setup[:4], asked, give_up)
            return (len(reply) if setup[0] & 0x80 else setup[4]), reply

        def read() -> tuple[int, bytes]:
            reply = self.model.read(endpoint, length, give_up)
            return len(reply), reply

        def write() -> tuple[int, bytes]:
            return self.model.write(endpoint, data, give_up), b""

        act = control if kind == _CONTROL else read if endpoint & 0x80 else write
        threading.Thread(target=self._complete, args=(opened, urb, act), daemon=True).start()
        return 0

    def _complete(self, opened: _OpenFile, urb: int, act: Callable[[], tuple[int, bytes]]) -> None:
        status, done, reply = 0, 0, b""
        try:
            done, reply = act()
        except (Stall, NoDevice, Nak) as cause:
            status = -_MEANINGS[type(cause)]
        with opened.lock:
            opened.finished.append((urb, status, done, reply))

    def _reap(self, opened: _OpenFile, argument: int, unplugged: bool) -> int:
        with opened.lock:
            if not opened.finished:
                time.sleep(0.0002)  # libusb polls without a pause here
                raise _IoctlError(errno.ENODEV if unplugged and not opened.running else errno.EAGAIN)
            urb, status, done, reply = opened.finished.popleft()
            buffer = opened.running.pop(urb)
            opened.cancelled.discard(urb)
        if reply:
            opened.put(buffer, reply)
        opened.put(urb + 4, struct.pack("<i", status))
        opened.put(urb + 28, struct.pack("<i", done))
        opened.put(argument, struct.pack("<Q", urb))
        return 0


def _murmur(data: bytes) -> int:
    """MurmurHash2 with seed 0, by which udev's listeners filter."""
    factor, mask = 0x5BD1E995, 0xFFFFFFFF
    state, whole = len(data), len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        word = word * factor & mask
        word = (word ^ word >> 24) * factor & mask
        state = state * factor & mask ^ word
    if data[whole:]:
        state = (state ^ int.from_bytes(data[whole:], "little")) * factor & mask
    state = (state ^ state >> 13) * factor & mask
    return state ^ state >> 15
