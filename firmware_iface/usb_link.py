"""One device on USB, for drivers: each transfer either succeeds or raises a DeviceError.

A device that was unplugged is looked for again at the next transfer, so a driver need not be opened again.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from firmware_iface.errors import DeviceError, DeviceGoneError

_UNPLUGGED = {errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN, errno.EIO, errno.EPROTO}
_TIMEOUT = errno.ETIMEDOUT
_REFUSED = errno.EPIPE

TO_HOST, TO_DEVICE = 0xC0, 0x40  # vendor requests to the device


class UsbLink:
    """A device by vendor and product ID, with interface 0 claimed while it is open; for one thread at a time.

    Parameters
    ----------
    vendor, product : int
        IDs.
    name : str
        Its name in messages.
    serial : str or None
        Serial number, where several are attached.
    backend : pyusb backend or None
        None is the system's libusb.
    timeout_s : float, s
        Longest wait for one transfer.

    Attributes
    ----------
    opened : list of callable
        Called each time the device was found, to set it up.
    """

    def __init__(
        self,
        vendor: int,
        product: int,
        name: str,
        *,
        serial: str | None = None,
        backend: Any = None,
        timeout_s: float = 0.5,
    ) -> None:
        self.vendor, self.product, self.name, self.serial = vendor, product, name, serial
        self.timeout_s = timeout_s
        self.opened: list[Callable[[], None]] = []
        self._backend = backend
        self._device: Any = None

    @property
    def is_open(self) -> bool:
        """Whether the device was there at the last transfer."""
        return self._device is not None

    def open(self) -> None:
        """Find and set up the device unless it is open.

        Raises
        ------
        DeviceGoneError
            Where it is not attached.
        """
        if self._device is not None:
            return
        self._device = self._find()
        try:
            self._do(lambda device: self._claim(device))
            for set_up in self.opened:
                set_up()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the device; the next transfer opens it again."""
        import usb.util

        device, self._device = self._device, None
        if device is not None:
            with suppress(Exception):  # an unplugged device cannot be released
                usb.util.dispose_resources(device)

    def control_in(self, request: int, length: int, value: int = 0) -> bytes:
        """The reply to a vendor request.

        Raises
        ------
        DeviceError
            Where the reply is not of this length.
        """
        reply = bytes(self._do(lambda d: d.ctrl_transfer(TO_HOST, request, value, 0, length, self._ms)))
        if len(reply) != length:
            raise DeviceError(
                f"{self.name} answered request 0x{request:02x} with {len(reply)} bytes instead of {length}; "
                "its firmware does not speak this protocol."
            )
        return reply

    def control_out(self, request: int, data: bytes = b"", value: int = 0) -> None:
        """Send a vendor request."""
        self._do(lambda d: d.ctrl_transfer(TO_DEVICE, request, value, 0, data, self._ms))

    def write(self, endpoint: int, data: bytes) -> None:
        """One transfer to an endpoint.

        Raises
        ------
        DeviceError
            Where the device did not take all bytes.
        """
        taken = self._do(lambda d: d.write(endpoint, data, self._ms))
        if taken != len(data):
            raise DeviceError(
                f"{self.name} took {taken} of {len(data)} bytes; send them again, and if that repeats, "
                "check the cable."
            )

    def read(self, endpoint: int, length: int) -> bytes:
        """One transfer of up to `length` bytes from an endpoint."""
        return bytes(self._do(lambda d: d.read(endpoint, length, self._ms)))

    def clear_halt(self, endpoint: int) -> None:
        """Let an endpoint that refused a transfer take the next."""
        self._do(lambda d: d.clear_halt(endpoint))

    @property
    def _ms(self) -> int:
        return max(1, round(self.timeout_s * 1000))

    def _find(self) -> Any:
        import usb.core

        search: dict[str, Any] = {"idVendor": self.vendor, "idProduct": self.product}
        if self.serial is not None:
            search["serial_number"] = self.serial
        try:
            device = usb.core.find(backend=self._backend, **search)
        except usb.core.NoBackendError as error:
            raise DeviceError(
                "libusb is not installed, so no USB device can be opened; install libusb-1.0."
            ) from error
        except usb.core.USBError as error:
            raise self._failure(error) from error
        if device is None:
            which = f" with serial number {self.serial}" if self.serial else ""
            raise DeviceGoneError(
                f"{self.name} ({self.vendor:04x}:{self.product:04x}){which} is not attached; "
                "check its cable and power."
            )
        return device

    def _claim(self, device: Any) -> None:
        import usb.util

        with suppress(NotImplementedError):  # not known outside Linux
            if device.is_kernel_driver_active(0):
                device.detach_kernel_driver(0)
        device.set_configuration()
        usb.util.claim_interface(device, 0)

    def _do(self, transfer: Callable[[Any], Any]) -> Any:
        import usb.core

        self.open()
        try:
            return transfer(self._device)
        except usb.core.USBError as error:
            failure = self._failure(error)
            if isinstance(failure, DeviceGoneError):
                self.close()
            raise failure from error

    def _failure(self, error: Any) -> DeviceError:
        if error.errno in _UNPLUGGED:
            return DeviceGoneError(f"{self.name} was unplugged or lost power; plug it in again.")
        if error.errno == _TIMEOUT:
            return DeviceError(
                f"{self.name} did not answer within {self.timeout_s:g} s; power it off and on."
            )
        if error.errno == _REFUSED:
            return DeviceError(f"{self.name} refused a transfer; its status says why.")
        if error.errno == errno.EACCES:
            return DeviceError(
                f"this user may not open {self.name}; add a udev rule for "
                f"{self.vendor:04x}:{self.product:04x}."
            )
        if error.errno == errno.EBUSY:
            return DeviceError(f"{self.name} is in use by another program; end that one.")
        return DeviceError(f"{self.name}: {error.strerror or error}; check its cable and power.")
