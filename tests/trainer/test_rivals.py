"""Which of two candidates that look alike comes first, and which is fitted beside the best one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.excess import PredictionErrors, removed_excess
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.diagnosis.candidate_fits import CandidateFit
from trainer.diagnosis.chosen_addition import _rival, chosen_addition
from trainer.diagnosis.exchange import preferred
from trainer.diagnosis.ranking import RankedEffect, fit_with_present, rank
from trainer.diagnosis.verdict import Thresholds
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model, absent

BENCH = Bench(
    "ideal",
    Panel(8, 8, 8.0),
    (Channel("green", 520.0),),
    30.0,
    Iris(),
    Camera(8, 8, 8.0, True, 12, 64.0, 10500.0, 5.0),
)
KNOWN = catalogue()


def errors(excess: float) -> PredictionErrors:
    """Of ten captures that are all alike."""
    noise = np.full((10, 4), 0.01)
    return PredictionErrors(
        tuple(str(k) for k in range(10)), noise + excess / 4, noise, np.ones(10), np.full(10, 100.0)
    )


def found(
    ranking: dict[str, float], screened: dict[str, float], worthless: tuple[str, ...], together: bool
) -> Any:
    """A diagnosis: excess that each fitted candidate removes, and that the screen expects each to leave, best first."""
    ranked = [
        SimpleNamespace(
            effect=KNOWN[name],
            removed=SimpleNamespace(value=value),
            worth_adding=name not in worthless,
            together=True if together else None,
        )
        for name, value in ranking.items()
    ]
    expected = [
        SimpleNamespace(effect=name, after=after, start=absent(KNOWN[name], BENCH))
        for name, after in screened.items()
    ]
    return SimpleNamespace(ranking=ranked, screened=expected, model=Model(BENCH), held_out=errors(0.03))


BEST, OTHER, RARE = "amplitude_modulation", "stray_light", "polarisation_leak"


@pytest.mark.parametrize(
    ("ranking", "screened", "worthless", "together", "rival"),
    [
        # A present effect took up most of the right one: alone it removes little, the screen expects most of it.
        ({BEST: 0.028, RARE: 0.011}, {RARE: 0.001, BEST: 0.002}, (), False, RARE),
        ({BEST: 0.028, RARE: 0.021}, {BEST: 0.001, RARE: 0.002}, (), False, RARE),  # near
        ({BEST: 0.028, OTHER: 0.011}, {BEST: 0.001, OTHER: 0.002}, (), False, None),  # far behind in both
        ({BEST: 0.028}, {BEST: 0.001}, (), False, None),
        # It got nowhere while present effects stayed as they were, but the screen expects about as much of it.
        ({BEST: 0.028, OTHER: 0.0}, {OTHER: 0.001, BEST: 0.002}, (OTHER,), False, OTHER),
        ({BEST: 0.028}, {BEST: 0.010, OTHER: 0.014}, (), False, OTHER),
        ({BEST: 0.028}, {BEST: 0.010, OTHER: 0.016}, (), False, None),
        ({BEST: 0.028}, {BEST: 0.010, RARE: 0.011}, (), False, None),  # few benches have it
        ({BEST: 0.028}, {BEST: 0.010, OTHER: 0.014}, (), True, None),  # fitted already, and far behind
    ],
)
def test_the_rival_is_what_the_screen_expects_most_of_or_what_is_near(
    ranking: dict[str, float],
    screened: dict[str, float],
    worthless: tuple[str, ...],
    together: bool,
    rival: str | None,
) -> None:
    one = _rival(found(ranking, screened, worthless, together))
    assert (one and one.effect.name) == rival


@pytest.mark.parametrize(
    ("leak", "response", "chosen"),
    [
        (0.20, 0.25, "phase_response"),  # of the first effect, too: the others are still to come
        (0.05, 0.25, "polarisation_leak"),
        (0.20, 0.60, "polarisation_leak"),  # far behind: not even looked at
    ],
)
def test_an_effect_that_few_benches_have_is_added_first_only_where_it_does_much_better(
    leak: float, response: float, chosen: str
) -> None:
    left = {RARE: leak, "phase_response": response}
    before = errors(0.7)
    ranking = [
        RankedEffect(
            KNOWN[name],
            Model(BENCH).having(absent(KNOWN[name], BENCH)),
            errors(excess),
            removed_excess(before, errors(excess)),
            True,
        )
        for name, excess in left.items()
    ]
    diagnosis: Any = SimpleNamespace(ranking=ranking, screened=[], model=Model(BENCH), held_out=before)

    def fitted_again(_: Any, tasks: list[Any]) -> list[Any]:
        """Nothing gets better when all is fitted together, and no order when it is raised."""
        models = [t[2] if t[2].present else t[2].having(t[3]) for t in tasks]
        return [(m, errors(left[m.names[0]])) for m in models]

    roles: Any = SimpleNamespace(folder=None, ids=())
    pool: Any = SimpleNamespace(map_here_if_one=fitted_again)
    added, model, after = chosen_addition(roles, diagnosis, pool)
    assert (added.effect.name, model.names) == (chosen, (chosen,))
    assert after.excess == pytest.approx(left[chosen])


@pytest.mark.parametrize(
    ("leak", "first"),
    [
        (0.18, "phase_response"),  # three quarters of the other's excess is not enough to tell them apart
        (0.05, "polarisation_leak"),
    ],
)
def test_of_two_that_look_alike_the_one_that_few_benches_have_comes_second(leak: float, first: str) -> None:
    fits = [
        CandidateFit(name, Model(BENCH).having(absent(KNOWN[name], BENCH)), errors(excess))
        for name, excess in (("polarisation_leak", leak), ("phase_response", 0.2))
    ]
    ranking = rank(errors(0.5), fits, KNOWN, Thresholds(), 0.5, len(KNOWN))
    assert ranking[0].effect.name == first


def test_a_plainer_one_that_is_not_worth_adding_does_not_come_first() -> None:
    """The two differ by less than makes a difference; what the better one removes is just more than that."""
    fits = [
        CandidateFit(name, Model(BENCH).having(absent(KNOWN[name], BENCH)), errors(excess))
        for name, excess in (("polarisation_leak", 0.00025), ("phase_response", 0.0004))
    ]
    ranking = rank(errors(0.0005), fits, KNOWN, Thresholds(), 0.0005, len(KNOWN))
    assert [(r.effect.name, r.worth_adding) for r in ranking] == [
        ("polarisation_leak", True),
        ("phase_response", False),
    ]


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (("a",), ["try_together_on_few", "try_with_present"]),
        (("a", "b"), ["try_with_present"]),  # one capture a colour: few are all that a fit has
    ],
)
def test_no_candidate_is_fitted_twice_to_the_same_captures(
    told: tuple[str, ...], expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def noted(task: Any, tasks: list[Any]) -> list[Any]:
        asked.append(task.__name__)
        return [(Model(BENCH), 0.1) for _ in tasks]

    def captures(*names: str) -> list[Any]:
        return [SimpleNamespace(capture=name) for name in names]

    monkeypatch.setattr("trainer.diagnosis.ranking.telling_captures", lambda *_: captures(*told))
    roles: Any = SimpleNamespace(
        captures=None, folder=None, fitted=captures("a", "b"), held_out=captures("c")
    )
    screened: Any = [SimpleNamespace(start=None, whole=True) for _ in range(2)]
    pool: Any = SimpleNamespace(map=noted, map_here_if_one=noted)
    assert len(fit_with_present(roles, Model(BENCH), screened, 0.0002, pool)) == 2
    assert asked == expected


@pytest.mark.parametrize(("left", "tried"), [(0.0001, 0), (0.0003, 1)])
def test_a_less_plain_rival_is_tried_only_where_enough_is_left_for_it(
    left: float, tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials: list[Any] = []

    def noted(_roles: Any, _model: Any, given: list[Any], *_: Any) -> list[Any]:
        trials.extend(given)
        return []

    monkeypatch.setattr("trainer.diagnosis.exchange._promising", noted)
    model = Model(BENCH).having(absent(KNOWN["phase_response"], BENCH))
    nothing: Any = None
    for name, expected in ((RARE, tried), ("stray_light", 1)):
        trials.clear()
        rivals = {"phase_response": {name: absent(KNOWN[name], BENCH)}}
        assert preferred(nothing, model, errors(left), rivals, Thresholds(), 0.5, nothing) is None
        assert len(trials) == expected
