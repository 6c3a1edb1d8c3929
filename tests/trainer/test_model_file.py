"""Model files: what is written comes back exactly, whole or not at all."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.effects.definition import Effect, Parameter
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import EffectInstance, Model, absent
from trainer.model.model_file import read_model, write_model


def curve(drive: Any, gain: Any, curvature: Any) -> Any:
    """Takes the place of an effect; nothing here applies it."""
    return drive


# Two effects whose parameters the texts below rely on, among all that there are.
KNOWN = {
    **catalogue(),
    "phase_response": Effect(
        "phase_response",
        "drive",
        "display",
        "A curve a colour.",
        (
            Parameter("gain", "1", 0.02, 1.0, 0.2, 3.0, per_channel=True),
            Parameter("curvature", "rad", 0.1, low=-6, high=6, count=lambda order: order, per_channel=True),
        ),
        curve,
        (1, 3, 5),
    ),
    "distance": Effect(
        "distance",
        "pupil",
        "display",
        "The image plane is elsewhere.",
        (Parameter("offset", "mm", 0.03, low=-100, high=100, about="how far it is"),),
        curve,
    ),
}


def bench(*names: str) -> Bench:
    camera = Camera(64, 48, 8.0, True, 12, 64.0, 10500.0, 5.0)
    channels = tuple(Channel(n, 520.0 + 50 * k) for k, n in enumerate(names or ("green",)))
    return Bench("practice", Panel(64, 48, 8.0), channels, 30.0, Iris(), camera)


def filled(effect: Effect, on: Bench, rng: np.random.Generator, order: int | None = None) -> EffectInstance:
    """The effect with values all over its range, and with errors."""
    base = absent(effect, on, order)
    values, errors = {}, {}
    for p in effect.parameters:
        low, high = (max(p.low, -50.0), min(p.high, 50.0))
        values[p.name] = rng.uniform(low, high, base.values[p.name].shape)
        errors[p.name] = np.abs(rng.standard_normal(values[p.name].shape)) * 1e-7
    return EffectInstance(base.effect, base.order, values, errors)


def whole_model(on: Bench, seed: int = 0) -> Model:
    rng = np.random.default_rng(seed)
    present = tuple(filled(e, on, rng, e.orders[-1]) for e in KNOWN.values())
    history = (
        {"added": "", "nrmse": 0.2, "excess": 0.04, "date": "2025-01-31"},
        {
            "added": "zero_order",
            "nrmse": 1 / 3,
            "list": [1, 2.5, 'x\ny"\\'],
            "kept": True,
            "nested": {"a b": 1e-30},
        },
    )
    gain = {c.name: 1 / (k + 3) for k, c in enumerate(on.channels)}
    return Model(on, present, gain, "fresnel", history, response_known_to=1 / 7)


def assert_same(a: Model, b: Model) -> None:
    assert (a.bench, a.gain, a.method, a.history, a.names) == (b.bench, b.gain, b.method, b.history, b.names)
    assert a.response_known_to == b.response_known_to
    for one, other in zip(a.present, b.present, strict=True):
        assert one.order == other.order
        assert (one.nodes is None) == (other.nodes is None)
        if one.nodes is not None:
            np.testing.assert_array_equal(one.nodes, other.nodes)
        for first, second in ((one.values, other.values), (one.errors, other.errors)):
            assert (first is None) == (second is None)
            for name, array in (first or {}).items():
                assert second is not None
                assert second[name].shape == array.shape
                assert second[name].dtype == np.float64
                np.testing.assert_array_equal(second[name], array)


@pytest.mark.parametrize("names", [("green",), ("red", "green", "blue"), ("my red", 'a"b', "array")])
def test_a_model_of_every_effect_comes_back_exactly(tmp_path: Path, names: tuple[str, ...]) -> None:
    model = whole_model(bench(*names))
    path = tmp_path / "model.toml"
    write_model(path, model, {"written_by": "a test", "captures": 12})
    assert_same(model, read_model(path, KNOWN, model.bench))
    # Only what is a number a pixel, or a free-form map, is too long for the text.
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.safetensors", "model.toml"]
    assert tomllib.loads(path.read_text(encoding="utf-8"))["about"] == {
        "written_by": "a test",
        "captures": 12,
    }
    assert max(map(len, path.read_text(encoding="utf-8").splitlines())) <= 120


def with_map(nodes: np.ndarray) -> Model:
    on = bench()
    effect = catalogue()["panel_wavefront"]
    return Model(on, (replace(absent(effect, on), nodes=nodes),))


def test_a_free_form_map_comes_back_and_the_text_tells_of_it(tmp_path: Path) -> None:
    model = with_map(np.random.default_rng(0).normal(size=(7, 9)))
    write_model(tmp_path / "m.toml", model)
    assert_same(model, read_model(tmp_path / "m.toml", KNOWN))
    assert "7 x 9 nodes of a bicubic spline, in rad" in (tmp_path / "m.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("rows", [1, 2])
def test_a_free_form_curve_comes_back_and_is_no_map(tmp_path: Path, rows: int) -> None:
    on, effect = bench("red", "green"), catalogue()["phase_response"]
    nodes = np.random.default_rng(0).normal(size=(rows, 12))
    model = Model(on, (replace(absent(effect, on), nodes=nodes),))
    path = tmp_path / "m.toml"
    write_model(path, model)
    assert_same(model, read_model(path, catalogue()))
    text = path.read_text(encoding="utf-8")
    assert "12 nodes of a cubic spline, in rad" in text
    path.write_text(text.replace("curve = { array", "map = { array"), encoding="utf-8")
    with pytest.raises(InputError, match="this effect has no map"):
        read_model(path, catalogue())


def test_a_curve_of_more_rows_than_colours_is_refused(tmp_path: Path) -> None:
    on, effect = bench("red", "green"), catalogue()["phase_response"]
    write_model(tmp_path / "m.toml", Model(on, (replace(absent(effect, on), nodes=np.zeros((3, 12))),)))
    with pytest.raises(InputError, match="a row a colour, of at least 4 finite"):
        read_model(tmp_path / "m.toml", catalogue())


@pytest.mark.parametrize(
    ("given", "message"),
    [("3.0", "write { array = ... }"), ('{ array = "gone" }', "gone"), (None, "at least 4 x 4 finite")],
)
def test_a_map_that_is_none_is_refused(tmp_path: Path, given: str | None, message: str) -> None:
    path = tmp_path / "m.toml"
    write_model(path, with_map(np.zeros((7, 9)) if given else np.full((7, 9), np.nan)))
    if given:
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace('{ array = "panel_wavefront.map" }', given), encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(message)):
        read_model(path, KNOWN)


def test_an_effect_without_a_map_takes_none(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    write_model(path, Model(bench(), (absent(catalogue()["distance"], bench()),)))
    text = path.read_text(encoding="utf-8").replace("order = 0\n", 'order = 0\nmap = { array = "x" }\n', 1)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="this effect has no map"):
        read_model(path, KNOWN)


def test_an_empty_model_comes_back(tmp_path: Path) -> None:
    model = Model(bench("red", "green"))
    write_model(tmp_path / "m.toml", model)
    assert_same(model, read_model(tmp_path / "m.toml", KNOWN))


def test_the_file_tells_a_person_what_may_be_edited(tmp_path: Path) -> None:
    write_model(tmp_path / "m.toml", whole_model(bench()))
    text = (tmp_path / "m.toml").read_text(encoding="utf-8")
    for words in (
        "# how far it is; -100 to 100 mm; absent at 0",
        "# The image plane is elsewhere. [pupil]",
        "order = 5  # one of 1, 3, 5",
        "# Camera counts a unit of irradiance",
    ):
        assert words in text


def test_values_that_could_not_be_read_are_not_written(tmp_path: Path) -> None:
    on = bench()
    for bad in (np.array(1e9), np.array(np.nan), np.zeros(3)):
        present = absent(KNOWN["distance"], on).with_values({"offset": bad})
        with pytest.raises(InputError, match="distance.offset .* not written"):
            write_model(tmp_path / "m.toml", Model(on, (present,)))
    assert not list(tmp_path.iterdir())


def long_effect(count: int = 200, per_channel: bool = False) -> Effect:
    parameter = Parameter("table", "rad", 0.1, low=-5, high=5, count=count, per_channel=per_channel)
    return Effect("long_table", "drive", "display", "A long table.", (parameter,), lambda drive, table: drive)


@pytest.mark.parametrize("per_channel", [False, True])
def test_long_arrays_lie_next_to_the_file_under_a_hash(tmp_path: Path, per_channel: bool) -> None:
    on, effect = bench("red", "green"), long_effect(per_channel=per_channel)
    known = {**KNOWN, effect.name: effect}
    rng = np.random.default_rng(3)
    first = Model(on, (filled(effect, on, rng),))
    path = tmp_path / "model.toml"
    write_model(path, first)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.safetensors", "model.toml"]
    assert_same(first, read_model(path, known))
    assert "--effects" in path.read_text(encoding="utf-8")

    second = Model(on, (filled(effect, on, rng),))
    write_model(
        path, second
    )  # under another name first, so that the first model is whole until the last moment
    assert_same(second, read_model(path, known))
    assert len(list(tmp_path.iterdir())) == 2
    (array_file,) = tmp_path.glob("*.safetensors")
    data = bytearray(array_file.read_bytes())
    data[-1] ^= 1
    array_file.write_bytes(data)
    with pytest.raises(InputError, match="SHA-256"):
        read_model(path, known)
    array_file.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        read_model(path, known)
    write_model(path, Model(on))
    assert [p.name for p in tmp_path.iterdir()] == ["model.toml"]


def test_a_failed_write_leaves_the_old_model_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on, effect = bench(), long_effect()
    known = {**KNOWN, effect.name: effect}
    old = Model(on, (filled(effect, on, np.random.default_rng(1)),))
    path = tmp_path / "m.toml"
    write_model(path, old)
    import trainer.model.model_file as module

    real, calls = module.whole_file, []

    def failing(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 2:
            raise InputError("the disk is full")
        return real(*arguments)

    monkeypatch.setattr(module, "whole_file", failing)
    with pytest.raises(InputError, match="full"):
        write_model(path, Model(on, (filled(effect, on, np.random.default_rng(2)),)))
    assert_same(old, read_model(path, known))
