"""The files that new-effect writes: they work unchanged, are found in captures, and overwrite nothing."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from trainer.diagnosis.addition import add
from trainer.effects import effect_catalogue as registry
from trainer.effects import testing
from trainer.effects.definition import Effect
from trainer.effects.effect_catalogue import catalogue, load_effects
from trainer.effects.new_effect import EXAMPLES, STAGES, write_new_effect
from trainer.model.model import Model

ROOT = Path(__file__).resolve().parent.parent.parent


def written(folder: Path, stage: str) -> Effect:
    path, _ = write_new_effect(f"{stage}_oddity", stage, folder)
    (effect,) = load_effects(path)
    return effect


@pytest.mark.parametrize("stage", STAGES)
def test_absent_it_changes_nothing_and_every_parameter_has_a_gradient(tmp_path: Path, stage: str) -> None:
    effect = written(tmp_path, stage)
    assert (effect.name, effect.stage) == (f"{stage}_oddity", stage)
    assert testing.change_when_absent(effect) < 1e-5
    slopes = testing.slopes(effect, EXAMPLES[stage])
    assert set(slopes) == {p.name for p in effect.parameters}
    assert all(slope > 0 for slope in slopes.values()), slopes


@pytest.mark.parametrize("stage", STAGES)
def test_it_is_found_in_captures_with_its_values(tmp_path: Path, stage: str) -> None:
    effect = written(tmp_path, stage)
    captures = testing.captures_with(tmp_path / "captures", effect, EXAMPLES[stage], patterns=4)
    found = add(captures, Model(captures.bench), effect)
    assert found.before.excess > 0.02
    assert found.after.excess < 0.02 * found.before.excess
    for name, value in EXAMPLES[stage].items():
        assert float(found.model.present[0].values[name]) == pytest.approx(value, rel=0.05)


@pytest.mark.slow
def test_its_own_test_passes(tmp_path: Path) -> None:
    write_new_effect("sensor_oddity", "sensor", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_sensor_oddity.py"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout


def test_it_joins_the_catalogue(tmp_path: Path) -> None:
    path, _ = write_new_effect("ripple", "drive", tmp_path)
    assert list(catalogue([path]))[-1] == "ripple"


def test_nothing_is_written_over(tmp_path: Path) -> None:
    write_new_effect("ripple", "drive", tmp_path)
    (tmp_path / "ripple.py").unlink()
    before = (tmp_path / "test_ripple.py").read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"test_ripple.py is there already"):
        write_new_effect("ripple", "panel", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["test_ripple.py"]
    assert (tmp_path / "test_ripple.py").read_text(encoding="utf-8") == before


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Ripple", "lower-case"),
        ("my-effect", "lower-case"),
        ("../x", "lower-case"),
        ("", "lower-case"),
        ("a" * 41, "lower-case"),
        ("lambda", "lower-case"),
        ("zero_order", "already"),
        ("math", "Python module"),
        ("trainer", "Python module"),
        ("effect", "Python module"),
    ],
)
def test_a_bad_name_gets_a_sentence(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_new_effect(name, "drive", tmp_path, catalogue())
    assert not list(tmp_path.iterdir())


def test_an_unknown_stage_gets_a_hint(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'pupil'"):
        write_new_effect("thread", "pupill", tmp_path)


@pytest.mark.parametrize("value", ["own_effects", "own_effects:ripple", "own_effects:both"])
def test_an_installed_package_offers_effects(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_new_effect("ripple", "sensor", tmp_path, catalogue())
    (tmp_path / "ripple.py").rename(tmp_path / "own_effects.py")
    with (tmp_path / "own_effects.py").open("a") as file:
        file.write("\nboth = [ripple]\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_effects", raising=False)
    points = [EntryPoint("mine", value, "hololoop.effects")]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    assert list(catalogue())[-1] == "ripple"


@pytest.mark.parametrize(
    ("value", "says"), [("no_such_package", "cannot be loaded"), ("math:pi", "gives no effect")]
)
def test_a_broken_entry_point_is_named(value: str, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [EntryPoint("mine", value, "hololoop.effects")]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    with pytest.raises(InputError, match=says):
        catalogue()
