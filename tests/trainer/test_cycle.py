"""The cycle: patterns through a model and a network, on a bench with a defect that no effect names."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from firmware_iface.errors import InputError
from firmware_iface.virtual import BenchDescription, VirtualHeadset, make_defect
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path
from runtime.networks.onnx_approximator import approximator_of
from runtime.solver import Solver, quality
from tests.trainer.fringed_bench import SHAPE, captured, fringed, known
from tests.trainer.test_networks import disturbed
from trainer.cli import main
from trainer.cycle.cycle_settings import CycleSettings
from trainer.cycle.evaluation import DISPLAY, PREDICTION, run_evaluation
from trainer.cycle.evaluation_bench import EvaluationSizes
from trainer.cycle.hardware_in_the_loop import CycleState, run_cycle
from trainer.cycle.phase_retrieval import (
    METHODS,
    beside_zero_order,
    loss_of,
    retrieve,
    torch_path,
)
from trainer.cycle.show_on_bench import BenchDisplay, headset_beside_zero_order
from trainer.cycle.target_pictures import TargetVolume, in_depth, photographs
from trainer.model.bundle_export import export_bundle
from trainer.model.model import Model
from trainer.networks.approximator import Approximator, Architecture
from trainer.training.recipe import RECIPES
from trainer.training.training_run import NETWORK, train
from trainer.training.training_sets import training_sets

COMPACT = replace(RECIPES["compact"], filters=2)
NEVER = 2.0  # no picture is that good


def cycle_of(headset: VirtualHeadset, folder: Path, count: int = 3, **changed: object) -> CycleState:
    """Two rounds on a headset, under the ideal model."""
    bench = known(headset)
    settings = CycleSettings(2, COMPACT, 150, iterations=30, good=NEVER)
    names = ("astronaut", "coffee", "rocket", "chelsea")[:count]
    display = BenchDisplay(headset, bench, Model(bench))
    return run_cycle(Model(bench), photographs(names, bench), replace(settings, **changed), folder, display)


def psnr(cycle: CycleState, number: int) -> float:
    return float(np.mean([one.psnr_db for one in cycle.history[number].values()]))


def test_each_round_is_better_than_none(tmp_path: Path) -> None:
    """The fringes of the bench are corrected: with nothing learned they cost more than 4 dB."""
    cycle = cycle_of(fringed(), tmp_path, count=2)
    assert len(cycle.history) == 3
    assert psnr(cycle, 1) > psnr(cycle, 0) + 4
    assert psnr(cycle, 2) > psnr(cycle, 0) + 4
    assert len(list((tmp_path / "round-2" / "patterns").iterdir())) == 2
    assert (tmp_path / "round-1" / "network.safetensors").is_file()


@pytest.mark.slow
def test_online_each_picture_has_its_own_network(tmp_path: Path) -> None:
    """Where what is wrong differs from picture to picture, a network of its own serves each better."""
    headset = fringed(kind="zero_order")
    shared = cycle_of(headset, tmp_path / "shared")
    own = cycle_of(fringed(kind="zero_order"), tmp_path / "own", online=True)
    assert psnr(own, 2) > psnr(shared, 2) + 0.5
    assert set(own.own) == {"astronaut", "coffee", "rocket"}


def test_a_picture_that_is_good_enough_is_left_alone(tmp_path: Path) -> None:
    cycle = cycle_of(fringed(), tmp_path, count=2, good=0.0)
    assert cycle.done == {"astronaut", "coffee"}
    assert len(cycle.history) == 1 and cycle.network is None


def test_recorded_captures_take_the_place_of_the_camera(tmp_path: Path) -> None:
    """What was recorded is learned from, and the patterns that are left behind show the picture better."""
    captures = captured(tmp_path / "captures", patterns=12)
    model, wanted = Model(captures.bench), photographs(("astronaut",), captures.bench)
    settings = CycleSettings(1, COMPACT, 150, iterations=30)
    cycle = run_cycle(model, wanted, settings, tmp_path / "loop", None, [captures])
    assert cycle.history == [] and cycle.network is not None
    headset = fringed()
    plain = {"astronaut": retrieve(model, wanted[0], "wirtinger", None, 30)}
    display = BenchDisplay(headset, captures.bench, model)
    better = [
        run_shown(display, patterns, wanted[0], tmp_path / f"{k}")
        for k, patterns in enumerate((plain, cycle.patterns))
    ]
    assert better[1] > better[0] + 3
    with pytest.raises(InputError, match="recorded"):
        run_cycle(model, wanted, replace(settings, rounds=2), tmp_path / "more", None, [captures])


def run_shown(
    display: BenchDisplay, patterns: dict[str, np.ndarray], wanted: TargetVolume, folder: Path
) -> float:
    from trainer.cycle.show_on_bench import display_metrics, pairs_by_pattern
    from trainer.diagnosis.comparison import with_gains

    captures = display.show(patterns, wanted.planes_mm, folder)
    pairs = pairs_by_pattern(captures, with_gains(captures, display.model, captures.captures))
    return display_metrics(pairs[wanted.name], wanted).psnr_db


def test_the_headset_shows_better_through_the_exported_network(tmp_path: Path) -> None:
    """A network is trained, exported as ONNX and used by the headset's own solver without torch; the camera judges."""
    captures = captured(tmp_path / "captures", patterns=12)
    model = Model(captures.bench)
    train(
        training_sets(captures, model).fitted, COMPACT, 200, tmp_path / "run", about={"channels": ["green"]}
    )
    export_bundle(model, captures, tmp_path / "bundle", network=tmp_path / "run" / NETWORK)
    bundle = read_bundle(tmp_path / "bundle")
    path, wanted = load_light_path(bundle), photographs(("astronaut",), captures.bench)[0]
    display, shown = BenchDisplay(fringed(), captures.bench, model), {}
    for name, d in (("without", None), ("through", approximator_of(bundle, (1, *SHAPE)))):
        gray = Solver(path, approximator=d).solve(wanted.irradiance[0, 0], 40).gray.copy()
        shown[name] = run_shown(display, {wanted.name: gray.reshape(1, *SHAPE)}, wanted, tmp_path / name)
    assert shown["through"] > shown["without"] + 3


# Phase retrieval


@pytest.mark.parametrize("colours", [False, True])
def test_the_phase_gradient_through_the_network_is_the_slope(colours: bool) -> None:
    """Chakravarthula et al. 2020, eq. 23, along a random direction, in double precision."""
    bench = known(fringed(colours))
    names, planes = [c.name for c in bench.channels], (5.5, 6.0)
    paths = [[torch_path(Model(bench), n, z, torch.float64) for n in names] for z in planes]
    shape = (len(planes), len(names), *SHAPE)
    generator = torch.Generator().manual_seed(0)
    network = disturbed("compact", SHAPE, 2, len(names)).double()
    phase = (6 * torch.rand(shape[1:], generator=generator, dtype=torch.float64)).requires_grad_(True)
    target, weight = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(2))
    direction = torch.randn(shape[1:], generator=generator, dtype=torch.float64)
    with torch.no_grad():  # the target's scale is held while the slope is taken
        fixed = scaled(phase, paths, target, weight, network)
    (gradient,) = torch.autograd.grad(loss_of(phase, paths, target, weight, network), [phase])
    step = 1e-5
    with torch.no_grad():
        rise = [
            float(penalty_at(phase + sign * step * direction, paths, fixed, weight, network))
            for sign in (1, -1)
        ]
    assert float((gradient * direction).sum()) == pytest.approx((rise[0] - rise[1]) / (2 * step), rel=1e-4)


def light(phase: torch.Tensor, paths: list, network: torch.nn.Module) -> torch.Tensor:
    from runtime.lightpath.light_path import irradiance, pixel_irradiance

    rows = [[pixel_irradiance(p, irradiance(p, phase[c])) for c, p in enumerate(row)] for row in paths]
    return network(torch.stack([torch.stack(row) for row in rows]))


def scaled(phase, paths, target, weight, network) -> torch.Tensor:  # type: ignore[no-untyped-def]
    irradiance = light(phase, paths, network)
    over = (target.sqrt() * irradiance.clamp(min=0).sqrt() * weight).sum((0, 2, 3)) / (target * weight).sum(
        (0, 2, 3)
    )
    return target * over[None, :, None, None] ** 2


def penalty_at(phase, paths, target, weight, network) -> torch.Tensor:  # type: ignore[no-untyped-def]
    irradiance = light(phase, paths, network)
    return (weight * ((irradiance.clamp(min=0) + 1e-3).sqrt() - (target + 1e-3).sqrt()) ** 2).sum()


def test_every_named_method_shows_the_picture() -> None:
    bench = known(fringed())
    headset = VirtualHeadset(BenchDescription("ideal").resized(*SHAPE, 6.0))
    picture = photographs(("astronaut",), bench)[0]
    found = {}
    for method in METHODS:
        shown = headset_beside_zero_order(headset) if method == "wirtinger_no_zero_order" else headset
        gray = retrieve(Model(bench), picture, method, None, 40)[0]
        assert gray.dtype == np.uint8 and gray.shape == SHAPE
        found[method] = quality(shown.true_irradiance(gray, "green"), picture.irradiance[0, 0]).psnr_db
    assert found["wirtinger"] > found["gerchberg_saxton"] > 10
    assert found["wirtinger"] > found["double_phase"] > 10
    with pytest.raises(InputError, match="wirtinger"):
        retrieve(Model(bench), picture, "wirtnger")


def test_the_ramp_and_the_iris_keep_the_zero_order_out() -> None:
    """Undiffracted light alone: all of it passes an iris on the axis, and nothing one that stands beside it."""
    description = BenchDescription("leaky", defects=(make_defect("zero_order", surface_amplitude=0.5),))
    headset = VirtualHeadset(description.resized(*SHAPE, 6.0))
    chequer = (128 * (np.indices(SHAPE).sum(0) % 2)).astype(np.uint8)  # diffracts to the band's corners
    straight, beside = (
        h.true_irradiance(chequer, "green").mean() for h in (headset, headset_beside_zero_order(headset))
    )
    assert beside < 0.02 * straight
    model = beside_zero_order(Model(known(headset)))
    assert model.names == ("iris",)


def test_a_stack_of_planes_shows_each_part_in_its_plane() -> None:
    """One pattern, two planes: each strip is better in its own plane than from the pattern of the other one."""
    bench = known(fringed())
    headset = VirtualHeadset(BenchDescription("ideal").resized(*SHAPE, 6.0))
    flat = photographs(("astronaut",), bench)[0]
    wanted = in_depth(flat, (4.0, 8.0))
    deep = retrieve(Model(bench), wanted, "hardware_in_the_loop", None, 60)[0]
    single = retrieve(Model(bench), replace(flat, planes_mm=(4.0,)), "wirtinger", None, 60)[0]
    far = wanted.weight[1] > 0
    target = flat.irradiance[0, 0]
    shown = [headset.true_irradiance(gray, "green", 8.0) for gray in (deep, single)]
    assert quality(shown[0], target, far).psnr_db > quality(shown[1], target, far).psnr_db + 6
    with pytest.raises(InputError, match="one plane"):
        retrieve(Model(bench), wanted, "gerchberg_saxton")


def test_a_depth_map_says_on_which_plane_each_pixel_counts() -> None:
    flat = photographs(("astronaut",), known(fringed()))[0]
    depth = np.zeros(SHAPE)
    depth[:10] = 1.0
    weight = in_depth(flat, (4.0, 5.0, 6.0), depth).weight
    assert weight[2, :10].all() and weight[0, 10:].all() and weight.sum() == np.prod(SHAPE)


def test_a_cycle_in_depth_gets_better(tmp_path: Path) -> None:
    """Both planes are captured, learned from and shown."""
    headset = fringed()
    bench = known(headset)
    wanted = [in_depth(one, (5.0, 7.0)) for one in photographs(("astronaut", "coffee"), bench)]
    settings = CycleSettings(1, COMPACT, 150, iterations=30, method="wirtinger", good=NEVER)
    cycle = run_cycle(Model(bench), wanted, settings, tmp_path, BenchDisplay(headset, bench, Model(bench)))
    assert psnr(cycle, 1) > psnr(cycle, 0) + 1


def test_three_colours_are_solved_together() -> None:
    bench = known(fringed(True))
    picture = photographs(("astronaut",), bench)[0]
    identity = Approximator(Architecture("compact", 2, SHAPE, 2)).eval()
    gray = retrieve(Model(bench), picture, "hardware_in_the_loop", identity, 10)
    assert gray.shape == (2, *SHAPE) and not np.array_equal(gray[0], gray[1])


# The commands


def bench_file(folder: Path, kind: str = "fringes") -> Path:
    path = folder / "bench.toml"
    path.write_text(
        f'name = "small"\n[panel]\nwidth = {SHAPE[1]}\nheight = {SHAPE[0]}\n'
        f'[propagation]\ndistance_mm = 6.0\n[[defect]]\nkind = "{kind}"\n'
    )
    return path


def test_the_loop_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "loop",
        "--bench",
        str(bench_file(tmp_path)),
        "--steps",
        "60",
        "--filters",
        "2",
        "--iterations",
        "10",
    ]
    assert main([*words, "--out", str(tmp_path / "loop"), "--good", "2", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [one["round"] for one in result["rounds"]] == [0, 1]
    assert result["rounds"][1]["mean"]["psnr_db"] > result["rounds"][0]["mean"]["psnr_db"]
    assert result["rounds"][0]["mean"]["one_minus_lpips"] is None
    assert main([*words, "--out", str(tmp_path / "loop")]) == 2
    assert "not empty" in capsys.readouterr().err
    assert main(["loop", "--out", str(tmp_path / "none")]) == 2
    assert "--bench" in capsys.readouterr().err


def test_evaluate_prints_its_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "evaluate",
        "--bench",
        str(bench_file(tmp_path)),
        "--filters",
        "2",
        "--steps",
        "10",
        "--iterations",
        "10",
    ]
    methods = ["ideal", "published", "compact_is_not_one"]
    assert main([*words, "--methods", ",".join(methods)]) == 2
    assert "compact_is_not_one" in capsys.readouterr().err
    assert main([*words, "--methods", "ideal,published,wirtinger", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [row["method"] for row in result["prediction"]] == ["ideal", "published"]
    assert [row["method"] for row in result["display"]] == ["wirtinger"]
    keys = {"psnr_db", "ssim", "one_minus_lpips"}
    for row in (*result["prediction"], *result["display"], result["noise_floor"], result["oracle"]):
        assert row.keys() - {"method"} == keys
        assert row["one_minus_lpips"] is None and row["psnr_db"] > 5 and 0 < row["ssim"] < 1
    assert result["noise_floor"]["psnr_db"] > result["prediction"][0]["psnr_db"]


@pytest.mark.slow
def test_every_method_of_evaluate_runs(tmp_path: Path) -> None:
    found = run_evaluation(
        str(bench_file(tmp_path, "zero_order")), sizes=EvaluationSizes(2, 20, 60), workers=1
    )
    assert [row["method"] for row in found["prediction"]] == list(PREDICTION)
    assert [row["method"] for row in found["display"]] == list(DISPLAY)
    by_name = {row["method"]: row["psnr_db"] for row in found["display"]}
    assert by_name["physics"] > by_name["wirtinger"] + 3
    assert abs(by_name["physics"] - found["oracle"]["psnr_db"]) < 3
