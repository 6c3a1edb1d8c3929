"""Model files that a person edits: what is read, and nothing but InputError for anything else in a file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.errors import InputError
from tests.trainer.test_model_file import KNOWN
from trainer.captures.bench_file import Iris
from trainer.model.model import Model
from trainer.model.model_file import read_model

GOOD = """schema = 1
[bench]
name = "b"
[bench.panel]
width = 64
height = 48
pitch_um = 8
[[bench.channel]]
name = "red"
wavelength_nm = 638
[[bench.channel]]
name = "green"
wavelength_nm = 520
[bench.propagation]
distance_mm = 30
[bench.camera]
width = 64
height = 48
pixel_um = 8
registered = true
bit_depth = 12
black_level = 64
full_well_e = 10500
read_noise_e = 5
[propagation]
method = "angular_spectrum"
[gain]
red = 12.5
[[effect]]
name = "phase_response"
order = 1
[effect.parameters.gain]
value = { red = 1.1, green = 1.2 }
error = { red = 0.1, green = nan }
unit = "1"
[effect.parameters.curvature]
value.red = [0.1]
value.green = [0]
unit = "rad"
[[effect]]
name = "distance"
order = 0
[effect.parameters.offset]
value = 2
unit = "mm"
[[history]]
added = "distance"
"""


def read_text(tmp_path: Path, text: str, **options: Any) -> Model:
    path = tmp_path / "m.toml"
    path.write_text(text, encoding="utf-8")
    return read_model(path, KNOWN, **options)


def test_what_a_person_writes_is_read(tmp_path: Path) -> None:
    model = read_text(tmp_path, GOOD)
    assert model.names == ("phase_response", "distance")
    assert float(model.present[1].values["offset"]) == 2.0
    assert model.present[0].values["gain"].tolist() == [1.1, 1.2]
    assert model.present[1].errors is None


def test_a_parameter_that_a_file_of_before_lacks_is_absent(tmp_path: Path) -> None:
    start = GOOD.index("[effect.parameters.gain]")
    end = GOOD.index("[effect.parameters.curvature]")
    model = read_text(tmp_path, GOOD[:start] + GOOD[end:])
    assert model.present[0].values["gain"].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("change", "by", "message"),
    [
        ("schema = 1", "schema = 2", "schema is 2.*schema = 1"),
        ("[gain]", "[gains]", "gains is not known: did you mean 'gain'"),
        ("red = 12.5", "red = -1", "gain.red is -1.*above 0"),
        ("red = 12.5", "blue = 1", "gain.blue is not known"),
        ("red = 12.5", "red = true", "gain.red is True"),
        ('"angular_spectrum"', '"angular"', "propagation.method is 'angular'.*angular_spectrum, fresnel"),
        ("pitch_um = 8", "pitch_um = -8", r"bench: panel.pitch_um is -8"),
        ("pitch_um = 8", "", r"panel.pitch_um is missing in \[bench\]"),
        (
            'name = "distance"',
            'name = "distanc"',
            "unknown effect 'distanc': did you mean 'distance'.*--effects",
        ),
        ('name = "distance"', 'name = "phase_response"', "order is 0: write one of 1, 3, 5"),
        ("order = 1", "order = 2", "order is 2: write one of 1, 3, 5"),
        ("order = 1", "order = 3", r"curvature.value.red is 1 numbers: order 3 has a list of 3"),
        ("value = 2", 'value = "2"', "distance.offset.value is '2': write -100 to 100 mm"),
        ("value = 2", "value = 2000", "distance.offset.value is 2000: write -100 to 100 mm"),
        ("value = 2", "value = nan", "distance.offset.value is nan"),
        ("value = 2", "valeu = 2", "distance.offset.valeu is not known: did you mean 'value'"),
        ("value = 2", "value = [2]", r"distance.offset.value is \[2\]"),
        ("value = 2", 'value = { array = "x" }', "names the array 'x'"),
        ('"mm"', '"m"', "distance.offset.unit is 'm': write 'mm'"),
        ("offset]", "ofset]", "parameters.ofset is not known: did you mean 'offset'"),
        ("value = { red = 1.1, green = 1.2 }", "value = 1.1", "gain.value is 1.1: write one a channel"),
        ("value = { red = 1.1, green = 1.2 }", "value = { red = 1.1 }", "gain.value.green is missing"),
        ("value = { red = 1.1, green = 1.2 }", "value = { red = 1.1, gren = 1 }", "gren is not known"),
        (
            "value = { red = 1.1, green = 1.2 }",
            "value = { red = 9, green = 1 }",
            "gain.value is 9: write 0.2 to 3",
        ),
        ("error = { red = 0.1,", "error = { red = -0.1,", "gain.error is -0.1"),
        ("[[history]]", "[history]", "history is .*two brackets"),
        ('added = "distance"', "added = 2020-01-01", "history 1.added is"),
        ('[[effect]]\nname = "distance"', "[[effect]]\nname = 3", "effect 2 has name 3"),
    ],
)
def test_a_wrong_key_is_named_with_what_is_allowed(
    tmp_path: Path, change: str, by: str, message: str
) -> None:
    assert change in GOOD
    with pytest.raises(InputError, match=re.compile(message, re.DOTALL)) as caught:
        read_text(tmp_path, GOOD.replace(change, by, 1))
    assert "\n" not in str(caught.value)
    assert "m.toml" in str(caught.value)


def test_an_effect_twice_is_one_too_many(tmp_path: Path) -> None:
    part = GOOD[GOOD.index('[[effect]]\nname = "distance"') : GOOD.index("[[history]]")]
    with pytest.raises(InputError, match="second 'distance'"):
        read_text(tmp_path, GOOD.replace("[[history]]", part + "[[history]]"))


def test_a_model_of_another_bench_says_what_differs(tmp_path: Path) -> None:
    model = read_text(tmp_path, GOOD)
    own = model.bench
    assert read_text(tmp_path, GOOD, bench=replace(own, name="other", distance_mm=31.0)).names
    cases = [
        (replace(own, panel=replace(own.panel, pitch_um=6.4)), "panel.pitch_um is 8.0 there and 6.4"),
        (
            replace(own, camera=replace(own.camera, black_level=60.0)),
            "camera.black_level is 64.0 there and 60.0",
        ),
        (replace(own, iris=Iris("circle")), "iris.shape is 'square' there and 'circle'"),
        (
            replace(own, channels=own.channels[:1]),
            "channels are red 638 nm [+] green 520 nm there and red 638 nm in",
        ),
    ]
    for other, message in cases:
        with pytest.raises(InputError, match=message):
            read_text(tmp_path, GOOD, bench=other)


def test_a_missing_file_and_no_toml_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_model(tmp_path / "none.toml", KNOWN)
    with pytest.raises(InputError, match="cannot be read"):
        read_model(tmp_path, KNOWN)
    (tmp_path / "m.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not TOML"):
        read_model(tmp_path / "m.toml", KNOWN)
