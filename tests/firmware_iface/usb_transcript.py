"""Records what crosses a pyusb backend, as lines that a person can hold against a protocol's page."""

from __future__ import annotations

from typing import Any

from firmware_iface.virtual.usb import UsbModel, VirtualUsb


class Transcript(VirtualUsb):
    """A VirtualUsb that writes down vendor requests and endpoint transfers; long data by its first bytes."""

    def __init__(self, *models: UsbModel, longest: int = 24) -> None:
        super().__init__(*models)
        self.lines: list[str] = []
        self._longest = longest

    def ctrl_transfer(
        self, handle: Any, kind: int, request: int, value: int, index: int, data: Any, timeout_ms: int
    ) -> int:
        done = super().ctrl_transfer(handle, kind, request, value, index, data, timeout_ms)
        if kind & 0x60:
            arrow = "<" if kind & 0x80 else ">"
            self._note(f"{kind:02x} {request:02x} {value:04x} {arrow}", bytes(data)[:done])
        return done

    def bulk_write(self, handle: Any, endpoint: int, interface: int, data: Any, timeout_ms: int) -> int:
        done = super().bulk_write(handle, endpoint, interface, data, timeout_ms)
        self._note(f"{endpoint:02x} >", bytes(data)[:done])
        return done

    def bulk_read(self, handle: Any, endpoint: int, interface: int, buffer: Any, timeout_ms: int) -> int:
        done = super().bulk_read(handle, endpoint, interface, buffer, timeout_ms)
        self._note(f"{endpoint:02x} <", bytes(buffer)[:done])
        return done

    intr_write, intr_read = bulk_write, bulk_read

    def _note(self, what: str, data: bytes) -> None:
        rest = f" .. {len(data)}" if len(data) > self._longest else ""
        self.lines.append(f"{what} {data[: self._longest].hex(' ')}{rest}".rstrip())
