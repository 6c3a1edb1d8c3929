"""Version 2 of the panel board's protocol: fields in turn, swapped as a whole, no light that is not a field's own."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.panel import open_board
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.panel.panel_board import BoardControl
from firmware_iface.panel.panel_board_messages import (
    Timing,
    fields_bytes,
    frame_bytes,
    parse_fields,
    parse_status,
    parse_versions,
)
from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.usb import BoardModel, VirtualUsb
from firmware_iface.virtual.usb.field_sequence import FieldSequence
from firmware_iface.virtual.usb.usb_model import Nak, NoDevice, Stall

from .usb_transcript import Transcript

SHAPE = (3, 5)
FAST = Timing(period_us=2000, light_delay_us=500, light_width_us=1000)
LINK_FAULTS = ("torn_field", "swapped_gate", "missing_field")


def opened(model: BoardModel, fields: int = 3, timeout_s: float = 0.05) -> FieldPanel:
    panel = open_board(backend=VirtualUsb(model), timing=FAST, timeout_s=timeout_s, fields=fields)
    assert isinstance(panel, FieldPanel)
    return panel


def picture(seed: int, fields: int = 3, shape: tuple[int, int] = SHAPE) -> list[Field]:
    grays = np.random.default_rng(seed).integers(0, 256, (fields, *shape), dtype=np.uint8)
    return colours_in_turn(grays, range(fields), [1.0] * fields, FAST.period_us)


def crc(gray: NDArray[np.uint8]) -> int:
    return zlib.crc32(gray.tobytes())


def crc_hex(data: bytes) -> str:
    return zlib.crc32(data).to_bytes(4, "little").hex(" ")


def allowed(*frames: Sequence[Field]) -> set[tuple[int, int]]:
    """(pattern, light) of every field of these frames, and darkness on anything."""
    return {(crc(field.gray), field.lasers) for frame in frames for field in frame}


def lit(model: BoardModel) -> set[tuple[int, int]]:
    """(pattern, light) of every field that the panel has shown with light."""
    return {pair for pair in model.sequence.opened if pair[1]}


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


def wrong_frames() -> dict[str, tuple[bytes, int]]:
    """Frames with one thing wrong, and the refusal that each must get."""
    good = picture(5)
    data, _ = fields_bytes(good, 9)

    def changed(at: int, bits: int = 1) -> bytes:
        return data[:at] + bytes([data[at] ^ bits]) + data[at + 1 :]

    def resealed(records: list[bytes], pixels: bytes) -> bytes:
        body = b"".join(records)
        head = data[:12] + bytes([len(records), 0, 0, 0]) + zlib.crc32(body).to_bytes(4, "little")
        return head + zlib.crc32(head).to_bytes(4, "little") + body + pixels

    def record(k: int, **with_: int) -> bytes:
        magic, number, outputs, spare, delay, width, pixels = struct.unpack(
            "<3sBB3sIII", data[24 + 24 * k : 44 + 24 * k]
        )
        values = {"number": number, "outputs": outputs, "delay": delay, "width": width} | with_
        body = struct.pack(
            "<3sBB3sIII",
            magic,
            values["number"],
            values["outputs"],
            spare,
            values["delay"],
            values["width"],
            pixels,
        )
        return body + zlib.crc32(body).to_bytes(4, "little")

    begin = 24 + 3 * 24
    pixels = data[begin:]
    missing = resealed([record(0), record(1), record(2)], pixels[:-15])
    older, _ = fields_bytes(picture(4), 9)
    return {
        "a field is missing": (missing, 4),
        "a record is missing": (resealed([record(0), record(2)], pixels), 8),
        "a record comes twice": (resealed([record(0), record(0), record(2)], pixels), 8),
        "fields out of order": (resealed([record(1), record(0), record(2)], pixels), 8),
        "the gates of two fields exchanged": (changed(24 + 4, 3), 3),
        "a pixel of the last field": (changed(len(data) - 1), 5),
        "a field of another picture": (data[: begin + 15] + older[begin + 15 : begin + 30] + pixels[30:], 5),
        "a torn field": (data[: begin + 20] + older[begin + 20 : begin + 30] + pixels[30:], 5),
        "a mask of no laser": (resealed([record(0, outputs=8), record(1), record(2)], pixels), 7),
        "light that outlasts its field": (resealed([record(0, width=1800), record(1), record(2)], pixels), 7),
        "no fields": (resealed([], b""), 7),
        "a byte too many": (data + b"\0", 4),
        "a header's bit": (changed(5), 3),
        "a frame of version 1": (frame_bytes(good[0].gray, 9)[0], 3),
    }


@pytest.mark.parametrize("name", list(wrong_frames()))
def test_a_wrong_frame_is_refused_whole_and_the_old_one_stays(name: str) -> None:
    data, refusal = wrong_frames()[name]
    model = BoardModel(SHAPE)
    panel = opened(model)
    old = picture(0)
    panel.show_fields(old)
    with pytest.raises(Stall):
        model.write(1, data, lambda: True)
    reply = model.control(0xC0, 4, 0, 0, 40, lambda: True)
    assert reply[1] == 0 and reply[2] == refusal, "the back buffer is empty, and the reason is given"
    parse_status(reply, version=2)
    for crc_given in (zlib.crc32(data[24:96]), int.from_bytes(data[16:20], "little")):
        body = struct.pack("<II", 9, crc_given)
        with pytest.raises(Stall):
            model.control(0x40, 5, 0, 0, body + zlib.crc32(body).to_bytes(4, "little"), lambda: True)
    panel.control.recover()  # type: ignore[attr-defined]
    panel.show_fields(picture(1))
    assert {sequence for sequence, _ in model.shown} == {1, 2}
    assert lit(model) <= allowed(old, picture(1))


@pytest.mark.parametrize("kind", LINK_FAULTS)
@pytest.mark.parametrize("after", range(3))
def test_a_field_that_the_panel_did_not_take_is_dark_and_the_others_are_lit(kind: str, after: int) -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    frame = picture(0)
    panel._fields.send_fields(frame)
    model.link_faults.arm(kind, after=after)
    for _ in range(3):
        now[0] += 0.002
        model.outputs  # noqa: B018 - time passes
    assert [outputs for _, outputs in model.sequence.opened] == [
        0 if k == after else 1 << k for k in range(3)
    ]
    assert lit(model) <= allowed(frame)
    control = panel.control
    assert isinstance(control, BoardControl)
    found = control.read_fields()
    assert (found.fields, found.fields_displayed, found.fields_kept_dark) == (3, 3, 1)
    assert ("record" if kind == "swapped_gate" else "pattern") in found.kept_dark_because
    now[0] += 0.006
    assert model.outputs == 0b111, "the next time it is lit again"


@pytest.mark.parametrize("kind", LINK_FAULTS)
def test_while_the_fault_lasts_only_what_is_whole_is_lit(kind: str) -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    panel._fields.send_fields(picture(0))
    now[0] += 0.0061
    assert model.outputs == 0b111
    model.link_faults.arm(kind, count=None)
    model.sequence.opened.clear()
    now[0] += 0.006
    # a panel that takes nothing more goes on showing the field that it had: that one is whole when it is due
    assert model.outputs == (0 if kind == "swapped_gate" else 0b100)
    assert {p.outputs for p in model.lit()[2]} <= {0, model.outputs}
    assert lit(model) <= allowed(picture(0))


@pytest.mark.parametrize("kind", LINK_FAULTS)
def test_the_judge_sees_a_board_that_does_not_prove_its_fields(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model)
    monkeypatch.setattr(FieldSequence, "proven", lambda *what: 0)
    panel._fields.send_fields(picture(0))
    model.link_faults.arm(kind, after=1)
    now[0] += 0.006
    model.outputs  # noqa: B018
    assert not lit(model) <= allowed(picture(0))


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


step = st.one_of(
    st.tuples(
        st.sampled_from(["stall", "short_write", "garbage", "timeout", "late", "hang", "unplug"]),
        st.integers(1, 4),
        st.integers(0, 8),
    ),
    st.tuples(st.sampled_from(LINK_FAULTS), st.integers(1, 5), st.integers(0, 5)),
    st.just("show"),
    st.just("clear"),
)


@given(st.lists(step, max_size=14), st.integers(0, 99))
@settings(max_examples=50, deadline=None)
def test_under_any_script_of_faults_no_light_is_in_a_wrong_field(script: list, seed: int) -> None:
    model = BoardModel(SHAPE, faults=Faults(seed))
    model.faults.late_s = 0.004
    timing = Timing(period_us=1000, light_delay_us=250, light_width_us=500)
    panel = open_board(backend=VirtualUsb(model), timing=timing, timeout_s=0.008, fields=3)
    assert isinstance(panel, FieldPanel)
    sent: list[list[Field]] = []
    pairs: set[tuple[int, int]] = set()
    for number, act in enumerate([*script, "clear", "show", "show"]):
        match act:
            case "show":
                grays = np.random.default_rng(number).integers(0, 256, (3, *SHAPE), dtype=np.uint8)
                sent.append(colours_in_turn(grays, range(3), [1.0, 0.5, 1.0], 1000))
                try:
                    panel.show_fields(sent[-1])
                except DeviceError as error:
                    assert str(error).endswith(".")
            case "clear":
                model.faults.clear()
                model.link_faults.clear()
            case kind, count, after:
                (model.link_faults if kind in LINK_FAULTS else model.faults).arm(kind, count, after)
        pairs |= lit(model)
    assert pairs <= allowed(*sent)
    assert model.faults.standing("unplug") or model.sequence.front


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("raw"), st.binary(max_size=80), st.just(0)),
            st.tuples(st.just("frame"), st.integers(0, 3), st.integers(1, 120)),
            st.tuples(st.just("flip"), st.integers(0, 3), st.integers(0, 140)),
            st.tuples(st.just("commit"), st.integers(0, 3), st.integers(1, 3)),
            st.tuples(st.just("time"), st.integers(1, 9), st.just(0)),
            st.tuples(st.just("clear"), st.just(0), st.just(0)),
        ),
        max_size=25,
    )
)
@settings(max_examples=100, deadline=None)
def test_no_sequence_of_bytes_shows_fields_of_two_frames_together(acts: list) -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    model.control(0, 9, 1, 0, b"", lambda: True)
    model.control(0x40, 7, 2, 0, b"", lambda: True)
    model.control(0x40, 2, 1, 0, b"", lambda: True)
    frames = [picture(k) for k in range(4)]
    whole = [[(crc(f.gray), f.lasers) for f in frame] for frame in frames]

    def attempt(transfer, *what) -> None:
        with suppress(Stall, Nak, NoDevice):
            transfer(*what, lambda: True)

    for name, a, b in acts:
        match name:
            case "raw":
                attempt(model.write, 1, a)
            case "frame":
                attempt(
                    model.write,
                    1,
                    fields_bytes(frames[a], 1)[0] if b > 40 else fields_bytes(frames[a], 1)[0][:b],
                )
            case "flip":
                data = bytearray(fields_bytes(frames[a], 1)[0])
                data[b] ^= 1
                attempt(model.write, 1, bytes(data))
            case "commit":
                body = struct.pack("<II", 1, fields_bytes(frames[a], 1)[1])
                attempt(model.control, 0x40, 5, 0, 0, body + zlib.crc32(body).to_bytes(4, "little"))
            case "time":
                now[0] += a * 0.0167
            case "clear":
                model.control(2, 1, 0, 1, b"", lambda: True)
                attempt(model.control, 0x40, 6, 0, 0, b"")
        model.outputs  # noqa: B018 - time passes
    opened_fields = list(model.sequence.opened)
    for k in range(0, len(opened_fields), 3):
        group = opened_fields[k : k + 3]
        assert any(group == frame[: len(group)] for frame in whole), "a frame is always shown whole"


@given(st.binary(max_size=40), st.booleans(), st.sampled_from([parse_versions, parse_fields]))
def test_replies_of_any_bytes_are_parsed_or_refused(data: bytes, seal: bool, parse) -> None:
    if seal:
        data += zlib.crc32(data).to_bytes(4, "little")
    try:
        parse(data)
    except ValueError as error:
        assert re.search("bytes came instead of|CRC of its reply|values that the protocol", str(error))
