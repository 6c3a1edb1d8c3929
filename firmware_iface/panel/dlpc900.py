"""TI's phase light modulator on the DLPC900 controller (USB HID 0451:C900, DLPU018).

At video rate frames travel over the display link, as bits that `dlpc900_video` draws. They can be uploaded over USB,
too (`dlpc900_upload`), which is slow. The commands (`dlpc900_commands`) are the same.
"""

from __future__ import annotations

from typing import Any

from firmware_iface.errors import InputError
from firmware_iface.panel.dlpc900_commands import Dlpc900Control
from firmware_iface.panel.dlpc900_upload import MOST_PICTURES, PatternUpload
from firmware_iface.panel.dlpc900_video import MOST_FIELDS, VideoFields
from firmware_iface.panel.fields import FieldPanel
from firmware_iface.panel.mirrored_display import MirroredDisplay
from firmware_iface.panel.panel import Panel
from firmware_iface.panel.phase_light_modulator import P47, Modulator
from firmware_iface.usb_link import UsbLink

VENDOR, PRODUCT = 0x0451, 0xC900


def open_dlpc900(
    display: int | None = None,
    *,
    modulator: Modulator = P47,
    receiver: str = "displayport",
    serial: str | None = None,
    backend: Any = None,
    exposure_us: int = 16000,
    timeout_s: float = 1.0,
    fields: int = 1,
) -> Panel:
    """Open a phase light modulator.

    Parameters
    ----------
    display : int or None
        N of /dev/fbN whose screen it is; None uploads frames over USB, slowly.
    modulator : Modulator
        P47 or P67.
    receiver : str
        Connection of that screen, "hdmi" or "displayport".
    serial : str or None
        Serial number, where several are attached.
    backend : pyusb backend or None
        None is the system's libusb.
    exposure_us : int, µs
        Exposure of a pattern, less than a frame of the display.
    timeout_s : float, s
        Longest wait for one transfer.
    fields : int
        Fields that a frame may need, for colours in turn. More than 1 gives a FieldPanel whose LED enables (laser 0 at
        red, 1 at green, 2 at blue) follow the pattern table's colours; `exposure_us` is then the time of a field. Over
        the display link all fields of a frame last as long as a frame of the display; where that is shorter, the
        controller aborts its sequence, which its status says.

    Returns
    -------
    Panel

    Raises
    ------
    InputError
        For a setting out of range.
    DeviceGoneError
        Where it is not attached.
    DeviceError
        Where it does not answer as it should.
    """
    most = MOST_PICTURES if display is None else MOST_FIELDS
    if fields > most:
        raise InputError(f"a frame of {fields} fields does not fit; ask for {most} at most.")
    screen = None if display is None else MirroredDisplay(display, modulator.memory_shape)
    link = UsbLink(
        VENDOR, PRODUCT, "the phase light modulator", serial=serial, backend=backend, timeout_s=timeout_s
    )
    try:
        control = Dlpc900Control(link, receiver if screen else "off", exposure_us, colours=fields > 1)
    except BaseException:
        if screen:
            screen.close()
        raise
    frames = VideoFields(control, screen, modulator) if screen else PatternUpload(control, modulator)
    return FieldPanel(control, frames, fields) if fields > 1 else Panel(control, frames)
