"""TI's phase light modulator: the encoding, the states, the commands' bytes, and faults."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.panel import Panel, open_dlpc900, run_length_encoding
from firmware_iface.panel import phase_light_modulator as plm
from firmware_iface.panel.dlpc900_commands import Dlpc900Control, parse_answer
from firmware_iface.panel.dlpc900_upload import PatternUpload
from firmware_iface.panel.fields import Field, FieldPanel, colours_in_turn
from firmware_iface.panel.phase_light_modulator import P47, P67, Modulator
from firmware_iface.virtual.usb import Dlpc900Model, VirtualUsb
from firmware_iface.virtual.usb.run_length_decoding import CommandError, decode_image

from .usb_transcript import Transcript

SMALL = Modulator((6, 10), P47.electrodes)
WIDEST_GAP = np.diff([*plm.phase_waves(), 1.0]).max()


def opened(model: Dlpc900Model, timeout_s: float = 0.1) -> Panel:
    return open_dlpc900(modulator=SMALL, backend=VirtualUsb(model), timeout_s=timeout_s)


def small_model() -> Dlpc900Model:
    return Dlpc900Model(SMALL.memory_shape)


def pattern(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, SMALL.shape, dtype=np.uint8)


def waves_apart(shown: NDArray[np.uint8], asked: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.abs((shown.astype(float) - asked + 128) % 256 - 128) / 256


def test_a_shown_pattern_is_the_asked_phase_to_the_nearest_of_sixteen_states() -> None:
    model = small_model()
    panel = opened(model)
    assert panel.shape == (6, 10)
    for seed in range(3):
        panel.show(pattern(seed))
        assert waves_apart(model.gray, pattern(seed)).max() <= WIDEST_GAP / 2 + 0.5 / 256
    levels = np.rint(plm.phase_waves() * 256).astype(np.uint8)
    exact = np.resize(levels, SMALL.shape)
    panel.show(exact)
    np.testing.assert_array_equal(model.gray, exact)
    assert len(np.unique(model.gray)) == 16


def test_every_gray_level_goes_to_the_state_nearest_on_the_circle() -> None:
    """By search over all states, with wrapped distance; the top of the range wraps to state 0."""
    chosen = plm.states(np.arange(256, dtype=np.uint8))
    for gray in range(256):
        apart = [abs((gray / 256 - p + 0.5) % 1 - 0.5) for p in plm.phase_waves()]
        assert apart[chosen[gray]] == pytest.approx(min(apart))
    assert chosen[0] == 0 and chosen[255] == 0 and chosen[240] == 15


def test_both_devices_spread_a_mirrors_bits_as_their_tables_say() -> None:
    """State 0 has memory 3 = bits 0 and 1, state 15 has 12 = bits 2 and 3: complements of one another."""
    first = np.array([[0, 240]], np.uint8)
    assert plm.bit_plane(first, P47).tolist() == [[0, 0, 1, 1], [1, 1, 0, 0]]
    # .67: bits 1, 3 over 0, 2 and columns the other way
    assert plm.bit_plane(first, P67).tolist() == [[1, 0, 0, 1], [1, 0, 0, 1]]


def test_two_controllers_take_a_half_each() -> None:
    halves = Modulator((6, 10), P67.electrodes, mirrored=True, controllers=2)
    model = Dlpc900Model((12, 20), (1, 3, 0, 2), mirrored=True, controllers=2)
    panel = open_dlpc900(modulator=halves, backend=VirtualUsb(model))
    panel.show(pattern(4))
    assert set(model.images) == {(0, 0), (0, 1)}
    assert waves_apart(model.gray, pattern(4)).max() <= WIDEST_GAP / 2 + 0.5 / 256


def test_the_bytes_of_one_upload() -> None:
    """As TI's guide lays the commands out; each is answered, so the reads are left out here."""
    mirror = Modulator((1, 2), P47.electrodes)
    bus = Transcript(Dlpc900Model((2, 4)), longest=64)
    panel = open_dlpc900(modulator=mirror, backend=bus)
    begun = len(bus.lines)
    panel.frames.send(np.array([[0, 240]], np.uint8))
    sent = [bytes.fromhex(line[5:]) for line in bus.lines[begun:] if line.startswith("01 >")]
    assert all(len(packet) == 64 for packet in sent) and {packet[0] for packet in sent[:5]} == {0x40}
    assert [p[1] for p in sent[:5]] == [(sent[0][1] + k) % 256 for k in range(5)], "sequence counts up"
    assert [packet[2:6].hex(" ") for packet in sent[:4]] == [
        "03 00 24 1a",
        "0e 00 34 1a",
        "08 00 31 1a",
        "08 00 2a 1a",
    ]
    assert sent[1][6:18].hex(" ") == "00 00 80 3e 00 71 00 00 00 00 00 00"  # pattern 0, 16000 us, 1 bit
    assert sent[2][6:12].hex(" ") == "01 00 00 00 00 00"  # one pattern, without end
    encoded = run_length_encoding.encode(
        plm.bit_plane(np.array([[0, 240]], np.uint8), mirror).astype(np.uint32)
    )
    assert sent[3][6:12] == b"\0\0" + len(encoded).to_bytes(4, "little")
    assert sent[4][2:8] == (len(encoded) + 4).to_bytes(2, "little") + b"\x2b\x1a" + len(encoded).to_bytes(
        2, "little"
    )
    assert (sent[4][8:] + sent[5])[: len(encoded)] == encoded
    assert sent[-1][2:7].hex(" ") == "03 00 24 1a 02"


def test_encoded_rows_of_known_bytes() -> None:
    """A run, single pixels, a row like the one above; the header's size, length and compression."""
    image = np.array([[7, 7, 7, 1, 2], [7, 7, 7, 1, 2]], np.uint32)
    data = run_length_encoding.encode(image)
    assert data[:12].hex(" ") == "53 70 6c 64 05 00 02 00 48 00 00 00" and len(data) == 0x48
    assert data[24:27] == bytes([0, 2, 1])
    first, second = "03 000007  00 02 000001 000002  0000", "00 01 05  0000"
    assert data[48:] == bytes.fromhex(
        first + second + "00 01 00" + "0000"
    )  # end of the image, padding to four


images = arrays(
    np.uint32,
    st.tuples(st.integers(1, 6), st.sampled_from([1, 2, 3, 7, 127, 128, 129, 300])),
    elements=st.sampled_from([0, 0, 0, 1, 1, 0xFFFFFF, 0x123456]),
)


@given(images)
@settings(max_examples=60)
def test_every_image_comes_back_from_its_encoding(image: np.ndarray) -> None:
    np.testing.assert_array_equal(decode_image(run_length_encoding.encode(image), *image.shape), image)


def test_smooth_images_shrink_and_noise_does_not_grow_by_more_than_its_rows() -> None:
    smooth = np.zeros((64, 1920), np.uint32)
    smooth[10:50, 300:900] = 0xFFFFFF
    assert len(run_length_encoding.encode(smooth)) < 0.005 * smooth.size * 3
    noise = np.random.default_rng(0).integers(0, 1 << 24, (16, 1920)).astype(np.uint32)
    assert len(run_length_encoding.encode(noise)) <= 3 * noise.size + 16 * 5 + 48 + 8


@given(st.binary(max_size=120))
def test_any_bytes_are_decoded_or_refused_by_the_model(body: bytes) -> None:
    header = run_length_encoding.encode(np.zeros((2, 3), np.uint32))[:48]
    try:
        assert decode_image(header + body, 2, 3).shape == (2, 3)
    except CommandError as refused:
        assert refused.number in (6, 9)


def test_up_to_24_pictures_share_an_image() -> None:
    model = small_model()
    frames = opened(model).frames
    assert isinstance(frames, PatternUpload)
    pictures = [pattern(seed) for seed in range(24)]
    frames.upload(pictures)
    for number, gray in enumerate(pictures):
        np.testing.assert_array_equal(model.plane(number), plm.bit_plane(gray, SMALL))
    for wrong in ([], pictures + pictures[:1]):
        with pytest.raises(InputError, match="1 to 24"):
            frames.upload(wrong)


def test_power_mode_and_status() -> None:
    model = small_model()
    panel = opened(model)
    assert panel.status()["mode"] == "on-the-fly" and panel.status()["faults"] == []
    panel.show(pattern(0))
    assert panel.status()["running"] and not panel.status()["parked"]
    control = panel.control
    assert isinstance(control, Dlpc900Control)
    control.set_mode("video")
    assert panel.status()["mode"] == "video" and not model.running
    with pytest.raises(DeviceError, match="does not run"):
        panel.frames.wait(1)
    control.set_power("standby")
    assert panel.status()["parked"] and not model.gray.any()
    for wrong in (control.set_mode, control.set_power):
        with pytest.raises(InputError, match="use one of"):
            wrong("bright")
    panel.close()
    assert model.power == 1


@pytest.mark.parametrize(
    ("code", "data", "reason"),
    [
        (0x1A99, b"", "does not know"),
        (0x1A1B, b"\x07", "parameter"),
        (0x1A34, bytes([144, 1]) + bytes(10), "number is out of range"),
        (0x1A34, bytes(12), "exposure"),
        (0x1A2B, b"\1\0x", "not for this mode"),
        (0x1A24, b"\2", "not for this mode"),
    ],
)
def test_the_controllers_reason_is_reported(code: int, data: bytes, reason: str) -> None:
    control = opened(small_model()).control
    assert isinstance(control, Dlpc900Control)
    with pytest.raises(DeviceError, match=f"0x{code:04x}: .*{reason}"):
        control.command(code, data)
    assert control.status()["mode"] == "on-the-fly", "and goes on"


@pytest.mark.parametrize("kind", ["stall", "short_write", "garbage", "timeout", "hang", "late"])
def test_a_fault_ends_in_one_sentence_and_the_next_frame_works(kind: str) -> None:
    model = small_model()
    model.faults.late_s = 0.2
    panel = opened(model, timeout_s=0.05)
    panel.show(pattern(0))
    model.faults.arm(kind, count=None, after=7)
    with pytest.raises(DeviceError, match=r"the phase light modulator.*\."):
        panel.show(pattern(1))
    model.faults.clear()
    panel.show(pattern(2))
    assert waves_apart(model.gray, pattern(2)).max() <= WIDEST_GAP / 2 + 0.5 / 256


def test_unplugged_and_replugged_it_is_set_up_again() -> None:
    model = small_model()
    panel = opened(model)
    panel.show(pattern(0))
    model.faults.arm("unplug", after=5)
    with pytest.raises(DeviceGoneError):
        panel.show(pattern(1))
    assert not model.gray.any()
    model.faults.clear()
    panel.show(pattern(1))
    assert waves_apart(model.gray, pattern(1)).max() <= WIDEST_GAP / 2 + 0.5 / 256


def test_a_late_answer_to_an_earlier_command_is_not_taken_for_this_one() -> None:
    model = small_model()
    control = opened(model).control
    assert isinstance(control, Dlpc900Control)
    stale = bytes([0x80, (control._sequence + 200) % 256, 1, 0, 77]).ljust(64, b"\0")
    model._answers.append(stale)
    assert control.status()["mode"] == "on-the-fly"


@given(st.binary(max_size=80))
def test_answers_of_any_bytes_are_parsed_within_themselves_or_refused(packet: bytes) -> None:
    try:
        _, _, data = parse_answer(packet)
    except ValueError as error:
        assert "answer" in str(error)
        return
    assert data == packet[4 : 4 + len(data)] and len(data) <= len(packet) - 4


def test_exposures_that_the_controller_cannot_do_are_refused() -> None:
    for exposure in (104, 1 << 24):
        with pytest.raises(InputError, match="105"):
            open_dlpc900(backend=VirtualUsb(small_model()), exposure_us=exposure)


def test_the_bytes_of_colours_in_turn() -> None:
    """LED enables to the sequencer; lines of the table with their colours, darkness and trigger output 2."""
    bus = Transcript(Dlpc900Model((2, 4)), longest=64)
    panel = open_dlpc900(modulator=Modulator((1, 2), P47.electrodes), backend=bus, exposure_us=4000, fields=3)
    assert isinstance(panel, FieldPanel) and panel.field_us == 4000 and panel.fields == 3

    def sent() -> list[bytes]:
        return [bytes.fromhex(line[5:])[2:] for line in bus.lines if line.startswith("01 >")]

    assert [p[:5].hex(" ") for p in sent() if p[2:4] == b"\x07\x1a"] == ["03 00 07 1a 08"]
    gray = np.array([[0, 240]], np.uint8)
    begun = len(sent())
    panel.show_fields(
        [Field(gray, 1, 0, 2000), Field(gray, 2, 1000, 600), Field(gray, 4, 0, 100), Field(gray, 0, 0, 0)]
    )
    lines = [p[4:16].hex(" ") for p in sent()[begun:] if p[2:4] == b"\x34\x1a"]
    assert lines == [
        "00 00 d0 07 00 11 d0 07 00 00 00 00",  # red, 2000 us of 4000, trigger output 2
        "01 00 58 02 00 21 48 0d 00 01 00 08",  # green, 600 us; no trigger; bit 1
        "02 00 69 00 00 01 37 0f 00 01 00 10",  # too short to be exposed: no colour
        "03 00 69 00 00 01 37 0f 00 01 00 18",
    ]
    assert [p[4:10].hex(" ") for p in sent()[begun:] if p[2:4] == b"\x31\x1a"] == ["04 00 00 00 00 00"]


def test_each_colour_is_enabled_in_its_own_field_alone() -> None:
    model = small_model()
    panel = open_dlpc900(modulator=SMALL, backend=VirtualUsb(model), exposure_us=5000, fields=3)
    assert isinstance(panel, FieldPanel)
    grays = np.stack([pattern(seed) for seed in range(3)])
    panel.show_fields(colours_in_turn(grays, [2, 0, 1], [1.0, 0.4, 0.0], panel.field_us))
    assert [model.leds(k) for k in range(3)] == [4, 1, 0]
    for k, gray in enumerate(grays):
        np.testing.assert_array_equal(model.plane(k), plm.bit_plane(gray, SMALL))
        entry = model.entries[k]
        assert entry.exposure_us + entry.dark_us == 5000 and entry.trigger_2 == (k == 0)
    panel.close()
    assert [model.leds(k) for k in range(3)] == [0, 0, 0]
    with pytest.raises(InputError, match="25 fields .* 24 at most"):
        open_dlpc900(backend=VirtualUsb(model), fields=25)
    with pytest.raises(InputError, match="lasers 0 to 2"):
        panel.show_fields([Field(grays[0], 8, 0, 1000)])
