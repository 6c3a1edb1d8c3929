"""Benches with something hidden, through the commands: what is hidden must be found, named and removed.

The virtual bench shares no code with the light path: sub-pixels, dead space, fringing and coherence come from
geometry. One effect of each stage is hidden and looked for in every run, the others with -m slow; every run fits
each of those alone.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trainer.hidden import LARGER, captured, ran, with_few_effects, without_probes
from trainer.cli import main
from trainer.effects import catalogue

# What equals another effect at one colour and plane is tested where planes tell them apart: test_bench_facts.py.
ALONE = {name: f'kind = "{name}"' for name, one in catalogue().items() if not one.same_as}
ONE_A_STAGE = ("phase_response", "illumination", "pupil_aberration", "sensor_response")


def explained(capsys, captures: Path, folder: Path, *options: object) -> dict:
    return ran(capsys, "explain", captures, "--out", folder / "model.toml", "--workers", 1, *options)


def largest_excess_left(name: str, before: dict) -> float:
    least = max(0.01 * before["excess"], 3e-4)
    # A number for each pixel is as wrong as the noise of the nine captures that it is a mean of.
    return least + (before["noise_nrmse"] ** 2 / 9 if name == "fixed_pattern" else 0)


@pytest.mark.parametrize("name", [n for n in ALONE if n not in ONE_A_STAGE])
def test_each_effect_alone_is_fitted_to_the_cameras_noise(name, tmp_path, capsys):
    captures = captured(capsys, tmp_path, ALONE[name])
    added = ran(capsys, "add", name, captures, "--out", tmp_path / "model.toml")
    assert added["before"]["excess"] > 2e-3
    assert added["after"]["excess"] < largest_excess_left(name, added["before"])


@pytest.mark.parametrize(
    "name", [n if n in ONE_A_STAGE else pytest.param(n, marks=pytest.mark.slow) for n in ALONE]
)
def test_each_effect_is_found_first_and_removed(name, tmp_path, capsys):
    captures = captured(capsys, tmp_path, ALONE[name])
    found = explained(capsys, captures, tmp_path)
    first, second = found["steps"][:2]
    assert name == second["added"] or name in second["indistinguishable_from"], found["steps"]
    assert found["verdict"] == "complete"
    assert len(found["steps"]) == 2
    assert second["excess"] < largest_excess_left(name, {**first, "noise_nrmse": found["noise_nrmse"]})


def test_nothing_hidden_names_nothing(tmp_path, capsys, monkeypatch):
    without_probes(monkeypatch)
    captures = captured(capsys, tmp_path)
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    assert found["verdict"] == "complete"
    assert found["stage"] is None
    assert not any(r["worth_adding"] for r in found["ranking"])
    assert abs(found["heldout"]["excess"]) < 5e-5
    assert [s["added"] for s in explained(capsys, captures, tmp_path)["steps"]] == [None]


@pytest.mark.parametrize(
    "names",
    [
        ("distance", "ghost"),
        pytest.param(("phase_response", "pupil_aberration"), marks=pytest.mark.slow),
        pytest.param(("crosstalk", "illumination", "distance"), marks=pytest.mark.slow),
        pytest.param(("zero_order", "panel_wavefront", "laser_drift"), marks=pytest.mark.slow),
    ],
    ids=lambda names: "+".join(names),
)
def test_several_effects_are_all_found(names, tmp_path, capsys):
    sizes = LARGER if len(names) > 2 else {}
    captures = captured(capsys, tmp_path, *(ALONE[n] for n in names), **sizes)
    found = explained(capsys, captures, tmp_path)
    kept = {s["added"] for s in found["steps"]} - {s.get("removed") for s in found["steps"]}
    assert kept == set(names), found["steps"]
    assert found["verdict"] == "complete"
    assert found["steps"][-1]["excess"] < 0.02 * found["steps"][0]["excess"]


OWN_EFFECTS = '''
"""Two things that this bench does and the catalogue does not name."""
import math
import torch
from trainer.effects import Parameter, effect

@effect(stage="sensor", acts_on="camera", parameters=[
    Parameter("even", "1", scale=0.03, low=-1, high=1),
    Parameter("odd", "1", scale=0.03, low=-1, high=1),
    Parameter("period", "pixels", scale=0.3, absent=20.0, low=4, high=100, starts=(10.0, 14.0, 17.0, 21.0, 28.0)),
    Parameter("angle", "rad", scale=0.03, low=-4, high=4, starts=tuple(math.pi * k / 12 for k in range(12))),
])
def cover_glass_fringes(sensor, even, odd, period, angle):
    """Interference in the cover glass modulates the sensitivity."""
    h, w = sensor.y.shape
    along = sensor.x * w / 2 * torch.cos(angle) + sensor.y * h / 2 * torch.sin(angle)
    turn = 2 * math.pi * along / period
    return sensor.multiplied(1 + even * torch.cos(turn) + odd * torch.sin(turn))
'''


def test_what_the_catalogue_does_not_name_is_placed_and_then_explained_by_a_users_own_effect(
    tmp_path, capsys, monkeypatch
):
    fringes = 'kind = "fringes"\ncontrast = 0.22\nperiod_px = 17\nangle_deg = 33\nchirp = 0.0'
    captures = captured(capsys, tmp_path, fringes)
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    assert (found["verdict"], found["stage"]) == ("outside_catalogue", "sensor")
    assert not any(r["worth_adding"] for r in found["ranking"])

    own = tmp_path / "own.py"
    own.write_text(OWN_EFFECTS)
    with_few_effects(monkeypatch, "sensor_response", "vignetting", "ghost")  # nothing named helped
    better = explained(capsys, captures, tmp_path, "--effects", own)
    assert [s["added"] for s in better["steps"]] == [None, "cover_glass_fringes"]
    assert better["verdict"] == "complete"
    assert better["steps"][-1]["excess"] < 3e-4


@pytest.mark.slow
def test_a_ghost_with_a_blur_is_found_by_fitting_both_together(tmp_path, capsys):
    # Fitted alone, each takes up a part of the other, and then hides it.
    blur = 'kind = "sensor_blur"\nsigma_x_px = 0.5'
    ghost = 'kind = "ghost"\nshare = 0.1\nshift_x_px = 6.5\nshift_y_px = -3'
    found = explained(capsys, captured(capsys, tmp_path, ghost, blur), tmp_path)
    assert found["verdict"] == "complete"
    names = {frozenset((s["added"], *s["indistinguishable_from"])) for s in found["steps"][1:]}
    assert names == {frozenset({"ghost"}), frozenset({"sensor_blur", "spatial_coherence"})}


def test_a_misread_set_is_refused_and_not_explained(tmp_path, capsys):
    captures = captured(capsys, tmp_path, 'kind = "convention"')
    for command in (["diagnose", captures], ["explain", captures, "--out", tmp_path / "model.toml"]):
        assert main([*map(str, command), "--json"]) == 2
        out, err = capsys.readouterr()
        assert out == "" and "mirror the images left-right" in err
    assert not (tmp_path / "model.toml").exists()


@pytest.mark.slow
def test_specks_sit_on_the_panel(tmp_path, capsys):
    captures = captured(capsys, tmp_path, 'kind = "specks"', **LARGER)
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    assert (found["verdict"], found["stage"]) == ("outside_catalogue", "panel")


@pytest.mark.slow
def test_a_weak_source_and_a_blur_look_alike_at_one_plane_and_not_at_three(tmp_path, capsys):
    # A stronger one is told from a blur at the iris's edge, which takes a part of what is tilted.
    source = 'kind = "spatial_coherence"\nradius_mrad = 0.2'
    captures = captured(capsys, tmp_path, source, **LARGER)
    found = ran(capsys, "diagnose", captures, "--workers", 1)
    best = found["ranking"][0]
    assert {best["effect"], *best["indistinguishable_from"]} >= {"spatial_coherence", "sensor_blur"}
    assert any("mm" in s for s in found["suggested_captures"])

    (tmp_path / "three").mkdir()
    captures = captured(
        capsys, tmp_path / "three", source, options=("--planes", "10,15,20", "--patterns", 6), **LARGER
    )
    best = ran(capsys, "diagnose", captures, "--workers", 1)["ranking"][0]
    assert best["effect"] == "spatial_coherence"
    assert "sensor_blur" not in best["indistinguishable_from"]


@pytest.mark.parametrize(
    "name",
    ["ideal", *(pytest.param(n, marks=pytest.mark.slow) for n in ("leak", "two", "colour", "outside"))],
)
def test_practice_sets_come_out_as_their_truth_says(name, shared, tmp_path, capsys):
    truth = {
        "ideal": [],
        "leak": ["zero_order"],
        "two": ["illumination", "phase_response"],
        "colour": ["pupil_aberration"],
        "outside": [],
    }
    captures = shared / "practice" / name
    found = explained(capsys, captures, tmp_path)
    assert sorted(s["added"] for s in found["steps"][1:]) == truth[name]
    if name == "outside":
        assert found["verdict"] == "outside_catalogue"
        assert found["stage"] in ("panel", "sensor")
    else:
        assert found["verdict"] == "complete"
        assert found["steps"][-1]["excess"] < 5e-4
    if name == "ideal":
        whole = ran(capsys, "compare", captures)
        assert whole["heldout"]["excess"] < 5e-4
