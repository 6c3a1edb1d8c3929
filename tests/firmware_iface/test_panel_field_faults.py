"""Wrong frames and faults of a panel board's link: no light in a wrong field."""

from __future__ import annotations

import re
import struct
import zlib
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.errors import DeviceError
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

from .field_frames import SHAPE, allowed, crc, lit, opened, picture

LINK_FAULTS = ("torn_field", "swapped_gate", "missing_field")


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
