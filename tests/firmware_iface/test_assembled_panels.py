"""Each kind of panel that a configuration may name leads to its driver."""

from __future__ import annotations

import pytest

from firmware_iface.assembled import open_panel
from firmware_iface.errors import DeviceError, InputError


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"kind": "board"}, "panel board|libusb"),
        ({"kind": "dlpc900", "modulator": "p67"}, "phase light modulator|libusb"),
        ({"kind": "dlpc900", "display": 63}, "fb63 is not there"),
        ({"kind": "mirrored", "display": 63, "height": 600, "width": 800}, "fb63 is not there"),
    ],
)
def test_what_is_not_attached_is_named(table: dict, message: str) -> None:
    with pytest.raises(DeviceError, match=message):
        open_panel(table)


def test_kinds_and_modulators_that_are_not_known_are_refused() -> None:
    for table in ({"kind": "dlpc"}, {"kind": "dlpc900", "modulator": "p50"}, {"display": 64}):
        with pytest.raises(InputError):
            open_panel(table)
