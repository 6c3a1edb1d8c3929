"""Emulated adapters behind the real smbus2: its ioctls, decoded from its own C structures.

`attach` makes an ordinary file in place of /dev/i2c-N. smbus2 opens and closes it as it would the device; only
`ioctl` on such a file is handled here instead of in the kernel.
"""

from __future__ import annotations

import ctypes
import errno
import os
import tempfile
from typing import IO, Any

from firmware_iface.virtual.i2c.bus import Message, MessageBus, failure
from firmware_iface.virtual.i2c.packet_error_code import pec

# I2C | SMBUS_EMUL (which has PEC), as <linux/i2c.h> numbers them
FUNCTIONS = 0x00000001 | 0x0EFF0008

_nodes: dict[tuple[int, int], MessageBus] = {}  # (device, inode) of an open node: its bus
_opened: dict[tuple[int, int, int], list[int]] = {}  # (fd, device, inode): [address, PEC on]
_files: dict[
    str, IO[bytes]
] = {}  # path of a node: its file, which no folder lists, so that none is left behind


def attach(bus: MessageBus) -> str:
    """A path that smbus2.SMBus can open in this process, with `bus` behind it. `detach` removes it."""
    _patch()
    file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 `detach` closes it
    path = f"/dev/fd/{file.fileno()}"
    _files[path] = file
    _nodes[_inode(file)] = bus
    return path


def detach(path: str) -> None:
    """Remove a node; transfers on files that are still open then fail with ENODEV."""
    with _files.pop(path) as file:
        _nodes[_inode(file)] = _MissingBus()


def _inode(file: IO[bytes]) -> tuple[int, int]:
    status = os.fstat(file.fileno())
    return status.st_dev, status.st_ino


class _MissingBus:
    def transfer(self, messages: object) -> list[bytes]:
        raise failure(errno.ENODEV)


def _patch() -> None:
    import importlib

    library: Any = importlib.import_module("smbus2.smbus2")
    if getattr(library.ioctl, "emulates", False):
        return
    real = library.ioctl

    def ioctl(fd: int, request: int, argument: Any = 0, *more: Any) -> Any:
        status = os.fstat(fd)
        bus = _nodes.get((status.st_dev, status.st_ino))
        if bus is None:
            return real(fd, request, argument, *more)
        state = _opened.setdefault((fd, status.st_dev, status.st_ino), [0, 0])
        return _ioctl(library, bus, state, request, argument)

    ioctl.emulates = True  # type: ignore[attr-defined]
    library.ioctl = ioctl


def _ioctl(library: Any, bus: MessageBus, state: list[int], request: int, argument: Any) -> int:
    if request in (library.I2C_SLAVE, library.I2C_SLAVE_FORCE):
        state[0] = int(argument)
    elif request == library.I2C_PEC:
        state[1] = int(argument)
    elif request == library.I2C_FUNCS:
        state[:] = [0, 0]  # smbus2 asks this once, on opening
        argument.value = FUNCTIONS
    elif request == library.I2C_RDWR:
        messages = [argument.msgs[i] for i in range(argument.nmsgs)]
        replies = iter(bus.transfer([_message(m) for m in messages]))
        for m in messages:
            if m.flags & 1:
                ctypes.memmove(m.buf, next(replies), m.len)
        return len(messages)
    elif request == library.I2C_SMBUS:
        union = argument.data.contents.block
        data = _smbus(
            bus, state[0], bool(state[1]), argument.read_write, argument.command, argument.size, union
        )
        union[0 : len(data)] = list(data)
    else:
        raise failure(errno.ENOTTY)
    return 0


def _message(m: Any) -> Message:
    if m.flags & 1:
        return Message(m.addr, None, m.len)
    return Message(m.addr, ctypes.string_at(m.buf, m.len))


QUICK, BYTE, BYTE_DATA, WORD_DATA, PROC_CALL, BLOCK_DATA = range(6)
I2C_BLOCK_DATA = 8


def _smbus(
    bus: MessageBus, address: int, with_pec: bool, read: int, command: int, size: int, union: Any
) -> bytes:
    """One SMBus call as the kernel composes it from I2C messages; the bytes for the caller's union."""
    start, given = bytes([command]), bytes(union)
    if size == QUICK:
        bus.transfer([Message(address, None, 0) if read else Message(address, b"")])
        return b""
    if size == BYTE and not read:
        _send(bus, address, start, with_pec)
        return b""
    fixed = {BYTE: 1, BYTE_DATA: 1, WORD_DATA: 2, PROC_CALL: 2}
    if size in fixed:
        if read or size == PROC_CALL:
            written = b"" if size == BYTE else start + (given[:2] if size == PROC_CALL else b"")
            return _receive(bus, address, written, fixed[size], with_pec)
        _send(bus, address, start + given[: fixed[size]], with_pec)
        return b""
    if size in (BLOCK_DATA, I2C_BLOCK_DATA):
        count = given[0]
        if not (read and size == BLOCK_DATA) and not 1 <= count <= 32:
            raise failure(errno.EINVAL)
        if size == I2C_BLOCK_DATA:  # plain I2C: the kernel adds no PEC
            if read:
                return bytes([count]) + _receive(bus, address, start, count, False)
            _send(bus, address, start + given[1 : 1 + count], False)
            return b""
        if not read:
            _send(bus, address, start + given[: 1 + count], with_pec)
            return b""
    raise failure(errno.EOPNOTSUPP)


def _send(bus: MessageBus, address: int, data: bytes, with_pec: bool) -> None:
    check = bytes([pec(bytes([address << 1]) + data)]) if with_pec else b""
    bus.transfer([Message(address, data + check)])


def _receive(bus: MessageBus, address: int, written: bytes, length: int, with_pec: bool) -> bytes:
    messages = [Message(address, written)] if written else []
    messages.append(Message(address, None, length + with_pec))
    reply = bus.transfer(messages)[0]
    if with_pec:
        sent = bytes([address << 1]) + written if written else b""
        if pec(sent + bytes([address << 1 | 1]) + reply[:length]) != reply[length]:
            raise failure(errno.EBADMSG)
    return reply[:length]
