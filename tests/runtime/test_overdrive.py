"""A slow panel: tables by the effect's own physics, patterns by what was really sent, pictures on a simulated bench."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from firmware_iface.panel.fields import colours_in_turn
from firmware_iface.virtual import VirtualHeadset, load_bench, make_defect
from firmware_iface.virtual.bench_description import CameraDescription, ChannelDescription
from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.bundle.light_path_arrays import load_light_path, pack_light_paths, slow_response_share
from runtime.lightpath import ideal_path as ideal
from runtime.lightpath.overdrive import NEAREST, REACHED, STRAIGHT, overdrive_tables
from runtime.service.configuration import read_configuration
from runtime.service.frame_solver import PatternSolver, brightest_spots, open_solver
from runtime.service.slow_panel import MOVING, SlowPanel, slow_panel
from runtime.solver import Solver, quality
from tests.campaigns.headset import write_configuration
from tests.runtime.benches import ideal_path, scene

SHAPE, DISTANCE_MM, IRIS = (48, 64), 12.0, 0.7
BLACK = 64  # counts of the simulated camera without light
LINEAR = 2 * np.pi * np.arange(256) / 256
FAR = 2 * np.pi * np.arange(256) / 200  # more than a wave


def bent(waves: float = 1.0) -> np.ndarray:
    """A response that is steep in the middle, rad."""
    t = np.arange(256) / 256
    return 2 * np.pi * waves * (t - 0.1 * np.sin(2 * np.pi * t))


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of phases on the circle, rad."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("response", [LINEAR, FAR, -FAR, bent(), bent(1.3)])
@pytest.mark.parametrize("share", [0.03, 0.1, 0.3, 0.7])
def test_what_is_sent_brings_the_wanted_phase_wherever_it_can_be_reached(
    response: np.ndarray, share: float
) -> None:
    tables = overdrive_tables(response, share)
    before, wanted = response[:, None], response[None, :]
    ends = (1 - share) * np.array([response.min(), response.max()])
    reachable = (wanted - share * before >= ends[0]) & (wanted - share * before <= ends[1])
    half_a_level = np.abs(np.diff(response)).max() / 2 + 1e-9
    for way in (NEAREST, STRAIGHT):
        shown = (1 - share) * response[tables[way]] + share * before
        assert np.abs(shown - wanted)[reachable].max() <= half_a_level
    # elsewhere no gray level comes nearer, on the circle of one wave or without it
    every = (1 - share) * response[:, None] + share * response[None, :]  # [sent, before]
    for b in range(0, 256, 15):
        for w in np.flatnonzero(~reachable[b])[::7]:
            errors = apart(every[:, b], response[w])
            assert errors[tables[NEAREST, b, w]] <= errors.min() + 1e-9
            errors = np.abs(every[:, b] - response[w])
            assert errors[tables[STRAIGHT, b, w]] <= errors.min() + 1e-9


@pytest.mark.parametrize("share", [0.03, 0.3, 0.9])
def test_a_level_that_is_shown_already_is_sent_as_it_is(share: float) -> None:
    for response in (LINEAR, FAR, bent()):
        tables = overdrive_tables(response, share)
        same = np.arange(256)
        for table in tables:
            assert np.array_equal(np.diag(table), same)


def test_the_level_that_is_reached_is_the_physics_own() -> None:
    tables = overdrive_tables(bent(), 0.2)
    before, sent = np.mgrid[0:256, 0:256]
    reached = 0.8 * bent()[sent] + 0.2 * bent()[before]
    off = np.abs(bent()[tables[REACHED]] - reached)
    further = tables[REACHED] != before
    nearest = np.abs(bent()[:, None, None] - reached).min(0)
    assert np.all(further | (before == sent)), "one level on at least"
    assert np.mean(off <= nearest + 1e-9) > 0.98 and off.max() < 2 * np.diff(bent()).max()


def test_few_gray_levels_are_the_only_ones_that_are_sent() -> None:
    few = tuple(range(0, 256, 17))
    tables = overdrive_tables(LINEAR, 0.3, few)
    assert set(np.unique(tables)) <= set(few)
    before, wanted = (a.ravel() for a in np.meshgrid(few, few, indexing="ij"))
    plain = apart(0.7 * LINEAR[wanted] + 0.3 * LINEAR[before], LINEAR[wanted])
    driven = apart(0.7 * LINEAR[tables[NEAREST, before, wanted]] + 0.3 * LINEAR[before], LINEAR[wanted])
    assert np.all(driven <= plain + 1e-9) and driven.mean() < 0.5 * plain.mean()


class Cells:
    """A panel's pixels by the effect's formula, in phase."""

    def __init__(self, response: np.ndarray, share: float, gray: np.ndarray) -> None:
        self.response, self.share, self.phase = response, share, response[gray]

    def show(self, gray: np.ndarray) -> np.ndarray:
        self.phase = (1 - self.share) * self.response[gray] + self.share * self.phase
        return self.phase


def random_patterns(count: int, fields: int = 1, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, fields, 40, 40), dtype=np.uint8)


@pytest.mark.parametrize("response", [LINEAR, FAR, bent()])
def test_a_video_is_nearer_to_its_patterns_and_its_end_converges_to_the_plain_pattern(
    response: np.ndarray,
) -> None:
    share, patterns = 0.2, random_patterns(8)
    panel = SlowPanel(overdrive_tables(response, share)[None])
    driven, plain = (Cells(response, share, np.zeros((40, 40), np.uint8)) for _ in range(2))
    errors: dict[str, list[float]] = {"driven": [], "plain": []}
    for k, wanted in enumerate(patterns):
        sent = panel.driven(wanted, k)
        if k == 0:
            assert np.array_equal(sent, wanted), "of what was before nothing is known"
        for name, cells, gray in (("driven", driven, sent), ("plain", plain, wanted)):
            off = apart(cells.show(gray[0]), response[wanted[0]])
            errors[name].append(float(np.sqrt(np.mean(off**2))))
    assert np.all(np.array(errors["driven"][2:]) < 0.5 * np.array(errors["plain"][2:]))
    assert not panel.settled
    sent, at = np.empty_like(wanted), len(patterns)
    while not panel.settled:
        again = panel.again(at)
        sent = sent if again is None else again
        driven.show(sent[0])
        at += 1
        assert at < len(patterns) + 20
    assert np.array_equal(sent, wanted) and at >= len(patterns) + MOVING
    assert np.abs(driven.phase - response[wanted[0]]).max() < 2 * np.abs(np.diff(response)).max()
    assert panel.again(at) is None
    assert np.array_equal(panel.driven(wanted, at), wanted), "a picture that stays is sent as it is"


def test_the_same_picture_from_a_program_ends_as_its_plain_pattern() -> None:
    panel = SlowPanel(overdrive_tables(LINEAR, 0.3)[None])
    first, wanted = random_patterns(2)
    panel.driven(first, 0)
    sent = [panel.driven(wanted.copy(), 1 + k) for k in range(16)]
    assert not np.array_equal(sent[0], wanted) and all(np.array_equal(s, wanted) for s in sent[-3:])


def test_a_still_picture_whose_patterns_change_a_little_is_not_left_a_wave_away() -> None:
    """As the solver's do while it goes on with them."""
    rng = np.random.default_rng(1)
    panel, cells = SlowPanel(overdrive_tables(LINEAR, 0.1)[None]), Cells(LINEAR, 0.1, np.full((40, 40), 250))
    panel.driven(np.full((1, 40, 40), 250, np.uint8), 0)
    off = []
    for k in range(1, 12):
        wanted = rng.integers(4, 8, (1, 40, 40), dtype=np.uint8)
        off.append(float(np.abs(cells.show(panel.driven(wanted, k)[0]) - LINEAR[wanted[0]]).max()))
    assert off[0] > 5 and max(off[-3:]) < 2 * LINEAR[1], "rad"


def test_what_is_captured_goes_straight_to_its_pattern() -> None:
    """As a refinement's, which learns from the camera."""
    tables = overdrive_tables(FAR, 0.3)
    panel = SlowPanel(tables[None])
    first, wanted = random_patterns(2)
    panel.driven(first, 0)
    sent = panel.driven(wanted, 1, straight=True)
    assert np.array_equal(sent[0], tables[STRAIGHT, first[0], wanted[0]])
    assert not np.array_equal(sent[0], tables[NEAREST, first[0], wanted[0]])


def test_the_state_is_that_of_what_was_really_sent() -> None:
    """Also where no pattern came in time: the panel has gone on towards the one that it had."""
    tables = overdrive_tables(LINEAR, 0.3)
    first, second, third = (np.full((1, 2, 2), gray, np.uint8) for gray in (0, 100, 60))
    late, soon = SlowPanel(tables[None]), SlowPanel(tables[None])
    for panel, at in ((late, 5), (soon, 2)):
        panel.driven(first, 0)
        sent = int(panel.driven(second, 1)[0, 0, 0])
        assert sent == tables[NEAREST, 0, 100] == 143
        before = 100
        for _ in range(at - 2):  # display times in which nothing was sent
            before = int(tables[REACHED, before, sent])
        assert int(panel.driven(third, at)[0, 0, 0]) == tables[NEAREST, before, 60]


def test_after_a_panel_was_lost_the_first_pattern_is_sent_as_it_is() -> None:
    panel = SlowPanel(overdrive_tables(LINEAR, 0.3)[None])
    patterns = random_patterns(4)
    for k in (0, 1):
        panel.driven(patterns[k], k)
    panel.forget()
    assert panel.again(2) is None and panel.settled
    assert np.array_equal(panel.driven(patterns[2], 3), patterns[2])
    assert not np.array_equal(panel.driven(patterns[3], 4), patterns[3])


def test_in_a_frame_of_several_fields_the_field_before_is_what_was_before() -> None:
    """Of three colours with responses of their own; the next frame's first field comes after this one's last."""
    share, responses = 0.2, (LINEAR * 0.8, LINEAR, FAR)
    tables = np.stack([overdrive_tables(response, share) for response in responses])
    panel = SlowPanel(tables)
    patterns = random_patterns(5, 6)
    turned = np.zeros((40, 40))  # as a gray level, which is one for all colours
    errors = []
    for k, wanted in enumerate(patterns):
        for field, gray in enumerate(panel.driven(wanted, k)):
            turned = (1 - share) * gray + share * turned
            response = responses[field % 3]
            shown = np.interp(turned, np.arange(256), response)
            off = apart(shown, response[wanted[field]])
            errors.append((float(np.mean(off**2)), field % 3))
    plain = np.mean(
        apart(0.8 * LINEAR[patterns[1, 1]] + 0.2 * LINEAR[patterns[1, 0]], LINEAR[patterns[1, 1]]) ** 2
    )
    for colour in range(3):
        assert max(e for e, c in errors[6:] if c == colour) < 0.3 * plain


def test_a_frame_that_is_repeated_is_right_in_its_last_pass() -> None:
    share = 0.2
    panel = SlowPanel(overdrive_tables(FAR, share)[None], passes=3)
    first, wanted = random_patterns(2, 2)
    panel.driven(first, 0)
    sent, cells = panel.driven(wanted, 1), Cells(FAR, share, first[-1])
    errors = [
        float(np.mean(apart(cells.show(gray), FAR[wanted[field]]) ** 2))
        for _ in range(3)
        for field, gray in enumerate(sent)
    ]
    assert max(errors[-2:]) < 2e-3 and errors[0] > 10 * max(errors[-2:])


def test_a_pattern_that_stays_for_several_periods_settles_by_itself() -> None:
    tables = overdrive_tables(LINEAR, 0.2)[None]
    assert slow_panel(None, 1, 1) is None and slow_panel(tables, 1, 2) is None
    assert slow_panel(tables, 1, 1) is not None and slow_panel(tables, 3, 2) is not None


def bundle(folder: Path, **panel: Any) -> Path:
    path = ideal_path(SHAPE, 1e-3 * DISTANCE_MM, IRIS, np.float32)
    records, arrays = pack_light_paths([("green", DISTANCE_MM, 520.0, path)])
    described = {"paths": records, "panel": {"levels": 256, **panel}, "distance_mm": DISTANCE_MM}
    write_bundle(folder, arrays, described, {})
    return folder


def test_a_bundle_says_the_share_and_one_without_is_as_before(tmp_path: Path) -> None:
    plain, slow = (
        read_bundle(bundle(tmp_path / name, **panel))
        for name, panel in (("plain", {}), ("slow", {"slow_response_share": 0.1}))
    )
    assert slow_response_share(plain) == 0 and slow_response_share(slow) == 0.1
    # a still pattern settles: the solver needs nothing, and makes the same
    grays = [Solver(load_light_path(one)).solve(scene(SHAPE), 5).gray for one in (plain, slow)]
    assert np.array_equal(*grays)


@pytest.mark.parametrize("share", [1, -0.1, "0.1", True, [0.1]])
def test_a_share_that_cannot_be_is_refused(tmp_path: Path, share: Any) -> None:
    with pytest.raises(InputError, match=r"'slow_response_share' .* from 0 to less than 1: export"):
        slow_response_share(read_bundle(bundle(tmp_path / "b", slow_response_share=share)))


def test_the_services_solver_has_tables_where_the_bundle_says_that_the_panel_is_slow(tmp_path: Path) -> None:
    files = [write_configuration(made, slow_share=s) for made, s in _folders(tmp_path, 0.0, 0.2)]
    plain, slow = (open_solver(read_configuration(file)) for file in files)
    assert plain.overdrive is None and slow.overdrive is not None
    path = ideal_path((24, 32), 6e-3, 1.0, np.float32)
    assert np.array_equal(slow.overdrive, overdrive_tables(path.response, 0.2)[None])


def test_the_predicted_bright_spots_are_raised_on_a_slow_panel() -> None:
    path = ideal_path(SHAPE, 1e-3 * DISTANCE_MM, IRIS, np.float32)
    for share in (0.0, 0.2):
        solver = PatternSolver({"green": path}, 2.0, slow_share=share, grid="panel")
        (made,) = solver.patterns(scene(SHAPE)[None].astype(np.float32), time.monotonic_ns())
        spots = np.array(brightest_spots(path, made.gray, 2.0))
        assert np.allclose(made.shares, np.minimum(1, spots / (1 - share)), rtol=1e-12)
        assert made.shares[0] < 0.5


def _folders(folder: Path, *shares: float) -> list[tuple[Path, float]]:
    made = [(folder / str(share), share) for share in shares]
    for one, _ in made:
        one.mkdir()
    return made


def bench(share: float) -> VirtualHeadset:
    """A lit headset whose camera has hardly any noise."""
    described = load_bench("virtual:ideal").resized(*SHAPE, DISTANCE_MM)
    described = replace(
        described,
        iris=replace(described.iris, half_width=IRIS),
        camera=CameraDescription(SHAPE[1], SHAPE[0], bit_depth=16, full_well_e=1e9, read_noise_e=0.0),
        defects=(make_defect("slow_response", share=share),),
    )
    headset = VirtualHeadset(described)
    headset.lasers.set_power("green", 1.0)
    return headset


def test_on_a_slow_bench_a_video_is_nearer_to_its_pictures_and_a_still_picture_stays() -> None:
    share = 0.2
    path = ideal_path(SHAPE, 1e-3 * DISTANCE_MM, IRIS, np.float32)
    pictures = [scene(SHAPE), np.roll(scene(SHAPE)[::-1, ::-1], 7, 1), np.roll(scene(SHAPE), 20, 1)]
    patterns = [Solver(path).solve(picture, 30).gray[None] for picture in pictures]
    seen: dict[bool, list[float]] = {}
    for overdriven in (False, True):
        headset, found = bench(share), []
        panel = SlowPanel(overdrive_tables(path.response, share)[None])
        for k in range(22):
            shown = k % 3 if k < 9 else 0  # a video, then a still picture
            gray = patterns[shown]
            headset.panel.show((panel.driven(gray, k) if overdriven else gray)[0])
            light = headset.camera.capture().astype(float) - BLACK
            found.append(quality(light, pictures[shown]).psnr_db)
        seen[overdriven] = found
    gained = np.array(seen[True][3:9]) - np.array(seen[False][3:9])
    assert gained.min() > 6, "dB, of pictures that change with each frame"
    assert seen[True][-1] == pytest.approx(seen[False][-1], abs=0.02), "and a still one is the same"


def test_on_a_slow_bench_colours_in_turn_are_nearer_to_their_pictures() -> None:
    """Each field is seen alone, in its own laser's light; the frame is repeated, as the panel does."""
    share, colours = 0.2, {"red": 638.0, "green": 520.0, "blue": 450.0}
    described = load_bench("virtual:ideal").resized(*SHAPE, DISTANCE_MM)
    described = replace(
        described,
        channels=tuple(ChannelDescription(name, nm) for name, nm in colours.items()),
        iris=replace(described.iris, half_width=IRIS),
        camera=CameraDescription(SHAPE[1], SHAPE[0], bit_depth=16, full_well_e=1e9, read_noise_e=0.0),
        defects=(make_defect("slow_response", share=share),),
    )
    paths = [ideal.ideal_path(SHAPE, 8e-6, 1e-9 * nm, 1e-3 * DISTANCE_MM, IRIS) for nm in colours.values()]
    pictures = [scene(SHAPE), np.roll(scene(SHAPE)[::-1, ::-1], 7, 1), np.roll(scene(SHAPE), 20, 1)]
    wanted = np.stack([Solver(p).solve(t, 20).gray for p, t in zip(paths, pictures, strict=True)])
    panel = SlowPanel(np.stack([overdrive_tables(path.response, share) for path in paths]), passes=2)
    seen: dict[bool, list[float]] = {}
    for overdriven in (False, True):
        seen[overdriven] = []
        for k, name in enumerate(colours):
            headset = VirtualHeadset(described)
            headset.lasers.set_power(name, 1.0)
            sent = panel.driven(wanted, 0) if overdriven else wanted
            headset.panel.show_fields(colours_in_turn(sent, (0, 1, 2), (1.0,) * 3, headset.panel.field_us))
            for _ in range(3):
                light = headset.camera.capture().astype(float) - BLACK
            seen[overdriven].append(quality(light, pictures[k]).psnr_db)
    assert np.all(np.array(seen[True]) > np.array(seen[False]) + 5)
