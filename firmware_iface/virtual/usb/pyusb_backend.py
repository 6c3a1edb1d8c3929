"""Modelled USB devices behind pyusb: `usb.core.find(backend=VirtualUsb(model))`.

It answers with the same codes as pyusb's libusb 1 backend, so a driver cannot tell the difference.
"""

from __future__ import annotations

import array
import errno
import struct
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, TypeVar

from firmware_iface.virtual.usb.usb_model import (
    CLEAR_FEATURE,
    GET_CONFIGURATION,
    SET_CONFIGURATION,
    SET_INTERFACE,
    Nak,
    NoDevice,
    Stall,
    UsbModel,
)

T = TypeVar("T")

_DEVICE = (
    "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor "
    "idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
)
_CONFIGURATION = (
    "bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue iConfiguration bmAttributes "
    "bMaxPower"
)
_INTERFACE = (
    "bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass "
    "bInterfaceSubClass bInterfaceProtocol iInterface"
)
_ENDPOINT = "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"

# libusb's code, errno and text for each way a transfer fails
_FAILURES: dict[type[Exception], tuple[int, int, str]] = {
    NoDevice: (-4, errno.ENODEV, "No such device (it may have been disconnected)"),
    Stall: (-9, errno.EPIPE, "Pipe error"),
    Nak: (-7, errno.ETIMEDOUT, "Operation timed out"),
}


class _Handle:
    def __init__(self, model: UsbModel) -> None:
        self.model, self.generation = model, model.generation


class VirtualUsb:
    """A pyusb backend on which the given models are plugged in; its methods are those of usb.backend.IBackend.

    Parameters
    ----------
    *models : UsbModel
        More may be added to the attribute `models`.
    """

    def __init__(self, *models: UsbModel) -> None:
        self.models = list(models)

    def enumerate_devices(self) -> Iterator[UsbModel]:
        return iter([model for model in self.models if model.present])

    def get_parent(self, model: UsbModel) -> None:
        return None

    def get_device_descriptor(self, model: UsbModel) -> SimpleNamespace:
        if not model.present:
            raise _failure(NoDevice())
        place = {"bus": 1, "address": 1 + self.models.index(model), "port_number": 1, "port_numbers": (1,)}
        return _fields(_DEVICE, "<BBHBBBBHHHBBBB", model.descriptor, speed=3, **place)

    def get_configuration_descriptor(self, model: UsbModel, index: int) -> SimpleNamespace:
        if index:
            raise IndexError("no such configuration")
        return _fields(_CONFIGURATION, "<BBHBBBBB", model.configuration)

    def get_interface_descriptor(
        self, model: UsbModel, interface: int, alternate: int, configuration: int
    ) -> SimpleNamespace:
        if interface or alternate:
            raise IndexError("no such interface")
        return _fields(_INTERFACE, "<9B", _parts(model, 4)[0])

    def get_endpoint_descriptor(
        self, model: UsbModel, endpoint: int, interface: int, alternate: int, configuration: int
    ) -> SimpleNamespace:
        raw = _parts(model, 5)[endpoint]  # raises IndexError past the last, as pyusb expects
        return _fields(_ENDPOINT, "<BBBBHB", raw, bRefresh=0, bSynchAddress=0)

    def open_device(self, model: UsbModel) -> _Handle:
        if not model.present:
            raise _failure(NoDevice())
        return _Handle(model)

    def close_device(self, handle: _Handle) -> None:
        pass

    def set_configuration(self, handle: _Handle, value: int) -> None:
        self.ctrl_transfer(handle, 0x00, SET_CONFIGURATION, value, 0, b"", 1000)

    def get_configuration(self, handle: _Handle) -> int:
        reply = array.array("B", bytes(1))
        self.ctrl_transfer(handle, 0x80, GET_CONFIGURATION, 0, 0, reply, 1000)
        return reply[0]

    def set_interface_altsetting(self, handle: _Handle, interface: int, alternate: int) -> None:
        self.ctrl_transfer(handle, 0x01, SET_INTERFACE, alternate, interface, b"", 1000)

    def claim_interface(self, handle: _Handle, interface: int) -> None:
        self._call(handle, 0, lambda give_up: None)

    def release_interface(self, handle: _Handle, interface: int) -> None:
        pass

    def bulk_write(
        self, handle: _Handle, endpoint: int, interface: int, data: array.array, timeout_ms: int
    ) -> int:
        return self._call(
            handle, timeout_ms, lambda give_up: handle.model.write(endpoint, bytes(data), give_up)
        )

    def bulk_read(
        self, handle: _Handle, endpoint: int, interface: int, buffer: array.array, timeout_ms: int
    ) -> int:
        reply = self._call(
            handle, timeout_ms, lambda give_up: handle.model.read(endpoint, len(buffer), give_up)
        )
        buffer[: len(reply)] = array.array("B", reply)
        return len(reply)

    intr_write, intr_read = bulk_write, bulk_read
    iso_write = iso_read = None  # pyusb looks them up; no model has an isochronous endpoint

    def ctrl_transfer(
        self,
        handle: _Handle,
        kind: int,
        request: int,
        value: int,
        index: int,
        data: Any,
        timeout_ms: int,
    ) -> int:
        asked = len(data) if kind & 0x80 else bytes(data)
        reply = self._call(
            handle,
            timeout_ms,
            lambda give_up: handle.model.control(kind, request, value, index, asked, give_up),
        )
        if not kind & 0x80:
            return len(data)
        data[: len(reply)] = array.array("B", reply)
        return len(reply)

    def clear_halt(self, handle: _Handle, endpoint: int) -> None:
        self.ctrl_transfer(handle, 0x02, CLEAR_FEATURE, 0, endpoint, b"", 1000)

    def reset_device(self, handle: _Handle) -> None:
        self._call(handle, 1000, lambda give_up: handle.model.reset())

    def is_kernel_driver_active(self, handle: _Handle, interface: int) -> bool:
        return False

    def detach_kernel_driver(self, handle: _Handle, interface: int) -> None:
        pass

    def attach_kernel_driver(self, handle: _Handle, interface: int) -> None:
        pass

    def _call(self, handle: _Handle, timeout_ms: int, act: Callable[[Callable[[], bool]], T]) -> T:
        end = time.monotonic() + timeout_ms / 1000 if timeout_ms else float("inf")
        try:
            if handle.model.present and handle.generation != handle.model.generation:
                raise NoDevice
            return act(lambda: time.monotonic() >= end)
        except (NoDevice, Stall, Nak) as cause:
            raise _failure(cause) from None


def _fields(names: str, layout: str, raw: bytes, **more: object) -> SimpleNamespace:
    values = dict(zip(names.split(), struct.unpack_from(layout, raw), strict=True))
    return SimpleNamespace(**values, extra_descriptors=[], **more)


def _parts(model: UsbModel, kind: int) -> list[bytes]:
    """Descriptors of one kind inside the configuration."""
    found, at, raw = [], 0, model.configuration
    while at < len(raw):
        if raw[at + 1] == kind:
            found.append(raw[at : at + raw[at]])
        at += raw[at]
    return found


def _failure(cause: Exception) -> Exception:
    import usb.core

    code, number, text = _FAILURES[type(cause)]
    error = usb.core.USBTimeoutError if isinstance(cause, Nak) else usb.core.USBError
    return error(text, code, number)
