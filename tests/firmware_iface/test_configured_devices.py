"""Each kind of panel that a configuration may name leads to its driver."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.configured_devices import check_tables, gated_light, open_camera, open_panel
from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.fields import Field


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


LAB = """
class Screen:
    shape = (3, 5)
    def show(self, gray): self.gray = gray
    def status(self): return {}
    def close(self): pass

class Eye:
    shape, bit_depth, exposure_ms = (2, 2), 10, 1.0
    def capture(self): return None
    def close(self): pass

class Stuck(Eye):
    def __setattr__(self, name, value): raise OSError("the port is busy")

def stuck(): return Stuck()
def screen(): return Screen()
def eye(): return Eye()
def number(): return 3
def broken(): raise OSError("no such port")
nothing = None
"""


def test_a_function_of_the_labs_own_opens_its_panel_and_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found in the current folder; what cannot be used is said, before anything is shown."""
    (tmp_path / "a_lab.py").write_text(LAB)
    monkeypatch.chdir(tmp_path)
    assert open_panel({"kind": "a_lab:screen"}).shape == (3, 5)
    assert open_camera({"kind": "a_lab:eye", "exposure_ms": 4.0}).exposure_ms == 4.0
    with pytest.raises(DeviceError, match="a_lab:stuck cannot be opened: the port is busy"):
        open_camera({"kind": "a_lab:stuck"})
    with pytest.raises(InputError, match="Screen, which has no 'bit_depth'"):
        open_camera({"kind": "a_lab:screen"})
    check_tables({"panel": {"kind": "a_lab:screen"}, "lasers": {"bus": "virtual:x", "power": {"green": 0.1}}})
    for kind, error, message in (
        ("a_lab:number", InputError, "returned int, which has no 'shape'"),
        ("a_lab:broken", DeviceError, "cannot be opened: no such port"),
        ("a_lab:nothing", InputError, "is no function"),
        ("a_lab:missing", InputError, "cannot be imported"),
        ("no_such_lab:panel", InputError, "cannot be imported"),
        ("bord", InputError, "did you mean 'board'"),
        ("a_lab:", InputError, "MODULE:FUNCTION"),
    ):
        with pytest.raises(error, match=message):
            open_panel({"kind": kind})


def test_a_panel_of_the_labs_own_shows_as_many_fields_as_are_budgeted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the lasers' power is budgeted for is what the panel does, and its frames are held to it."""
    (tmp_path / "field_lab.py").write_text(
        """
from firmware_iface.panel import FieldPanel

closed = []

class Frames:
    shape, most_fields, every_laser, field_us = (3, 5), 8, 7, 5556
    def send_fields(self, fields): return len(fields)
    def wait(self, sequence): pass
    def close(self): closed.append(self)

class Plain(Frames):
    def show(self, gray): pass
    def status(self): return {}

def three(): return FieldPanel(Frames(), Frames(), 3)
def one(): return Plain()
"""
    )
    monkeypatch.chdir(tmp_path)
    table = {"kind": "field_lab:three", "fields": 3, "refresh_hz": 180.0}
    budget = gated_light(table, 1)
    assert budget is not None and budget.frame_s == pytest.approx(3 * 5556e-6)
    panel = open_panel(table, budget)
    gray = np.zeros((3, 5), np.uint8)
    panel.show_fields([Field(gray, 1 << k, 1000, 2778) for k in range(3)])
    with pytest.raises(InputError, match="up to 2900 µs in each, and is budgeted for 1 of 2778"):
        panel.show_fields([Field(gray, 1 << k, 1000, 2900) for k in range(3)])
    for wrong, found in (
        ({"fields": 6}, "6 fields of 5556 µs, and what 'field_lab:three' opens shows 3 of 5556"),
        ({"refresh_hz": 60.0}, "3 fields of 16667 µs, .* shows 3 of 5556"),
        ({"kind": "field_lab:one"}, "shows one"),
    ):
        with pytest.raises(InputError, match=found):
            open_panel(table | wrong)
    assert len(sys.modules["field_lab"].closed) == 5, "none stays open"
