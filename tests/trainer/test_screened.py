"""What is screened on which captures, and how the work is shared out."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from tests.trainer.made_sets import make_set
from trainer.captures.capture_set import CaptureSet, read_captures
from trainer.captures.held_out import capture_roles
from trainer.diagnosis.screen import shares_of_work
from trainer.diagnosis.telling import screened_captures
from trainer.effects.effect_catalogue import catalogue
from trainer.fitting.gains import with_gains
from trainer.fitting.jacobian import keys_of
from trainer.fitting.start_points import start_points
from trainer.model.model import Model, absent


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> CaptureSet:
    """Captures that the bench file explains, all but one that a lamp has lit on one side."""
    folder = tmp_path_factory.mktemp("made") / "captures"
    make_set(folder, patterns=6)
    captures = read_captures(folder)
    row = capture_roles(captures).fitted[-1]
    counts = np.asarray(Image.open(row.image)).astype(int)
    counts[:, : counts.shape[1] // 2] += 60
    Image.fromarray(counts.astype(np.uint16)).save(row.image)
    return read_captures(folder)


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
        return sum(
            len(start_points(e, model)) + len(keys_of(m, [e.name])) for e, m in zip(one, there, strict=True)
        )

    shares = shares_of_work(effects, model, count)
    assert sorted(e.name for share in shares for e in share) == sorted(e.name for e in effects)
    assert len(shares) == min(count, len(effects))
    each = [work(share) for share in shares]
    assert max(each) - min(each) <= max(work([e]) for e in effects)
