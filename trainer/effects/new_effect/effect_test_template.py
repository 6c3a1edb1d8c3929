"""Tests of my_effect. Run them with: pytest test_my_effect.py"""

from __future__ import annotations

from pathlib import Path

from trainer.diagnosis.addition import add
from trainer.effects import testing
from trainer.effects.effect_catalogue import load_effects
from trainer.model.model import Model

EFFECT = load_effects(Path(__file__).with_name("my_effect.py"))[0]

# What is hidden in a simulated bench: values at which the effect is clearly visible. Edit them with the effect.
HIDDEN = {"my_values": 0.0}


def test_absent_it_changes_nothing() -> None:
    assert testing.change_when_absent(EFFECT) < 1e-5


def test_every_parameter_has_a_gradient() -> None:
    slopes = testing.slopes(EFFECT, HIDDEN)
    assert all(slope > 0 for slope in slopes.values()), slopes


def test_it_is_found_in_captures(tmp_path: Path) -> None:
    captures = testing.captures_with(tmp_path / "captures", EFFECT, HIDDEN)
    found = add(captures, Model(captures.bench), EFFECT)
    assert found.after.excess < 0.1 * found.before.excess
