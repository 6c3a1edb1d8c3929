"""Several patterns for each colour of a picture: a field each, lit by their colour's laser, whose light adds."""

from __future__ import annotations

import dataclasses
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import GatedLight, spot_shares
from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.headset.device_findings import _unlit
from runtime.service.client import Client, RefusedError
from runtime.service.configuration import read_configuration
from runtime.service.event_loop import EventLoop
from runtime.service.fault_log import FaultLog
from runtime.service.frame_pipeline import FramePipeline
from runtime.service.frame_solver import PatternSolver, brightest_spots, open_solver
from runtime.service.metrics import Metrics
from runtime.service.process_messages import SOLVER, PatternRing
from runtime.service.protocol import LaserState, PartState, Shown
from runtime.service.shared_memory import crc32, make_ring
from runtime.service.socket_link import MessageLink
from runtime.solver import Quality, quality, shown, solve
from tests.campaigns.headset import SHAPE, connected, hardware, served, write_configuration
from tests.campaigns.lane import Lane
from tests.runtime.benches import converted, ideal_path, scene

pytestmark = pytest.mark.usefixtures("real_time")

BLACK = 64  # counts of the simulated camera without light


def linear(value: float = 1.0) -> np.ndarray:
    """A picture with sharp edges, irradiance [H, W]."""
    return (value * scene(SHAPE) / scene(SHAPE).max()).astype(np.float32)


def solved(file: Path, target: np.ndarray, milliseconds: float = 400.0) -> tuple[PatternSolver, list]:
    solver = open_solver(read_configuration(file))
    return solver, list(solver.patterns(target, time.monotonic_ns() + int(1e6 * milliseconds)))


def mean_light(grays: Sequence[np.ndarray]) -> np.ndarray:
    path = converted(ideal_path(SHAPE, 6e-3), np.float32)
    return np.mean([shown(path, gray) for gray in grays], axis=0)


def test_two_patterns_of_one_colour_are_nearer_to_the_picture_than_one(tmp_path: Path) -> None:
    # one pattern of four levels is far from any picture, however long it is solved: the test does not hang on time
    levels = tuple(range(0, 256, 64))
    path = dataclasses.replace(ideal_path(SHAPE, 6e-3, 0.7, np.float32), gray_levels=levels)
    found: dict[int, Quality] = {}
    white = shown(path, solve(path, np.ones(SHAPE), 1, frames=2, grid="panel").gray[0]).mean()
    for patterns in (1, 2, 4):
        solver = PatternSolver({"green": path}, frames=patterns, grid="panel")
        assert solver.shape == (1, *SHAPE) and solver.fields == patterns
        made = list(solver.patterns(linear()[None], time.monotonic_ns() + 1_000_000_000))
        last = made[-1]
        assert [p.final for p in made] == [False, True] and last.gray.shape == (patterns, *SHAPE)
        assert len({crc32(gray) for gray in last.gray}) == patterns
        light = [shown(path, gray) for gray in last.gray]
        assert len(last.brightness) == (patterns > 1)
        for share in last.brightness:  # what the picture needs, of the time that white needs
            assert share == pytest.approx(linear().mean() * white / np.mean(light), rel=0.1)
        found[patterns] = quality(np.mean(light, axis=0), linear())
        alone = [quality(one, linear()).psnr_db for one in light]
        assert found[patterns].psnr_db > max(alone) + (1 if patterns > 1 else -0.01)
    assert min(found[2].psnr_db, found[4].psnr_db) > found[1].psnr_db + 3


def test_patterns_of_three_colours_are_in_the_order_of_their_fields(tmp_path: Path) -> None:
    """All colours in turn, and again; a colour that the picture lacks is dark in all of its fields."""
    target = np.stack([linear(), np.zeros(SHAPE, np.float32), linear(0.5)[::-1]])
    solver, made = solved(write_configuration(tmp_path, colours=True, patterns=2), target)
    assert solver.shape == (3, *SHAPE) and solver.fields == 6
    gray = made[-1].gray
    assert gray.shape == (6, *SHAPE) and [bool(one.any()) for one in gray] == [True, False, True] * 2
    for colour in (0, 2):
        assert quality(mean_light(gray[colour::3]), target[colour]).psnr_db > 15
    first, without, third = made[-1].brightness
    given = [mean_light(gray[colour::3]).mean() for colour in (0, 2)]
    assert without == 0 and first * given[0] == pytest.approx(2 * third * given[1], rel=0.02)
    (dark,) = solver.patterns(np.zeros_like(target), time.monotonic_ns())
    assert dark.dark and dark.gray.shape == (6, *SHAPE) and dark.brightness == (0, 0, 0)


def test_a_dark_colour_has_as_much_less_light_as_the_picture_says() -> None:
    """Behind a half-open iris a dark picture gets less of its pattern's light than a bright one."""
    path = ideal_path(SHAPE, 6e-3, 0.5, np.float32)
    solver = PatternSolver({"red": path, "green": path}, grid="panel")
    target = np.stack([linear(), linear() ** 4])
    *_, last = solver.patterns(target, time.monotonic_ns() + 400_000_000)
    light = np.stack([shown(path, gray) for gray in last.gray])
    alone = [one.sum() / wanted.sum() for one, wanted in zip(light, target, strict=True)]
    assert alone[1] / alone[0] < 0.95 * target[0].mean() / target[1].mean(), "not in proportion to its mean"
    balanced = light * np.array(last.brightness)[:, None, None]
    red, green = (one.sum() / wanted.sum() for one, wanted in zip(balanced, target, strict=True))
    assert green == pytest.approx(red, rel=0.03)


def test_the_next_picture_of_a_video_starts_from_the_patterns_before(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, patterns=2)
    solver, made = solved(file, linear()[None])
    (again,) = solver.patterns(linear()[None], time.monotonic_ns())
    # a fast machine comes nearer than 90 dB, where single precision and the floor in the dark decide
    assert min(again.psnr_db, 60) == pytest.approx(min(made[-1].psnr_db, 60), abs=0.5)
    moved = np.roll(linear(), 1, axis=1)[None]
    (first,) = solver.patterns(moved, time.monotonic_ns())
    cold = open_solver(read_configuration(file))
    (fresh,) = cold.patterns(moved, time.monotonic_ns())
    assert len({crc32(gray) for gray in first.gray}) == 2
    assert first.psnr_db > fresh.psnr_db + 1


def test_bright_spots_are_those_of_the_worst_pattern() -> None:
    path, rng = converted(ideal_path(SHAPE, 6e-3), np.float32), np.random.default_rng(4)
    grays = rng.integers(0, 256, (3, *SHAPE), dtype=np.uint8)
    each = [spot_shares(shown(path, gray), 2.0) for gray in grays]
    found = brightest_spots(path, grays, 2.0)
    assert found == tuple(max(shares) for shares in zip(*each, strict=True))
    assert all(a >= b for a, b in zip(found, spot_shares(mean_light(grays), 2.0), strict=True))


def until_lit(client: Client, remote: RemoteHardware, picture: np.ndarray, within_s: float = 30.0) -> None:
    """Clear, arm and show until the lasers emit; again where a busy machine stalled."""
    end = time.monotonic() + within_s
    while client.status().lasers != LaserState.EMITTING or remote.light()[-1][1] == 0:
        assert time.monotonic() < end, (client.status(), remote.light()[-1])
        if client.status().lasers in (LaserState.OFF, LaserState.FAULT):
            with suppress(RefusedError):
                client.clear()
                client.arm()
        show(client, picture)


def show(client: Client, picture: np.ndarray, frames: int = 3) -> None:
    outcomes = []
    for _ in range(frames):
        client.show(picture)
        outcomes += list(client.outcomes())
    while client.in_flight:
        outcomes += list(client.outcomes(5))
    assert all(isinstance(o, Shown) for o in outcomes), outcomes


def seen(folder: Path, patterns: int) -> tuple[Quality, set[int], float]:
    """What the camera sees of one picture in green: its quality, the lasers' masks, and µW while it is lit."""
    folder.mkdir()
    file = write_configuration(folder, 10.0, 70.0, patterns=patterns, half_width=0.5)
    # gated to half of the time, and to the picture's brightness, light needs 5 times as long for as little noise
    file.write_text(file.read_text() + f"exposure_ms = {10.0 if patterns == 1 else 50.0}\n")
    with hardware(folder) as remote, served(file) as _, connected(file) as client:
        end = time.monotonic() + 20
        while {client.status().panel, client.status().camera} != {PartState.FRESH}:
            assert time.monotonic() < end
            time.sleep(0.01)
        picture = np.rint(65535 * linear()[None]).astype(np.uint16)
        until_lit(client, remote, picture)
        light = np.zeros(SHAPE)
        for _ in range(12):
            show(client, picture, 2)
            for _ in range(4):
                light += client.capture().astype(float) - BLACK
        until_lit(client, remote, picture)
        return quality(light, linear()), {mask for _, mask in remote.lit()}, remote.light()[-1][1]


def test_on_emulated_hardware_the_camera_sees_less_speckle_with_more_patterns(tmp_path: Path) -> None:
    (one, none, one_uw), (two, masks, two_uw) = (seen(tmp_path / str(n), n) for n in (1, 2))
    assert two.psnr_db > one.psnr_db + 1 and two.nrmse < one.nrmse
    assert none == set() and masks == {2}, "one pattern is not gated; of two, each had green light alone"
    assert one_uw == pytest.approx(50, rel=0.02) and two_uw == pytest.approx(50, rel=0.02)


@pytest.mark.parametrize("colours", [False, True])
def test_no_light_in_a_wrong_field_while_the_panels_link_fails(tmp_path: Path, colours: bool) -> None:
    lane = Lane(tmp_path, 0, colours=colours, patterns=2)
    try:
        assert lane.light_up()
        for kind in ("torn_field", "swapped_gate", "missing_field"):
            lane.remote.break_part("panel link", kind, 20)
            for _ in range(8):
                lane.frame()
            lane.remote.repair("panel link")
        assert lane.light_up()
        assert lane.unanswered() == 0
        assert lane.lit_fields() > 10 and lane.wrongly_lit() == 0 and lane.torn() == 0
        assert {mask for _, mask in lane.remote.lit()} == ({1, 2, 4} if colours else {2})
    finally:
        lane.close()


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("fields = 6\n", "fields = 4\n", "fields = 4 and 3 colours"),
        ("fields = 6\n", "fields = 25\n", "fields"),
        ("fields = 6\n", "", "fields = 3 in [panel] to show them in turn"),
    ],
)
def test_fields_that_are_no_multiple_of_the_colours_are_refused(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    file = write_configuration(tmp_path, colours=True, patterns=2)
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    with pytest.raises(InputError) as caught:
        open_solver(read_configuration(file))
    assert message in str(caught.value)


def test_power_that_three_colours_may_have_is_refused_for_three_patterns_of_one(tmp_path: Path) -> None:
    """0.9 mW at 520 nm are 2.3 of a point source's limit: 0.38 in a sixth of the time, and 1.15 in half of it."""
    file = write_configuration(tmp_path, colours=True)
    drive = "threshold_ma = 30.0, slope_uw_per_ma = 40.0"
    lasers = ", ".join(
        f"{{ name = '{name}', wavelength_nm = {nm}, full_power_uw = {uw}, {drive} }}"
        for name, nm, uw in (("red", 638.0, 1.0), ("green", 520.0, 900.0), ("blue", 450.0, 1.0))
    )
    text = file.read_text().replace(
        "power = { red = 0.5, green = 0.5, blue = 0.5 }",
        f"channel = [{lasers}]\npower = {{ red = 1.0, green = 1.0, blue = 1.0 }}",
    )
    file.write_text(text)
    assert open_solver(read_configuration(file)).fields == 3
    file.write_text(text.replace("[service]\n", "[service]\nchannel = 'green'\n"))
    with pytest.raises(
        InputError, match=r"1\.1\d of the Class 1 budget of one spot, with each laser in 3 of"
    ):
        open_solver(read_configuration(file))


def parts(file: Path) -> FramePipeline:
    """The pipeline of a configuration, with no process started."""
    loop, metrics = EventLoop(), Metrics()
    settings = read_configuration(file)
    captures: Any = SimpleNamespace(lost=lambda why: None)
    return FramePipeline(
        settings, loop, FaultLog(metrics), metrics, lambda shares, then: then(), lambda send: captures
    )


def test_the_light_of_panel_and_lasers_is_that_of_the_colours_that_are_shown(tmp_path: Path) -> None:
    """Until the solver has said them, each laser counts as lit in every field: half of the time at most."""
    pipeline = parts(write_configuration(tmp_path, colours=True, patterns=2))
    assert pipeline.gated == GatedLight(0.5, 0.0005, 0.006, pulses=6)
    pipeline.solver.colours = ("red", "green", "blue")
    assert pipeline.gated == GatedLight(1 / 6, 0.0005, 0.006, pulses=2)
    (tmp_path / "one").mkdir()
    assert parts(write_configuration(tmp_path / "one")).gated is None


def test_a_solver_that_comes_back_with_other_colours_is_ended(tmp_path: Path) -> None:
    """The lasers' power is budgeted for the colours that it had."""
    pipeline = parts(write_configuration(tmp_path, colours=True))
    client = pipeline.solver
    ours, theirs = linked()
    for colours, ready in (("red,green,blue", True), ("green", False), ("red,green,blue", True)):
        client.process.link = ours
        ring = make_ring(4, (3, *SHAPE), np.uint8)
        theirs.send(PatternRing(4, 3, len(colours.split(",")), *SHAPE, colours), fds=[ring.fd])
        client._read()
        assert client.ready == ready and client.colours == ("red", "green", "blue")
        ours, theirs = linked()
    assert pipeline.display.lit_colours is None


def linked() -> tuple[MessageLink, MessageLink]:
    return tuple(MessageLink(one, SOLVER) for one in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))  # type: ignore[return-value]


def test_only_the_laser_of_the_colour_that_is_shown_needs_power(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, colours=True)
    text = file.read_text().replace("{ red = 0.5, green = 0.5, blue = 0.5 }", "{ green = 0.5 }")
    file.write_text(text)
    assert [p.split(" and ")[0] for p in _unlit(read_configuration(file))] == [
        "the service shows red",
        "the service shows blue",
    ]
    file.write_text(text.replace("[service]\n", "[service]\nchannel = 'green'\n"))
    assert _unlit(read_configuration(file)) == []
