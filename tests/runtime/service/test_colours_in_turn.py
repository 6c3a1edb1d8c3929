"""The service in full colour over emulated hardware: a pattern a colour, each in its own field and its own light."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.headset.device_findings import headset_findings
from runtime.service.client import Client, RefusedError
from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import open_solver
from runtime.service.protocol import LaserState, PartState, Shown
from runtime.service.shared_memory import crc32
from runtime.solver import shown
from tests.campaigns.headset import connected, hardware, picture, served, write_configuration
from tests.campaigns.lane import Lane
from tests.runtime.benches import converted, ideal_path
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("real_time")


class Headset(NamedTuple):
    file: Path
    remote: RemoteHardware
    client: Client


@pytest.fixture(scope="module")
def headset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Headset]:
    file = write_configuration(tmp_path_factory.mktemp("headset"), colours=True)
    with hardware(file.parent) as remote, served(file), connected(file) as client:
        until(lambda: {client.status().panel, client.status().camera} == {PartState.FRESH}, 20)
        yield Headset(file, remote, client)


def colours(client: Client, *brightness: float) -> np.ndarray:
    """A picture with these colours, uint16 [3, H, W]."""
    grays = picture(client, 1).astype(float)[1] / 45875
    return np.clip(65535 * np.array(brightness)[:, None, None] * grays, 0, 65535).astype(np.uint16)


def show(client: Client, shown: np.ndarray, frames: int = 3) -> list[Shown]:
    outcomes = []
    for _ in range(frames):
        client.show(shown)
        outcomes += list(client.outcomes())
    while client.in_flight:
        outcomes += list(client.outcomes(5))
    assert all(isinstance(o, Shown) for o in outcomes), outcomes
    return [o for o in outcomes if isinstance(o, Shown)]


def lit_up(headset: Headset, shown: np.ndarray, power_uw: float) -> None:
    """Clear, arm and show until the lasers emit this much; again where a busy machine stalled."""
    client, end = headset.client, time.monotonic() + 30
    while headset.remote.light()[-1][1] != pytest.approx(power_uw, rel=0.02):
        assert time.monotonic() < end, (client.status(), headset.remote.light()[-1])
        if client.status().lasers in (LaserState.OFF, LaserState.FAULT):
            with suppress(RefusedError):
                client.clear()
                client.arm()
        show(client, shown)


def seen(headset: Headset, shown: np.ndarray) -> np.ndarray:
    """The camera's counts above black while a picture is lit."""
    lit_pixels = None
    for _ in range(5):
        show(headset.client, shown, 2)
        lit_pixels = headset.client.capture().astype(float) - 64
    assert lit_pixels is not None
    return lit_pixels


def test_a_picture_has_three_channels_and_every_field_its_own_light(headset: Headset) -> None:
    client = headset.client
    assert client.shape == (3, 24, 32) and client.welcome.channels == 3
    white = colours(client, 1.0, 1.0, 1.0)
    lit_up(headset, white, 0.5 * 235)
    outcomes = show(client, white, 10)
    assert len({o.pattern_crc for o in outcomes}) <= 10 and all(o.psnr_db > 10 for o in outcomes)
    lasers = {mask for _, mask in headset.remote.lit()}
    assert lasers == {1, 2, 4}, "each field has one laser's light"
    until(lambda: show(client, white) and seen(headset, white).mean() > 3, 20)


def test_a_colour_that_a_picture_lacks_is_dark_and_the_others_are_lit(headset: Headset) -> None:
    """Its laser stays armed and its gate closed: no fault, and it is back with the next picture."""
    client = headset.client
    white, red = colours(client, 1.0, 1.0, 1.0), colours(client, 1.0, 0.0, 0.0)
    lit_up(headset, white, 0.5 * 235)
    show(client, red, 3)
    before = headset.remote.lit()
    show(client, red, 20)
    assert {mask for _, mask in headset.remote.lit() - before} <= {1}
    until(lambda: show(client, red) and headset.remote.light()[-1][1] == pytest.approx(60, rel=0.02), 5)
    assert client.status().lasers == LaserState.EMITTING
    lit_up(headset, white, 0.5 * 235)


def test_light_is_in_proportion_to_a_colours_brightness(headset: Headset) -> None:
    client = headset.client
    lit_up(headset, colours(client, 1.0, 1.0, 1.0), 0.5 * 235)
    full, half = (
        np.mean([seen(headset, colours(client, light, 0.0, 0.0)).mean() for _ in range(4)])
        for light in (1.0, 0.5)
    )
    assert 0.3 < half / full < 0.7


def test_a_refinement_says_that_it_is_of_one_colour(headset: Headset) -> None:
    client, white = headset.client, colours(headset.client, 1.0, 1.0, 1.0)
    show(client, white)
    client.dark()
    until(lambda: refined(client), 20)
    show(client, white)
    until(lambda: list(client.outcomes()) is not None and client.refined is not None, 20)
    assert client.refined is not None and "several are shown in turn" in client.refined.text


def refined(client: Client) -> bool:
    """Whether a refinement was begun: it needs a picture of the camera in darkness."""
    with suppress(RefusedError):
        client.refine(4)
        return True
    return False


def test_no_light_in_a_wrong_field_while_the_panels_link_fails(tmp_path: Path) -> None:
    lane = Lane(tmp_path, 0, colours=True)
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
    finally:
        lane.close()


def test_its_devices_answer_and_a_laser_without_power_is_named(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, colours=True)
    with hardware(tmp_path):
        found = {one.part: one for one in headset_findings(read_configuration(file))}
        assert not any(one.problems for one in found.values()), found
        assert found["panel"].status["fields"] == found["panel"].status["fields_kept_dark"] == 0
        file.write_text(file.read_text().replace(", blue = 0.5", ""))
        (problem,) = {one.part: one for one in headset_findings(read_configuration(file))}["lasers"].problems
    assert "shows blue and its laser gets no power" in problem


def test_patterns_of_three_colours_by_a_deadline(tmp_path: Path) -> None:
    solver = open_solver(read_configuration(write_configuration(tmp_path, colours=True)))
    assert solver.shape == (3, 24, 32) and solver.colours == ("red", "green", "blue")
    y, x = np.mgrid[0:24, 0:32]
    one = (0.5 + 0.4 * np.sin(0.3 * x + 0.2 * y)).astype(np.float32)
    target = np.stack([one, np.zeros_like(one), 0.5 * one[::-1]])
    path = converted(ideal_path((24, 32), 6e-3), np.float32)
    made = list(solver.patterns(target, time.monotonic_ns() + 500_000_000))
    assert [p.final for p in made] == [False, True] and made[1].psnr_db >= made[0].psnr_db
    for pattern in made:
        assert pattern.gray[0].any() and pattern.gray[2].any() and not pattern.gray[1].any()
        first, _, third = (
            t * shown(path, g).mean() for t, g in zip(pattern.brightness, pattern.gray, strict=True)
        )
        assert pattern.brightness[1] == 0 and third == pytest.approx(first / 2, rel=0.05)
        assert crc32(pattern.gray[0]) != crc32(pattern.gray[2])
    (dark,) = solver.patterns(np.zeros_like(target), time.monotonic_ns())
    assert dark.dark and dark.final and dark.brightness == (0, 0, 0)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("fields = 3\n", "", "fields = 3 in [panel] to show them in turn"),
        ("fields = 3\n", "fields = 2\n", "fields = 2 and 3 colours"),
        ("fields = 3\n", "fields = 5\n", "fields = 5 and 3 colours"),
        ("refresh_hz = 1000.0", "refresh_hz = 100.0", "33.3 a second"),
        ("fields = 3\n", "fields = 3\nkind = 'mirrored'\n", "shows one colour"),
        (
            "power = {",
            "channel = [{ name = 'green', wavelength_nm = 520.0, full_power_uw = 9.0, threshold_ma = 30.0, "
            "slope_uw_per_ma = 4.0 }]\npower = { green = 0.5 } #",
            "no laser 'red'",
        ),
    ],
)
def test_what_does_not_fit_together_says_why(tmp_path: Path, before: str, after: str, message: str) -> None:
    file = write_configuration(tmp_path, colours=True)
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    with pytest.raises(InputError) as caught:
        open_solver(read_configuration(file))
    assert message in str(caught.value)


def test_the_power_of_all_lasers_is_budgeted_as_the_sum_over_the_fields(tmp_path: Path) -> None:
    """Each at 60 uW of 450 nm: 1.5 of the limit alone, and three of them in turn for a sixth of the time each 0.77."""
    file = write_configuration(tmp_path, colours=True)
    laser = "wavelength_nm = 450.0, full_power_uw = 60.0, threshold_ma = 30.0, slope_uw_per_ma = 4.0"
    lasers = ", ".join(f"{{ name = '{name}', {laser} }}" for name in ("red", "green", "blue"))
    text = file.read_text().replace(
        "power = { red = 0.5, green = 0.5, blue = 0.5 }",
        f"channel = [{lasers}]\npower = {{ red = 1.0, green = 1.0, blue = 1.0 }}",
    )
    file.write_text(text)
    read_configuration(file)
    file.write_text(text.replace("fields = 3\n", ""))
    with pytest.raises(InputError, match=r"4\.62 of the Class 1 budget"):
        read_configuration(file)
