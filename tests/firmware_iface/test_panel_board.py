"""The panel board: driver against model, byte by byte, under faults, and what no sequence of bytes may do."""

from __future__ import annotations

import re
import struct
import zlib

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel import Panel, open_board
from firmware_iface.panel.panel_board import BoardControl, BulkFrames
from firmware_iface.panel.panel_board_messages import (
    Timing,
    frame_bytes,
    parse_identity,
    parse_status,
    parse_timing,
)
from firmware_iface.virtual.fault_injection import Faults
from firmware_iface.virtual.usb import BoardModel, VirtualUsb
from firmware_iface.virtual.usb.usb_model import Nak, NoDevice, Stall

from .usb_transcript import Transcript

SHAPE = (48, 64)
FAST = Timing(period_us=2000, light_delay_us=500, light_width_us=1000)


def opened(model: BoardModel, timeout_s: float = 0.1) -> Panel:
    return open_board(backend=VirtualUsb(model), timing=FAST, timeout_s=timeout_s)


def pattern(seed: int, shape: tuple[int, int] = SHAPE) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_what_is_shown_is_what_was_sent_once_show_returns() -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    assert panel.shape == SHAPE
    for seed in range(5):
        panel.show(pattern(seed))
        np.testing.assert_array_equal(model.gray, pattern(seed))
    status = panel.status()
    assert status["frames_displayed"] == 5 and status["frames_rejected"] == 0
    assert status["temperature_c"] == 31.25 and status["faults"] == []
    model.fault_bits = 0b10
    assert panel.status()["faults"] == ["too hot"]


def test_the_bytes_of_opening_showing_and_closing() -> None:
    """Against the protocol's page: IDENTITY, TIMING and back, MODE; the frame, COMMIT, STATUS; MODE dark."""
    bus = Transcript(BoardModel((4, 8)))
    panel = open_board(backend=bus, timing=FAST)
    gray = np.arange(32, dtype=np.uint8).reshape(4, 8)
    panel.show(gray)
    panel.close()
    asked = [line for line in bus.lines if not line.startswith("c0 04")]  # STATUS is polled, and holds time
    assert asked == [
        "c0 01 0000 < 48 4c 50 42 01 00 08 00 04 00 08 00 40 1f 00 00 e8 03 00 00 a0 86 01 00 .. 32",
        "40 03 0000 > d0 07 00 00 f4 01 00 00 e8 03 00 00 " + crc_hex(struct.pack("<III", 2000, 500, 1000)),
        "c0 03 0000 < d0 07 00 00 f4 01 00 00 e8 03 00 00 " + crc_hex(struct.pack("<III", 2000, 500, 1000)),
        "40 02 0001 >",
        "01 > 48 4c 50 46 01 00 00 00 08 00 04 00 20 00 00 00 8a 7e 26 91 "
        + crc_hex(bytes.fromhex("484c504601000000080004002000 00008a7e2691"))
        + " .. 56",
        "40 05 0000 > 01 00 00 00 8a 7e 26 91 " + crc_hex(bytes.fromhex("010000008a7e2691")),
        "40 02 0000 >",
    ]
    assert zlib.crc32(gray.tobytes()) == 0x91267E8A


def crc_hex(data: bytes) -> str:
    return zlib.crc32(data).to_bytes(4, "little").hex(" ")


@pytest.mark.parametrize("kind", ["stall", "short_write", "garbage", "timeout", "late"])
@pytest.mark.parametrize("after", range(4))
def test_one_failed_transfer_costs_no_frame_and_never_shows_a_wrong_one(kind: str, after: int) -> None:
    """Where a transfer is not repeated, show says so; the next show works, and nothing else was displayed."""
    model = BoardModel(SHAPE)
    model.faults.late_s = 0.2
    panel = opened(model, timeout_s=0.05)
    panel.show(pattern(0))
    model.faults.arm(kind, after=after)
    try:
        panel.show(pattern(1))
    except DeviceError:
        assert after >= 2  # the frame itself and its commit are repeated, also the status, if it fails once
    else:
        np.testing.assert_array_equal(model.gray, pattern(1))
    model.faults.clear()
    panel.show(pattern(2))
    np.testing.assert_array_equal(model.gray, pattern(2))
    sent = {zlib.crc32(pattern(seed).tobytes()) for seed in range(3)}
    assert {crc for _, crc in model.shown} <= sent


@pytest.mark.parametrize("kind", ["stall", "short_write", "garbage", "hang"])
def test_a_lasting_fault_ends_in_one_sentence_and_clears_without_a_restart(kind: str) -> None:
    model = BoardModel(SHAPE)
    panel = opened(model, timeout_s=0.05)
    panel.show(pattern(0))
    model.faults.arm(kind, count=None)
    with pytest.raises(DeviceError, match=r"the panel board.*; .*\.") as caught:
        panel.show(pattern(1))
    assert not isinstance(caught.value, (DeviceGoneError, InputError))
    model.faults.clear()
    np.testing.assert_array_equal(model.gray, pattern(0))
    panel.show(pattern(1))
    np.testing.assert_array_equal(model.gray, pattern(1))


@pytest.mark.parametrize("after", range(4))
def test_unplugged_anywhere_in_a_frame_and_plugged_in_again(after: int) -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    panel.show(pattern(0))
    model.faults.arm("unplug", after=after)
    with pytest.raises(DeviceGoneError, match="plug|attached"):
        for _ in range(3):  # with the transfers that are spared, later frames may still pass
            panel.show(pattern(1))
    assert not model.gray.any(), "a panel without power shows nothing"
    with pytest.raises(DeviceGoneError, match="not attached"):
        panel.status()
    model.faults.clear("unplug")
    panel.show(pattern(2))
    np.testing.assert_array_equal(model.gray, pattern(2))
    assert panel.status()["mode"] == "show"


def test_power_lost_between_two_frames_is_noticed_though_nobody_looked() -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    panel.show(pattern(0))
    model.faults.arm("unplug")
    model.faults.clear()
    assert not model.gray.any()
    with pytest.raises(DeviceGoneError):
        panel.show(pattern(1))
    panel.show(pattern(1))
    np.testing.assert_array_equal(model.gray, pattern(1))


def test_another_board_in_its_place_is_not_taken() -> None:
    model = BoardModel(SHAPE)
    bus = VirtualUsb(model)
    panel = open_board(backend=bus, timing=FAST)
    model.faults.arm("unplug")
    with pytest.raises(DeviceGoneError):
        panel.status()
    bus.models.append(BoardModel((8, 8)))
    with pytest.raises(DeviceError, match="another board, 8 x 8"):
        panel.show(pattern(0))


def test_a_frame_that_another_host_replaced_is_reported_lost() -> None:
    model = BoardModel(SHAPE)
    panel = opened(model)
    frames = panel.frames
    assert isinstance(frames, BulkFrames) and isinstance(panel.control, BoardControl)
    first = frames.send(pattern(0))
    frames.wait(first)
    frames.wait(frames.send(pattern(1)))
    with pytest.raises(DeviceError, match="lost frame 1"):
        frames.wait(first)


def test_a_board_that_never_swaps_is_reported() -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    panel = opened(model, timeout_s=0.02)
    with pytest.raises(DeviceError, match="lost frame 1: it displays 0"):
        panel.show(pattern(0))
    now[0] += 1
    np.testing.assert_array_equal(model.gray, pattern(0))


def test_the_swap_waits_for_the_period_and_the_next_frame_for_the_swap() -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    frames = opened(model, timeout_s=0.02).frames
    frames.send(pattern(0))
    now[0] = 0.0019
    assert not model.gray.any()
    with pytest.raises(DeviceError, match="within 0.02 s.*Frame 2 was sent twice"):
        frames.send(pattern(1))
    now[0] = 0.0021
    np.testing.assert_array_equal(model.gray, pattern(0))
    frames.send(pattern(1))


def test_the_model_knows_what_it_showed_before_and_for_how_many_periods() -> None:
    now = [0.0]
    model = BoardModel(SHAPE, clock=lambda: now[0])
    frames = opened(model, timeout_s=0.02).frames
    shown = []
    for k, periods in ((0, 3), (1, 1), (2, 0)):
        frames.send(pattern(k))
        now[0] += 0.002  # it is shown from now on
        shown = [(int(gray.sum()), count) for gray, count in model.shown_before()]
        now[0] += 0.002 * max(0, periods - 1)
    assert shown == [(0, 1), (int(pattern(0).sum()), 3), (int(pattern(1).sum()), 1)]
    now[0] += 0.0081
    assert [(int(gray.sum()), count) for gray, count in model.shown_before()] == [
        *shown,
        (int(pattern(2).sum()), 4),
    ]


def test_timing_is_set_read_back_and_refused_where_it_cannot_be() -> None:
    model = BoardModel(SHAPE)
    control = opened(model).control
    assert isinstance(control, BoardControl)
    control.timing = Timing(5000, 1000, 4000)
    assert control.timing == Timing(5000, 1000, 4000)
    for timing in (Timing(500, 0, 0), Timing(200_000, 0, 0), Timing(5000, 2000, 4000), Timing(5000, -1, 1)):
        with pytest.raises(InputError, match="period"):
            control.timing = timing
    assert control.timing == Timing(5000, 1000, 4000)
    control.set_mode("test")
    assert set(np.unique(model.gray)) == {0, 128}
    with pytest.raises(InputError, match="dark, show, test"):
        control.set_mode("bright")


def test_wrong_patterns_and_missing_boards_say_what_to_do() -> None:
    panel = opened(BoardModel(SHAPE))
    with pytest.raises(InputError, match="float64"):
        panel.show(np.zeros(SHAPE))
    with pytest.raises(InputError, match="48, 64"):
        panel.show(np.zeros((64, 48), np.uint8))
    with pytest.raises(DeviceGoneError, match="1209:0001.*serial number X7.*not attached"):
        open_board("X7", backend=VirtualUsb(BoardModel(SHAPE)))


def test_the_serial_number_chooses_among_boards() -> None:
    first, second = BoardModel(SHAPE, serial="A"), BoardModel(SHAPE, serial="B")
    open_board("B", backend=VirtualUsb(first, second), timing=FAST).show(pattern(3))
    assert second.gray.any() and not first.gray.any()


script = st.tuples(
    st.sampled_from(["stall", "short_write", "garbage", "timeout", "late", "hang", "unplug"]),
    st.integers(1, 4),
    st.integers(0, 8),
)


@given(st.lists(st.one_of(script, st.just("show"), st.just("clear")), max_size=14), st.integers(0, 99))
@example([("stall", 1, 0), ("short_write", 1, 0), "show"], 0)
@settings(max_examples=60)
def test_under_any_script_of_faults_show_shows_or_says_so(script: list, seed: int) -> None:
    """A show that returns has its pattern on the panel; whatever happened, only whole sent frames were displayed."""
    model = BoardModel((3, 5), faults=Faults(seed))
    model.faults.late_s = 0.004
    panel = opened(model, timeout_s=0.008)
    sent = set()
    for number, step in enumerate([*script, "clear", "show"]):
        match step:
            case "show":
                gray = pattern(number, (3, 5))
                sent.add(zlib.crc32(gray.tobytes()))
                try:
                    panel.show(gray)
                except DeviceError as error:
                    assert script and str(error).endswith(".")
                else:
                    assert model.faults.standing("unplug") or (model.gray == gray).all()
            case "clear":
                model.faults.clear()
            case kind, count, after:
                model.faults.arm(kind, count, after)
    try:
        panel.show(gray)  # the last show may have met a board that was out meanwhile
    except DeviceGoneError:
        panel.show(gray)
    assert (model.gray == gray).all()
    assert {crc for _, crc in model.shown} <= sent


SMALL = (3, 5)
good = st.integers(0, 255).map(lambda level: np.full(SMALL, level, np.uint8))
act = st.one_of(
    st.tuples(st.just("raw"), st.binary(max_size=80)),
    st.tuples(st.just("frame"), good, st.integers(1, 3), st.integers(0, 38)),
    st.tuples(st.just("flip"), good, st.integers(0, 38), st.integers(1, 255)),
    st.tuples(st.just("commit"), st.integers(1, 3), good),
    st.tuples(st.just("request"), st.integers(0, 8), st.integers(0, 4), st.binary(max_size=16)),
    st.tuples(st.just("clear")),
    st.tuples(st.just("time"), st.floats(0, 0.05)),
)


@given(st.lists(act, max_size=25))
@settings(max_examples=150)
def test_no_sequence_of_bytes_displays_anything_but_a_whole_committed_frame(acts: list) -> None:
    """Torn, partial, flipped and uncommitted frames in any order: the front buffer is always one of the sent."""
    now = [0.0]
    model = BoardModel(SMALL, faults=Faults(), clock=lambda: now[0])
    model.control(0, 9, 1, 0, b"", lambda: True)
    model.control(0x40, 2, 1, 0, b"", lambda: True)
    whole: set[bytes] = {bytes(15)}
    committed: set[bytes] = {bytes(15)}

    def attempt(transfer, *what) -> bool:
        try:
            transfer(*what, lambda: True)
        except (Stall, Nak, NoDevice):
            return False
        return True

    for name, *given_ in acts:
        match name:
            case "raw":
                attempt(model.write, 1, given_[0])
            case "frame" | "flip":
                gray = given_[0]
                sequence = given_[1] if name == "frame" else 1
                data, _ = frame_bytes(gray, sequence)
                if name == "frame":
                    cut = given_[2]
                    data = data if cut == 38 else data[:cut]
                else:
                    at = given_[1]
                    data = data[:at] + bytes([data[at] ^ given_[2]]) + data[at + 1 :]
                if attempt(model.write, 1, data):
                    whole.add(gray.tobytes())
            case "commit":
                pair = struct.pack("<II", given_[0], zlib.crc32(given_[1].tobytes()))
                sealed = pair + zlib.crc32(pair).to_bytes(4, "little")
                if attempt(model.control, 0x40, 5, 0, 0, sealed):
                    assert given_[1].tobytes() in whole
                    committed.add(given_[1].tobytes())
            case "request":
                if given_[0] not in (2, 3):  # mode and timing would change what is asserted
                    attempt(model.control, 0x40, given_[0], given_[1], 0, given_[2])
            case "clear":
                model.control(2, 1, 0, 1, b"", lambda: True)
                model.control(0x40, 6, 0, 0, b"", lambda: True)
            case "time":
                now[0] += given_[0]
        assert model.gray.tobytes() in committed


@given(st.binary(max_size=64), st.sampled_from([parse_identity, parse_timing, parse_status]), st.booleans())
def test_replies_of_any_bytes_are_parsed_or_refused(data: bytes, parse, seal: bool) -> None:
    """Also with a right CRC, so that the values themselves are random."""
    if seal:
        data += zlib.crc32(data).to_bytes(4, "little")
    try:
        parse(data)
    except ValueError as error:
        assert re.search(
            "bytes came instead of|CRC of its reply|its identity is not|its status has", str(error)
        )


@given(st.binary(min_size=28, max_size=28))
def test_a_sealed_identity_is_taken_only_if_every_field_makes_sense(body: bytes) -> None:
    sealed = body + zlib.crc32(body).to_bytes(4, "little")
    with pytest.raises(ValueError, match="version 1"):
        parse_identity(sealed)  # random bytes hold the magic word about never
    fixed = b"HLPB\x01\x00" + body[6:10] + b"\x08\x00" + body[12:]
    try:
        identity = parse_identity(fixed + zlib.crc32(fixed).to_bytes(4, "little"))
    except ValueError:
        return
    assert identity.width > 0 and identity.height > 0
    assert identity.shortest_period_us <= identity.longest_period_us
