"""The wire format: every byte in its place, in Python and in C; only messages are accepted."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from runtime.service import process_messages, protocol
from runtime.service.message_format import LARGEST, ProtocolError, Vocabulary, formats
from runtime.service.protocol import PROTOCOL

HEADER_FILE = Path(protocol.__file__).with_name("hololoop_service.h")
VOCABULARIES = (PROTOCOL, process_messages.SOLVER, process_messages.CAMERA)
VALUES = {
    "H": st.integers(0, 2**16 - 1),
    "I": st.integers(0, 2**32 - 1),
    "Q": st.integers(0, 2**64 - 1),
    "f": st.floats(width=32, allow_nan=False),
    "8s": st.binary(min_size=8, max_size=8),
    "156s": st.binary(min_size=156, max_size=156),
    "12s": st.binary(min_size=12, max_size=12),
    "240s": st.text(max_size=59).filter(lambda text: "\0" not in text),
}


def message_types(vocabulary: Vocabulary) -> list[type]:
    return list(vocabulary._types.values())


@given(st.data(), st.sampled_from(VOCABULARIES), st.integers(0, 2**32 - 1))
def test_what_is_packed_comes_back(data: st.DataObject, vocabulary: Vocabulary, serial: int) -> None:
    message_type = data.draw(st.sampled_from(message_types(vocabulary)))
    message = message_type(*(data.draw(VALUES[f]) for f in formats(message_type)))
    packed = vocabulary.pack(message, serial)
    assert len(packed) <= LARGEST
    assert vocabulary.unpack(packed) == (serial, message)
    for wrong in (packed[:-1], packed + b"\0", b"\xff\xff" + packed[2:]):
        with pytest.raises(ProtocolError):
            vocabulary.unpack(wrong)


@given(st.binary(max_size=LARGEST), st.sampled_from(VOCABULARIES))
@example(b"\x05\x00\x00\x01" + bytes(4) + b"\xff" * 248, PROTOCOL)  # a text that is not UTF-8 and has no end
def test_any_bytes_are_a_message_or_a_protocol_error(data: bytes, vocabulary: Vocabulary) -> None:
    try:
        serial, message = vocabulary.unpack(data)
    except ProtocolError:
        return
    assert vocabulary.unpack(vocabulary.pack(message, serial))[0] == serial


def test_a_long_text_is_cut_between_characters() -> None:
    _, message = PROTOCOL.unpack(PROTOCOL.pack(protocol.Error(1, 0, "µ" * 300)))
    assert message.text == "µ" * 119


def test_the_bytes_of_an_end_message() -> None:
    """All bytes, so that a change of the wire format fails here."""
    packed = PROTOCOL.pack(protocol.End(frame=0x01020304, slot=2, crc=0xAABBCCDD), serial=7)
    assert packed.hex(" ") == "09 00 18 00 07 00 00 00 04 03 02 01 02 00 00 00 dd cc bb aa 00 00 00 00"


@pytest.mark.parametrize(
    ("lowest", "highest", "agreed"), [(1, 1, 1), (1, 9, 1), (0, 1, 1), (2, 9, None), (0, 0, None)]
)
def test_the_highest_common_version_is_agreed_on(lowest: int, highest: int, agreed: int | None) -> None:
    assert protocol.agreed_version(protocol.Hello(protocol.MAGIC, lowest, highest)) == agreed


STRUCTS = {
    protocol.Done: "plain",
    protocol.Wait: "plain",
    protocol.Status: "plain",
    protocol.Clear: "plain",
    protocol.Arm: "plain",
    protocol.Dark: "plain",
    protocol.Capture: "plain",
}


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_c_header_has_the_same_bytes(tmp_path: Path) -> None:
    """Sizes, offsets and codes, as the compiler sees them."""
    lines = []
    for code, message_type in PROTOCOL._types.items():
        struct = f"struct hololoop_{STRUCTS.get(message_type, message_type.__name__.lower())}"
        offset = 8
        lines.append(
            f'_Static_assert(HOLOLOOP_{message_type.__name__.upper()} == {code}, "code of {message_type.__name__}");'
        )
        for name, form in zip(message_type._fields, formats(message_type), strict=True):
            lines.append(
                f'_Static_assert(offsetof({struct}, {name}) == {offset}, "{message_type.__name__}.{name}");'
            )
            offset += {"H": 2, "I": 4, "Q": 8, "f": 4, "8s": 8, "240s": 240}[form]
        lines.append(f'_Static_assert(sizeof({struct}) == {offset}, "size of {message_type.__name__}");')
    names = {"WRONG_VERSION": "VERSION", "WRONG_ORDER": "ORDER", "WRONG_RING": "RING", "WRONG_SLOT": "SLOT"}
    names |= {f"NO_{part}": part for part in ("SOLVER", "PANEL", "LASERS", "CAMERA")}
    in_c = {python: c for c, python in names.items()}
    for code in protocol.Code:
        lines.append(
            f'_Static_assert(HOLOLOOP_{in_c.get(code.name, code.name)} == {code.value}, "{code.name}");'
        )
    for state in protocol.LaserState:
        lines.append(f'_Static_assert(HOLOLOOP_LASERS_{state.name} == {state.value}, "{state.name}");')
    for part in protocol.PartState:
        lines.append(f'_Static_assert(HOLOLOOP_{part.name} == {part.value}, "{part.name}");')
    source = tmp_path / "check.c"
    source.write_text(
        "\n".join(
            ["#include <stddef.h>", f'#include "{HEADER_FILE}"', *lines, "int main(void) { return 0; }"]
        )
    )
    done = subprocess.run(
        [
            "cc",
            "-std=c11",
            "-Wall",
            "-Werror",
            "-pedantic",
            "-c",
            str(source),
            "-o",
            str(tmp_path / "check.o"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
