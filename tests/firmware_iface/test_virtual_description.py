"""Benches in TOML and by name: what is read, what is refused, what is reported."""

from __future__ import annotations

import ast
import json
from dataclasses import fields
from pathlib import Path

import pytest

import firmware_iface
from firmware_iface import InputError
from firmware_iface.virtual import (
    CATALOGUE_KINDS,
    DEFECT_KINDS,
    load_bench,
    make_defect,
    named_benches,
)

BENCH = """
schema = 1
name = "mine"
[panel]
width = 96
height = 64
pitch_um = 8
levels = 256
fill_factor = 1.0
[[channel]]
name = "green"
wavelength_nm = 520
[propagation]
distance_mm = 12
[iris]
shape = "circle"
half_width = 0.9
[camera]
width = 96
height = 64
pixel_um = 8
registered = true
bit_depth = 12
black_level = 64
full_well_e = 10500
read_noise_e = 5
[[defect]]
kind = "zero_order"
surface_amplitude = 0.3
"""


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "bench.toml"
    path.write_text(text)
    return str(path)


def test_a_bench_is_read_from_toml(tmp_path):
    bench = load_bench(written(tmp_path, BENCH))
    assert bench.panel.width == 96 and bench.iris.shape == "circle" and bench.name == "mine"
    assert bench.defects == (make_defect("zero_order", surface_amplitude=0.3),)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("pitch_um = 8", "pich_um = 8", r"\[panel\].*'pich_um'.*did you mean 'pitch_um'"),
        ("pitch_um = 8", 'pitch_um = "8"', r"'pitch_um' in \[panel\].*finite number"),
        ('shape = "circle"', 'shape = "oval"', r"'shape' in \[iris\].*'square'"),
        ('kind = "zero_order"', 'kind = "zero_ordr"', r"\[\[defect\]\] 0.*did you mean 'zero_order'"),
        ("surface_amplitude", "surface_amplitud", r"zero_order.*did you mean 'surface_amplitude'"),
        ("surface_amplitude = 0.3", "surface_amplitude = -3", r"'surface_amplitude'.*from 0 to 2"),
        ("[iris]", "[irs]", r"'irs'.*did you mean 'iris'"),
        ("half_width = 0.9", "half_width = ", "is not TOML"),
        ("schema = 1", "schema = 9", "'schema'"),
        ("[[channel]]", "[channel]", r"\[\[channel\]\]"),
        ("registered = true", "registered = false", "'homography'"),
        ("width = 96\nheight = 64\npixel", "width = 90\nheight = 64\npixel", r"\[camera\].*registered"),
    ],
)
def test_errors_name_the_key(tmp_path, old, new, message):
    assert old in BENCH
    with pytest.raises(InputError, match=message) as caught:
        load_bench(written(tmp_path, BENCH.replace(old, new)))
    assert "\n" not in str(caught.value)


def test_unknown_benches_are_refused_with_the_nearest_name():
    with pytest.raises(InputError, match="did you mean 'zero_order'"):
        load_bench("virtual:zeroorder")
    with pytest.raises(InputError, match="nowhere.toml"):
        load_bench("nowhere.toml")


def test_one_bench_for_every_effect_of_the_catalogue():
    assert len(CATALOGUE_KINDS) == 28
    assert set(CATALOGUE_KINDS) <= set(named_benches())
    for kind in CATALOGUE_KINDS:
        assert [d.kind for d in load_bench(f"virtual:{kind}").defects] == [kind]


@pytest.mark.parametrize("name", named_benches())
def test_the_nominal_part_tells_nothing_of_the_defects(name):
    bench = load_bench(f"virtual:{name}")
    nominal = bench.nominal()
    text = json.dumps(nominal)
    for defect in bench.defects:
        # the iris and the distance have a nominal table or key of their own
        assert defect.kind in ("iris", "distance") or defect.kind not in text
    assert nominal["panel"]["fill_factor"] == 1.0
    assert list(nominal) == ["schema", "name", "panel", "channel", "propagation", "iris", "camera"]


def test_defects_have_units_or_meanings():
    for cls in DEFECT_KINDS.values():
        assert cls.stage in ("drive", "panel", "pupil", "sensor")
        assert fields(cls) and all(field.metadata["about"] for field in fields(cls))


def test_the_bench_imports_nothing_but_numpy():
    folder = Path(firmware_iface.__file__).parent
    allowed = {"numpy", "firmware_iface"}
    import sys

    for path in (folder / "virtual").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in names:
                top = name.split(".")[0]
                assert top in allowed or top in sys.stdlib_module_names, f"{path.name} imports {name}"
