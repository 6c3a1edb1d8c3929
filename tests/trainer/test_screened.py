"""What is screened on which captures, and how the work is shared out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from PIL import Image

from runtime.program.progress import no_progress
from tests.trainer.made_sets import bench_tables, make_set
from trainer.captures.batches import load
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.capture_table import Capture, ids_of
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.screen import MEASURED, ScreenResult, screen, shares_of_work
from trainer.diagnosis.screening import screen_candidates, screened_whole
from trainer.diagnosis.telling import most_telling_capture, screened_captures
from trainer.effects.definition import Parameter, effect
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.jacobian import keys_of
from trainer.fitting.pool import open_pool
from trainer.fitting.predictor import telling_batches
from trainer.fitting.start_points import start_points
from trainer.model.model import Model, absent
from trainer.prediction.stages import Sensor

COLOURS = ("red", "green", "blue")


def lit(captures: CaptureSet, rows: Sequence[Capture]) -> CaptureSet:
    """Captures with some of them lit by a lamp on one side."""
    for row in rows:
        counts = np.asarray(Image.open(row.image)).astype(int)
        counts[:, : counts.shape[1] // 2] += 60
        Image.fromarray(counts.astype(np.uint16)).save(row.image)
    return read_captures(captures.folder)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """Captures that the bench file explains, all but one that a lamp has lit on one side."""
    folder = tmp_path_factory.mktemp("made") / "captures"
    make_set(folder, patterns=6)
    captures = read_captures(folder)
    return lit(captures, capture_roles(captures).fitted[-1:])


@pytest.fixture(scope="module")
def colours(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """Captures in three colours that the bench file explains, but for a lamp that lights the blue ones."""
    folder = tmp_path_factory.mktemp("colours") / "captures"
    captures = make_set(folder, bench_tables(channels=COLOURS), patterns=4)
    return lit(captures, [row for row in captures.captures if row.channel == "blue"])


def test_what_a_model_lacks_is_looked_for_in_the_capture_that_shows_it(made: CaptureSet) -> None:
    """An effect that the model has already explains other captures to the noise, where nothing can be removed."""
    roles = capture_roles(made)
    ideal = with_gains(made, Model(made.bench), roles.fitted)
    assert roles.screened != roles.fitted[-1:]
    assert tuple(screened_captures(roles, ideal)) == roles.screened
    model = ideal.having(absent(catalogue()["zero_order"], made.bench))
    assert tuple(screened_captures(roles, model)) == roles.fitted[-1:]


@pytest.mark.parametrize("count", [1, 2, 3, 100])
def test_workers_get_each_effect_once_and_about_the_same_work(made: CaptureSet, count: int) -> None:
    model, effects = Model(made.bench), list(catalogue().values())

    def work(one: list) -> int:  # type: ignore[type-arg]
        there = [model.having(absent(e, made.bench)) for e in one]
        starts = [len(start_points(e, model)) * (1 if e.measure is None else MEASURED) for e in one]
        return sum(n + len(keys_of(m, [e.name])) for e, m, n in zip(one, there, starts, strict=True))

    shares = shares_of_work(effects, model, count)
    assert sorted(e.name for share in shares for e in share) == sorted(e.name for e in effects)
    assert len(shares) == min(count, len(effects))
    each = [work(share) for share in shares]
    assert max(each) - min(each) <= max(work([e]) for e in effects)


@effect(
    stage="sensor",
    acts_on="camera",
    parameters=[Parameter("slope", "1", scale=0.05, low=-1, high=1, starts=(-0.8, 0.1, 0.8))],
)
def fall_off(sensor: Sensor, slope: torch.Tensor) -> Sensor:
    """Half of the picture is darker, whatever the sign of the slope."""
    return sensor.multiplied(1 - slope**2 * sensor.x.clamp(min=0))


def test_starts_that_do_alike_at_both_ends_are_not_taken_for_starts_that_do_nothing(made: CaptureSet) -> None:
    roles = capture_roles(made)
    ideal = with_gains(made, Model(made.bench), roles.fitted)
    (found,) = screen(made.folder, ids_of(roles.fitted[:1]), ideal, (fall_off,))
    assert found.start.values["slope"] == pytest.approx(0.1)


def whole_screen(captures: CaptureSet, model: Model) -> dict[str, ScreenResult]:
    """Every effect screened on a capture of each colour."""
    ids = ids_of(screened_captures(capture_roles(captures), model))
    return {s.effect: s for s in screen(captures.folder, ids, model, tuple(catalogue().values()))}


def test_one_colour_says_which_effects_all_colours_are_asked_for(colours: CaptureSet) -> None:
    roles = capture_roles(colours)
    ideal = with_gains(colours, Model(colours.bench), roles.fitted)
    rows = screened_captures(roles, ideal)
    assert sorted(row.channel for row in rows) == sorted(COLOURS)
    assert most_telling_capture(colours, rows, ideal).channel == "blue"
    with open_pool(1) as pool:
        found = {s.effect: s for s in screen_candidates(roles, ideal, catalogue(), pool, no_progress)}
    every = whole_screen(colours, ideal)
    assert sorted(found) == sorted(every)
    best = max(every.values(), key=lambda s: s.removed_excess)
    assert best.effect == "stray_light" and found["stray_light"].whole
    assert not any(found[name].whole for name in ("distance", "panel_wavefront", "coherent_ghost"))
    for one in found.values():
        there = every[one.effect]
        assert one.before == pytest.approx(there.before, rel=1e-6)
        if one.whole:
            assert one.after == pytest.approx(there.after, rel=1e-6)
        else:  # what all colours say of it would not bring it near the best either
            assert max(one.removed_excess, there.removed_excess) < 0.5 * best.removed_excess


def test_a_fit_starts_where_all_colours_say(colours: CaptureSet) -> None:
    roles = capture_roles(colours)
    ideal = with_gains(colours, Model(colours.bench), roles.fitted)
    every = whole_screen(colours, ideal)
    with open_pool(1) as pool:
        found = screen_candidates(roles, ideal, catalogue(), pool, no_progress)
        partial = [s for s in found if not s.whole]
        starts = screened_whole(roles, ideal, partial, pool)
    assert [s.effect for s in starts] == [s.effect for s in partial]
    before = {s.effect: s.start.values for s in partial}
    assert any(not np.array_equal(before[s.effect][n], v) for s in starts for n, v in s.start.values.items())
    for one in starts:
        for name, values in every[one.effect].start.values.items():
            np.testing.assert_array_equal(one.start.values[name], values, err_msg=one.effect)


def test_a_search_is_of_the_colours_that_show_most(colours: CaptureSet) -> None:
    batches = load(colours, capture_roles(colours).fitted)
    ideal = with_gains(colours, Model(colours.bench), capture_roles(colours).fitted)
    assert [b.channel for b in batches] == list(COLOURS)
    with torch.no_grad():
        (one,) = telling_batches(ideal, batches, 1)
        assert one.channel == "blue"
        assert telling_batches(ideal, batches, 3) is batches
