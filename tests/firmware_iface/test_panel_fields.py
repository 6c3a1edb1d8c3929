"""Version 2 of the panel board's protocol: fields in turn, swapped as a whole, no light that is not a field's own."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.panel import open_board
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.virtual.usb import BoardModel, VirtualUsb
from firmware_iface.virtual.usb.usb_model import Stall

from .field_frames import FAST, SHAPE, crc, opened, picture
from .usb_transcript import Transcript


def crc_hex(data: bytes) -> str:
    return zlib.crc32(data).to_bytes(4, "little").hex(" ")


def test_the_bytes_of_choosing_version_2_and_showing_a_frame() -> None:
    """Against the protocol's page: IDENTITY, VERSION in and out, TIMING and back, MODE; frame, COMMIT; MODE dark."""
    bus = Transcript(BoardModel((2, 4)), longest=200)
    panel = open_board(backend=bus, timing=FAST, fields=2)
    assert isinstance(panel, FieldPanel)
    first, second = np.arange(8, dtype=np.uint8).reshape(2, 4), np.full((2, 4), 255, np.uint8)
    panel.show_fields([Field(first, 1, 500, 1000), Field(second, 4, 250, 800)])
    panel.close()
    asked = [line for line in bus.lines if not line.startswith("c0 04")]  # STATUS is polled, and holds time
    timing = struct.pack("<III", 2000, 500, 1000)
    assert asked[1:5] == [
        "c0 07 0000 < 01 00 02 00 08 03 00 00 " + crc_hex(bytes.fromhex("0100020008030000")),
        "40 07 0002 >",
        f"40 03 0000 > {timing.hex(' ')} {crc_hex(timing)}",
        f"c0 03 0000 < {timing.hex(' ')} {crc_hex(timing)}",
    ]
    assert asked[5] == "40 02 0001 >"
    records = [
        b"FLD\x00\x01\0\0\0" + struct.pack("<II", 500, 1000) + bytes.fromhex(crc_hex(first.tobytes())),
        b"FLD\x01\x04\0\0\0" + struct.pack("<II", 250, 800) + bytes.fromhex(crc_hex(second.tobytes())),
    ]
    sealed = b"".join(record + bytes.fromhex(crc_hex(record)) for record in records)
    header = b"HLPS\x01\0\0\0\x04\0\x02\0\x02\0\0\0" + bytes.fromhex(crc_hex(sealed))
    frame = header + bytes.fromhex(crc_hex(header)) + sealed + first.tobytes() + second.tobytes()
    assert asked[6] == f"01 > {frame.hex(' ')}" and len(frame) == 24 + 2 * 24 + 2 * 8
    commit = b"\x01\0\0\0" + header[16:20]
    assert asked[7:] == [f"40 05 0000 > {commit.hex(' ')} {crc_hex(commit)}", "40 02 0000 >"]


def test_fields_are_shown_in_turn_each_with_its_own_light() -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    frame = picture(0)
    assert panel.fields == 3 and panel.field_us == 2000
    assert model.outputs == 0, "nothing is lit without a frame"
    panel._fields.send_fields(frame)
    seen = []
    for _ in range(7):
        now[0] += 0.002
        seen.append((crc(model.gray), model.sequence.opened[-1]))
    patterns = [(crc(field.gray), (crc(field.gray), 1 << k)) for k, field in enumerate(frame)]
    assert seen == [*patterns, *patterns, patterns[0]]
    assert model.outputs == 0b111
    frame_s, since_s, shown = model.lit()
    assert (frame_s, since_s) == (pytest.approx(0.006), pytest.approx(0, abs=1e-9))
    assert [(p.outputs, round(p.begins_s, 6), p.width_s) for p in shown] == [
        (1, 0.0005, 0.001),
        (2, 0.0025, 0.001),
        (4, 0.0045, 0.001),
    ]
    panel.control.set_mode("test")  # type: ignore[attr-defined]
    assert model.outputs == 0


def test_a_frame_is_swapped_in_after_the_last_field_of_the_one_before() -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    first, second = picture(0), picture(1)
    panel._fields.send_fields(first)
    now[0] = 0.0021  # the first field of the first frame
    panel._fields.send_fields(second)
    order = []
    for _ in range(8):
        order.append(crc(model.gray))
        now[0] += 0.002
    assert order == [crc(f.gray) for f in (*first, *second, *second[:2])]
    assert [sequence for sequence, _ in model.shown] == [1, 1, 1, 2, 2, 2]


def test_the_model_knows_what_was_shown_before_the_frame_on_display() -> None:
    """For how many periods each pattern: what a slow panel still shows of it follows."""
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    first, second = picture(0), picture(1)
    panel._fields.send_fields(first)
    now[0] += 0.002
    assert model.shown_before() == []
    now[0] += 0.008  # it was shown once, and is shown in its second field again
    assert [(crc(gray), periods) for gray, periods in model.shown_before()] == [
        (crc(f.gray), 1) for f in first
    ]
    panel._fields.send_fields(second)
    now[0] += 0.004
    once = [(crc(f.gray), 1) for f in first]
    assert [(crc(gray), periods) for gray, periods in model.shown_before()] == 2 * once


def test_one_pattern_alone_is_lit_by_every_laser_and_for_no_more_of_the_time() -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    gray = picture(3)[0].gray
    panel.show(gray)
    np.testing.assert_array_equal(model.gray, gray)
    assert model.outputs == 0b111
    assert [p.outputs for p in model.lit()[2]] == [0b111, 0, 0]
    status = panel.status()
    assert status["fields"] == 3 and status["fields_kept_dark"] == 0 and status["kept_dark_because"] == ""


def test_a_dark_colour_has_no_light_and_the_others_keep_theirs() -> None:
    grays = np.zeros((3, *SHAPE), np.uint8)
    frame = colours_in_turn(grays, [2, 0, 1], [1.0, 0.0, 0.25], 4000)
    assert [(f.lasers, f.delay_us, f.width_us) for f in frame] == [
        (4, 1000, 2000),
        (0, 1000, 0),
        (2, 1000, 500),
    ]


def test_what_a_panel_cannot_show_says_why() -> None:
    panel = opened(BoardModel(SHAPE))
    good = picture(0)
    for frame, message in (
        ([], "1 to 3"),
        ([*good, good[0]], "1 to 3"),
        ([Field(np.zeros((5, 3), np.uint8), 1, 0, 1)], "3, 5"),
        ([Field(good[0].gray, 256, 0, 1)], "mask"),
        ([Field(good[0].gray, 1, 1500, 600)], "does not fit its 2000"),
        ([Field(good[0].gray, 1, -1, 600)], "does not fit"),
    ):
        with pytest.raises(InputError, match=message):
            panel.show_fields(frame)
    with pytest.raises(DeviceError, match="version 1 shows one colour"):
        opened(BoardModel(SHAPE, newest=1))
    with pytest.raises(InputError, match="8 fields at most, not 9"):
        opened(BoardModel(SHAPE), fields=9)


def test_a_frame_with_more_light_than_the_lasers_are_budgeted_for_is_refused() -> None:
    """Two fields of 1 ms for each laser in a frame of six fields of 2 ms, and no more, whatever a program asks for."""
    panel = opened(BoardModel(SHAPE), fields=6)
    panel.gated = GatedLight(duty=1 / 6, pulse_s=0.001, frame_s=0.012, pulses=2)
    grays = np.random.default_rng(0).integers(0, 256, (6, *SHAPE), dtype=np.uint8)
    usual = colours_in_turn(grays, (0, 1, 2), (1.0, 0.5, 1.0), FAST.period_us)
    panel.show_fields(usual)
    panel.show(grays[0])
    dark = Field(grays[0], 0, 0, 0)
    for frame, message in (
        (colours_in_turn(grays, (0, 1), (1.0, 0.5), FAST.period_us), "laser 0 would shine in 3 fields"),
        ([*usual[:5], Field(grays[5], 5, 500, 100)], "laser 0 would shine in 3 fields"),
        ([Field(grays[0], 2, 500, 1001), *5 * [dark]], "laser 1 .* up to 1001 µs"),
        (usual[:5], "5 fields of 2000 µs is shorter than the 0.012 s"),
        ([usual[0]], "shorter"),
    ):
        with pytest.raises(InputError, match=message):
            panel.show_fields(frame)
    panel.show_fields(6 * [dark])


def test_patterns_of_a_colour_are_fields_of_its_laser_alone() -> None:
    """Two colours with four patterns each fill the board's eight fields: c0 c1, four times."""
    model = BoardModel(SHAPE)
    panel = opened(model, fields=8)
    grays = np.random.default_rng(1).integers(0, 256, (8, *SHAPE), dtype=np.uint8)
    frame = colours_in_turn(grays, (2, 0), (1.0, 0.5), FAST.period_us)
    assert [(f.lasers, f.width_us) for f in frame] == [(4, 1000), (1, 500)] * 4
    panel.show_fields(frame)
    _, _, patterns = model.lit()
    assert [(p.outputs, crc(p.gray)) for p in patterns] == [
        (4 - 3 * (k % 2), crc(g)) for k, g in enumerate(grays)
    ]


def test_a_board_that_was_unplugged_speaks_version_2_again() -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    panel.show_fields(picture(0))
    assert model.outputs
    model.faults.arm("unplug")
    assert model.outputs == 0
    with pytest.raises(DeviceGoneError):
        panel.status()
    model.faults.clear()
    assert model.outputs == 0, "version 1, in the mode dark"
    panel.show_fields(picture(1))
    assert crc(model.gray) in {crc(f.gray) for f in picture(1)}
    assert panel.status()["fields"] == 3


def test_a_host_of_version_1_sees_no_version_2() -> None:
    model = BoardModel(SHAPE)
    panel = open_board(backend=VirtualUsb(model), timing=FAST)
    assert not isinstance(panel, FieldPanel)
    with pytest.raises(Stall):
        model.control(0xC0, 8, 0, 0, 16, lambda: True)
    panel.show(picture(0)[0].gray)
    assert "fields" not in panel.status()
