"""Which of a set's captures a fit takes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tests.trainer.made_sets import make_set
from trainer.captures.capture_table import Capture, ids_of
from trainer.captures.held_out import capture_roles, sample, split, with_patterns


def row(number: int, pattern: str, plane_mm: float = 30.0) -> Capture:
    return Capture(str(number), "green", plane_mm, pattern, Path("p.png"), Path("i.png"), 10.0, float(number))


def test_of_a_repeated_pattern_the_last_capture_is_taken() -> None:
    """What a slow panel showed before the first capture of a set, nobody knows; a repeat follows its own pattern."""
    rows = [row(0, "a"), row(1, "a"), row(2, "b"), row(3, "c"), row(4, "b")]
    assert sorted(c.capture for c in sample(rows, 1, 8)) == ["1", "3", "4"]


def test_patterns_take_turns_with_their_exposures() -> None:
    """One exposure does not tell added light from a wrong black level."""
    exposures = (5.0, 20.0, 80.0)
    rows = [
        replace(row(3 * k + n, f"p{k}"), exposure_ms=ms) for k in range(6) for n, ms in enumerate(exposures)
    ]
    taken = sample(rows, 1, 4)
    assert len({c.pattern for c in taken}) == 4 and {c.exposure_ms for c in taken} == set(exposures)


def test_a_sets_first_capture_is_taken_last() -> None:
    """A fit of a slow panel's response to it would be a fit to what was never shown."""
    rows = [row(k, f"p{k}") for k in range(8)]
    assert sample(rows, 1, 3)[0] is rows[0]
    assert [c.capture for c in sample(rows, 1, 3, rows[0])] == ["4", "2", "6"]
    assert sorted(c.capture for c in sample(rows, 1, 8, rows[0])) == [c.capture for c in rows]


def test_each_plane_has_a_capture_and_patterns_are_spread() -> None:
    rows = [row(k, f"p{k}") for k in range(8)] + [row(8 + k, f"p{k}", 40.0) for k in range(8)]
    taken = sample(rows, 1, 4)
    assert [(c.plane_mm, c.pattern) for c in taken] == [
        (30.0, "p0"),
        (40.0, "p0"),
        (30.0, "p4"),
        (40.0, "p4"),
    ]


def test_a_fit_of_large_pictures_takes_further_patterns_where_one_would_not_do(tmp_path: Path) -> None:
    captures = make_set(tmp_path / "set", patterns=8)
    roles = capture_roles(captures)
    large = replace(roles, fitted=roles.fitted[:1])  # as of pictures of a million pixels
    more = with_patterns(large, 3)
    assert len({c.pattern for c in more.fitted}) == len(more.fitted) == 3
    assert set(ids_of(more.fitted)) <= set(ids_of(split(captures).fitted))
    assert with_patterns(more, 3) is more
    assert len(with_patterns(large, 99).fitted) == len({c.pattern for c in split(captures).fitted})
