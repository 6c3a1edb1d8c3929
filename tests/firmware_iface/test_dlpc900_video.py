"""TI's phase light modulator on a display link: its bits on a screen, its pattern table over USB."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel import FieldPanel, MirroredDisplay, Panel, dlpc900, dlpc900_commands, open_dlpc900
from firmware_iface.panel import phase_light_modulator as plm
from firmware_iface.panel.fields import Field, colours_in_turn
from firmware_iface.virtual.usb import Dlpc900Model, VirtualUsb

from .frame_buffer import SHAPE, Screen
from .usb_transcript import Transcript

MODULATOR = replace(plm.P47, shape=SHAPE)
MEMORY = MODULATOR.memory_shape
FIELD_US = 5555  # three in a frame of a display of 60 Hz


class Bench:
    """A screen, and a controller that sees what it scans out."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.screen, self.model = Screen(folder, columns=20, rows=24), Dlpc900Model(MEMORY)
        monkeypatch.setattr(
            dlpc900,
            "MirroredDisplay",
            partial(MirroredDisplay, settle_s=0, devices=self.screen.devices, settings=self.screen.settings),
        )
        monkeypatch.setattr(dlpc900_commands, "LOCK_S", 0.05)
        self.bus = Transcript(self.model, longest=64)

    def connect(self, colours: tuple[int, int, int] = (16, 8, 0)) -> None:
        """Switch the display link on; the first bit of what the screen has as red, green and blue."""
        weights = [1 << at for at in colours]
        self.model.video = lambda: self.screen.scanned_out(MEMORY).astype(np.uint32) @ [*weights, 0]

    def opened(self, fields: int = 1) -> Panel:
        exposure_us = FIELD_US if fields > 1 else 16000
        return open_dlpc900(
            1,
            modulator=MODULATOR,
            backend=VirtualUsb(self.model),
            timeout_s=0.1,
            fields=fields,
            exposure_us=exposure_us,
        )


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, monkeypatch)


def shown(model: Dlpc900Model, number: int) -> np.ndarray:
    """Gray levels of 1/256 wave that the mirrors show during pattern `number` of the table, by the model."""
    entries = model.entries
    model.entries = {0: entries[number]}
    try:
        return model.gray
    finally:
        model.entries = entries


def patterns(seed: int, count: int = 3) -> np.ndarray:
    """Patterns of levels that the mirrors have."""
    states = np.rint(plm.phase_waves() * 256).astype(np.uint8)
    return np.random.default_rng(seed).choice(states, (count, *SHAPE))


def test_control_over_usb_and_frames_over_the_display_link_make_one_panel(bench: Bench) -> None:
    """The two parts are separate: a phase light modulator in video-pattern mode, its bits on the screen."""
    model = bench.model
    with pytest.raises(DeviceError, match="no picture on displayport"):
        bench.opened()
    bench.connect()
    panel = bench.opened()
    assert panel.shape == SHAPE
    assert panel.status()["mode"] == "video-pattern" and panel.status()["running"]
    gray = patterns(1)[0]
    panel.show(gray)
    np.testing.assert_array_equal(model.gray, gray)
    assert not model.images, "nothing was uploaded"
    assert model.entries[0].waits and model.leds(0) == 7 and panel.status()["faults"] == []


@pytest.mark.parametrize("order", [(16, 8, 0), (8, 16, 0), (0, 8, 16)])
def test_three_colours_in_turn_whatever_colour_of_the_link_comes_first(
    bench: Bench, order: tuple[int, int, int]
) -> None:
    bench.connect(order)
    panel, model = bench.opened(3), bench.model
    assert isinstance(panel, FieldPanel) and panel.field_us == FIELD_US
    assert model.running and model.leds(0) == 0, "dark until there is a frame"
    grays = patterns(2)
    panel.show_fields(colours_in_turn(grays, [2, 0, 1], [1.0, 0.4, 0.0], FIELD_US))
    for k, gray in enumerate(grays):
        np.testing.assert_array_equal(shown(model, k), gray)
    assert [model.leds(k) for k in range(3)] == [4, 1, 0]
    assert [model.entries[k].exposure_us for k in range(2)] == [2777, 1111]
    assert [model.entries[k].waits for k in range(3)] == [True, False, False]
    assert [model.entries[k].trigger_2 for k in range(3)] == [True, False, False]
    starts = np.cumsum([0] + [e.exposure_us + e.dark_us for e in model.entries.values()])
    np.testing.assert_array_equal(starts[:3], FIELD_US * np.arange(3))
    assert starts[3] <= 0.96 * 3 * FIELD_US, "over before the display's next frame"
    assert panel.status()["faults"] == []
    panel.close()
    assert [model.leds(k) for k in range(3)] == [0, 0, 0] and not bench.screen.scanned_out(MEMORY).any()


def test_eight_fields_and_not_nine(bench: Bench) -> None:
    bench.connect()
    bench.model.video_frame_us = 8 * FIELD_US
    panel = bench.opened(8)
    assert isinstance(panel, FieldPanel)
    grays = patterns(3, 9)
    panel.show_fields([Field(gray, 1 << k % 3, 0, 1000) for k, gray in enumerate(grays[:8])])
    for k, gray in enumerate(grays[:8]):
        np.testing.assert_array_equal(shown(bench.model, k), gray)
    with pytest.raises(InputError, match="9 fields cannot be shown; give 1 to 8"):
        panel.show_fields([Field(gray, 1, 0, 1000) for gray in grays])
    with pytest.raises(InputError, match="9 fields does not fit; ask for 8"):
        bench.opened(9)


def test_the_table_is_sent_again_only_where_light_changes_and_nothing_is_lit_meanwhile(bench: Bench) -> None:
    bench.connect()
    panel, model = bench.opened(3), bench.model
    assert isinstance(panel, FieldPanel)
    light = [0.5, 0.5, 0.5]

    def show(seed: int, shares: list[float]) -> int:
        """Shows a frame; how many commands that took beside the question whether it runs."""
        grays, before = patterns(seed), model.commands
        panel.show_fields(colours_in_turn(grays, [0, 1, 2], shares, FIELD_US))
        for k, gray in enumerate(grays):
            np.testing.assert_array_equal(shown(model, k), gray)
        return model.commands - before - 1

    table = 1 + 3 + 1 + 1  # stop, three lines, how many they are, start
    assert show(0, light) == table
    assert show(1, light) == 0
    assert show(2, [0.51, 0.5, 0.49]) == 0, "as good as alike"
    assert show(3, [0.53, 0.5, 0.5]) == table
    assert model.entries[0].exposure_us == round(0.53 * (FIELD_US // 2))
    assert show(4, [0.53, 0.5, 0.0]) == table and model.leds(2) == 0
    lit_while_drawn = []
    draw = panel.frames._display.send
    panel.frames._display.send = lambda picture: lit_while_drawn.append(model.leds(0)) or draw(picture)
    assert show(5, [1.0, 0.5, 0.0]) == table and lit_while_drawn == [0]


def test_after_a_fault_the_next_frame_brings_its_table_along(bench: Bench) -> None:
    bench.connect()
    panel, model = bench.opened(3), bench.model
    assert isinstance(panel, FieldPanel)
    frame = colours_in_turn(patterns(0), [0, 1, 2], [1.0, 0.5, 0.2], FIELD_US)
    panel.show_fields(frame)
    brighter = colours_in_turn(patterns(1), [0, 1, 2], [1.0, 1.0, 0.2], FIELD_US)
    model.faults.arm("stall", count=None, after=4)
    with pytest.raises(DeviceError):
        panel.show_fields(brighter)
    assert model.leds(0) == 0, "it was stopped"
    model.faults.clear()
    panel.show_fields(brighter)
    assert [model.leds(k) for k in range(3)] == [1, 2, 4] and model.entries[1].exposure_us == 2777
    model._run(0)
    with pytest.raises(DeviceError, match="does not run its patterns; show the frame again"):
        panel.show_fields(brighter)
    panel.show_fields(brighter)
    assert model.leds(1) == 2


def test_fields_that_do_not_fit_the_displays_frame_are_said(bench: Bench) -> None:
    bench.connect()
    panel = bench.opened(3)
    assert isinstance(panel, FieldPanel)
    with pytest.raises(
        InputError, match="field 2 lasts nearly until the display's next frame.*5% of a frame"
    ):
        panel.show_fields([Field(gray, 1, 0, 5000) for gray in patterns(0)])
    bench.model.video_frame_us = 8333
    panel.show_fields(colours_in_turn(patterns(0), [0, 1, 2], [1.0, 1.0, 1.0], FIELD_US))
    assert panel.status()["faults"] == ["sequence aborted"]


def test_the_bytes_of_a_table_for_the_display_link(bench: Bench) -> None:
    """As in the example of TI's guide (DLPU018J, table 5-1): the first line waits for the display's frame."""
    bench.connect()
    panel = open_dlpc900(1, modulator=MODULATOR, backend=bench.bus, fields=3, exposure_us=5000)
    assert isinstance(panel, FieldPanel)
    begun = len(bench.bus.lines)
    gray = patterns(0)
    panel.show_fields([Field(gray[0], 1, 0, 200), Field(gray[1], 2, 0, 400), Field(gray[2], 0, 0, 0)])
    sent = [bytes.fromhex(line[5:])[2:] for line in bench.bus.lines[begun:] if line.startswith("01 >")]
    assert [p[: 2 + p[0]].hex(" ") for p in sent[:-1]] == [
        "03 00 24 1a 00",
        "0e 00 34 1a 00 00 c8 00 00 90 c0 12 00 00 00 00",
        "0e 00 34 1a 01 00 90 01 00 21 f8 11 00 01 00 08",
        "0e 00 34 1a 02 00 69 00 00 01 31 10 00 01 00 10",
        "08 00 31 1a 03 00 00 00 00 00",
        "03 00 24 1a 02",
    ]
