"""Whatever stands in a model file, reading gives a model or an InputError of one line, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from firmware_iface.errors import InputError
from trainer.captures.bench_file import Bench, Camera, Channel, Iris, Panel
from trainer.effects.effect_catalogue import catalogue
from trainer.model.model import Model, absent
from trainer.model.model_file import read_model, write_model

KNOWN = catalogue()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The lines of a model that can be read."""
    camera = Camera(64, 48, 8.0, True, 12, 64.0, 10500.0, 5.0)
    channels = (Channel("red", 638.0), Channel("green", 520.0))
    on = Bench("b", Panel(64, 48, 8.0), channels, 30.0, Iris(), camera)
    present = tuple(absent(KNOWN[n], on) for n in ("phase_response", "distance", "ghost"))
    path = tmp_path_factory.mktemp("good") / "m.toml"
    write_model(path, Model(on, present, {"red": 12.5}, history=({"added": "ghost", "nrmse": 0.1},)))
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def read_text(folder: Path, text: str) -> Model:
    path = folder / "m.toml"
    path.write_text(text, encoding="utf-8")
    return read_model(path, KNOWN)


def test_the_lines_can_be_read(tmp_path: Path, good: list[str]) -> None:
    assert read_text(tmp_path, "\n".join(good)).names == ("phase_response", "distance", "ghost")


SCRAP = st.one_of(
    st.integers(-(10**40), 10**40),
    st.floats(),
    st.booleans(),
    st.text(max_size=6),
    st.just([]),
    st.just([1, [2]]),
    st.just({}),
    st.just({"array": "x"}),
    st.just({"red": 1.0, "green": 1e400}),
    st.just([1.0] * 3),
    st.just("2020-01-01T00:00:00Z"),
)


def toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(c if c.isascii() and c.isalnum() else "_" for c in value) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + "}"
    return repr(value)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_edit_gives_anything_but_a_model_or_an_input_error(
    tmp_path: Path, good: list[str], data: st.DataObject
) -> None:
    lines = list(good)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        what = data.draw(st.sampled_from(("value", "drop", "twice", "cut", "swap")))
        if what == "value" and "=" in lines[at]:
            lines[at] = lines[at].split("=")[0] + "= " + toml(data.draw(SCRAP))
        elif what == "drop":
            lines[at] = ""
        elif what == "twice":
            lines.insert(at, lines[at])
        elif what == "cut":
            lines[at] = lines[at][: data.draw(st.integers(0, len(lines[at])))]
        else:
            other = data.draw(st.integers(0, len(lines) - 1))
            lines[at], lines[other] = lines[other], lines[at]
    try:
        model = read_text(tmp_path, "\n".join(lines))
    except InputError as error:
        assert "\n" not in str(error)
        return
    write_model(tmp_path / "again.toml", model)
    assert read_model(tmp_path / "again.toml", KNOWN).names == model.names


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_no_bytes_give_anything_but_an_input_error(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "m.toml").write_bytes(data)
    with pytest.raises(InputError):
        read_model(tmp_path / "m.toml", KNOWN)
