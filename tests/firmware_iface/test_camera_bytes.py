"""The camera's bytes: packed pixels, messages between the processes, and libnop values of the emulated link."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from firmware_iface.camera.pixel_unpacking import unpack
from firmware_iface.camera.process_messages import Frame, Messages, frame_message, state_message
from firmware_iface.virtual.oak import libnop, pack_raw10


def test_raw10_of_known_bytes() -> None:
    """MIPI: 0x3FF, 0x001, 0x102, 0x200 in five bytes, the low bits of the first pixel lowest."""
    data = bytes([0xFF, 0x00, 0x40, 0x80, 0b00_10_01_11])
    assert unpack(data, "raw10", 1, 4, 5).tolist() == [[0x3FF, 0x001, 0x102, 0x200]]


@given(
    arrays(
        np.uint16,
        st.tuples(st.integers(1, 5), st.integers(1, 6).map(lambda n: 4 * n)),
        elements=st.integers(0, 1023),
    )
)
def test_raw10_comes_back_as_it_was_packed(counts: np.ndarray) -> None:
    height, width = counts.shape
    np.testing.assert_array_equal(unpack(pack_raw10(counts), "raw10", height, width, width * 5 // 4), counts)


def test_rows_may_be_padded_and_the_last_one_cut_there() -> None:
    counts = np.arange(24, dtype=np.uint16).reshape(3, 8) * 40
    rows = np.frombuffer(pack_raw10(counts), np.uint8).reshape(3, 10)
    padded = np.pad(rows, ((0, 0), (0, 6)), constant_values=255).tobytes()
    np.testing.assert_array_equal(unpack(padded[:-6], "raw10", 3, 8, 16), counts)
    gray = bytes(range(24))
    assert unpack(gray, "gray8", 3, 5, 8).tolist() == [[*range(5)], [*range(8, 13)], [*range(16, 21)]]


@given(
    st.binary(max_size=200),
    st.sampled_from(["raw10", "gray8", "nv12"]),
    st.integers(-2, 20),
    st.integers(-2, 20),
    st.integers(-2, 40),
)
def test_any_picture_is_unpacked_within_its_bytes_or_refused(
    data: bytes, encoding: str, height: int, width: int, stride: int
) -> None:
    try:
        counts = unpack(data, encoding, height, width, stride)
    except ValueError as error:
        assert re.search("not known|whole groups of four|do not hold", str(error))
        return
    assert counts.shape == (height, width) and counts.max() <= (1023 if encoding == "raw10" else 255)
    assert stride * (height - 1) < len(data)


frames = st.builds(
    Frame,
    height=st.integers(0, 2**16 - 1),
    width=st.integers(0, 2**16 - 1),
    stride=st.integers(0, 2**32 - 1),
    exposure_us=st.integers(0, 2**32 - 1),
    iso=st.integers(0, 2**32 - 1),
    number=st.integers(0, 2**64 - 1),
    end_ns=st.integers(0, 2**64 - 1),
    data=st.binary(max_size=50),
)


@given(st.lists(st.one_of(frames, st.text(max_size=20)), max_size=5), st.integers(1, 40), st.integers(0, 30))
def test_messages_come_whole_however_the_pipe_cuts_them(messages: list, step: int, lost: int) -> None:
    """Cut anywhere, also where the sender died: what is given is a prefix of what was sent."""
    sent = b"".join(frame_message(m) if isinstance(m, Frame) else state_message(m) for m in messages)
    cut = sent[: len(sent) - lost] if lost else sent
    parser, got = Messages(), []
    for at in range(0, len(cut), step):
        got += list(parser.feed(cut[at : at + step]))
    assert got == messages[: len(got)]
    if not lost:
        assert got == messages


@given(st.binary(min_size=48, max_size=200))
def test_bytes_that_are_no_messages_are_refused(data: bytes) -> None:
    if not data.startswith(b"HLCM"):
        with pytest.raises(ValueError, match="not a message"):
            list(Messages().feed(data))
    with pytest.raises(ValueError, match="not a message"):
        list(Messages().feed(b"HLCM\x01\0\0\0" + (2**31).to_bytes(4, "little") + data))


def test_an_exposure_begins_before_it_ends() -> None:
    frame = Frame(1, 1, 1, exposure_us=2000, iso=100, number=0, end_ns=5_000_000, data=b"")
    assert frame.begin_ns == 3_000_000


values = st.recursive(
    st.one_of(
        st.integers(-(2**63), 2**63 - 1),
        st.integers(0, 2**64 - 1).map(libnop.Unsigned),
        st.floats(width=32, allow_nan=False),
        st.text(max_size=8),
        st.none(),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.lists(inner, max_size=4).map(tuple)),
    max_leaves=12,
)


@given(values)
def test_libnop_values_come_back(value: object) -> None:
    assert libnop.decode(libnop.encode(value)) == value


@given(st.binary(max_size=60))
def test_any_bytes_are_a_libnop_value_or_a_value_error(data: bytes) -> None:
    try:
        libnop.decode(data)
    except ValueError as error:
        assert "libnop" in str(error)


def test_libnop_bytes_of_known_values() -> None:
    """Fixed integers, sized integers of either sign, and a structure."""
    assert (
        libnop.encode(127) == b"\x7f" and libnop.encode(-1) == b"\xff" and libnop.encode(-65) == b"\x84\xbf"
    )
    assert libnop.encode(200) == b"\x85\xc8\x00" and libnop.encode(libnop.Unsigned(200)) == b"\x80\xc8"
    assert libnop.encode((1, [2.0], "a", None)) == bytes.fromhex("b904 01 ba01 8800000040 bd0161 be")
