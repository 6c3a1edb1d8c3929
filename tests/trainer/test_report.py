"""`trainer.report`: the file needs nothing else, has the numbers, and is safe with hostile names."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from firmware_iface.errors import InputError
from trainer.captures.bench_file import read_bench
from trainer.effects import catalogue
from trainer.formatting import measured, number, parameters, percent
from trainer.model.model import Model, absent
from trainer.report import write_report
from trainer.report.heat_maps import blocks, heat_map, place
from trainer.report.ladder import ladder_rows

VOID = {"meta", "img", "br", "link", "input", "hr", "wbr"}
HOSTILE = '<script>alert("1")</script> & $\\frac{a}$'


class Page(HTMLParser):
    """Elements of a page, with a check that every one that is opened is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [a for t, a in self.elements if t == tag]


def comparison(shape: tuple[int, int] = (48, 64), channel: str = "green") -> Any:
    rng = np.random.default_rng(2)
    light = rng.exponential(200, shape).astype(np.float32)
    difference = rng.normal(0, 10, shape).astype(np.float32)
    difference[:3] = np.nan
    picture = SimpleNamespace(
        capture="0007", channel=channel, plane_mm=30.0, measured=light, predicted=light - 3,
        difference=difference, excess=0.0123, nrmse=0.157,
    )  # fmt: skip
    numbers = {"nrmse": 0.157, "noise_nrmse": 0.0678, "excess": 0.0197}
    field: list[list[float | None]] = [[0.001] * 16 for _ in range(12)]
    field[10][1], field[0][0] = 0.2345, None
    spectrum = [
        {"cycles_per_pixel": f, "error": 900.0, "noise": 100.0, "signal": 1e4} for f in (0.1, 0.3, 0.5)
    ]
    steps = [{"counts": c, "error": 4.0, "bias": 1.0, "noise": 9.0, "pixels": 500} for c in (10.0, 200.0)]
    times = [
        {"time_s": t, "capture": "1", "channel": channel, "gain": 1 + t / 100, "excess": 0.01} for t in (1, 5)
    ]
    found = {
        "heldout": numbers,
        "psnr_db": 31.27,
        "noise_from_repeats": 1.013,
        "by_channel": {channel: numbers},
        "by_plane": {"30": numbers, "40": {**numbers, "excess": None}},
        "by_capture": [{"capture": "0007", "channel": channel, "plane_mm": 30.0, "gain": 1.01, **numbers}],
        "where": {"field": field, "tile_px": 4, "frequency": spectrum, "brightness": steps, "time": times},
    }
    return SimpleNamespace(as_json=lambda: found, pictures=(picture,))


def diagnosis(name: str = "spatial_coherence", verdict: str = "missing") -> Any:
    ranking = [
        {"effect": name, "stage": "pupil", "excess_after": 0.0011, "excess_removed": 0.0186,
         "ci95": [0.0181, 0.0191], "indistinguishable_from": ["sensor_blur"],
         "parameters": {"extent_mrad": {"value": 1.234, "error": 0.056, "unit": "mrad"}}},
        {"effect": "crosstalk", "stage": "drive", "excess_after": 0.0197, "excess_removed": 1e-5,
         "ci95": [-1e-4, 1.2e-4], "parameters": {}, "indistinguishable_from": []},
    ]  # fmt: skip
    found = {
        "heldout": {"nrmse": 0.157, "noise_nrmse": 0.0678, "excess": 0.0197},
        "verdict": verdict,
        "stage": "pupil",
        "stages": [
            {"stage": "pupil", "excess_removed": 0.0177},
            {"stage": "drive", "excess_removed": -0.0002},
        ],
        "ranking": ranking,
        "suggested_captures": ["the same patterns at 48 mm: they differ there by 3.1 %"],
        "ideal_excess": 0.0197,
        "sentence": "spatial_coherence is missing: it explains 94 % of the excess.",
        "thresholds": {
            "level": 0.05, "share": 0.02, "excess": 1e-4, "complete_share": 0.02, "complete_excess": 3e-4
        },
    }  # fmt: skip
    wave = np.sin(np.arange(40) / 3)
    pictures = [
        ("pupil", "amplitude passed", np.outer(wave, wave) + 1j, "relative"),
        ("drive", "response", wave, "rad"),
    ]
    return SimpleNamespace(as_json=lambda: found, probe_pictures=pictures)


LADDER = [
    {"added": None, "nrmse": 0.4567, "excess": 0.203, "indistinguishable_from": []},
    {"added": "illumination", "nrmse": 0.157, "excess": 0.0197, "indistinguishable_from": ["vignetting"]},
    {"added": None, "removed": "zero_order", "nrmse": 0.0701, "excess": 0.0002, "indistinguishable_from": []},
]


def model(name: str = "bench") -> Model:
    bench = read_bench(
        {
            "schema": 1, "name": name,
            "panel": {"width": 64, "height": 48, "pitch_um": 8},
            "channel": [{"name": "green", "wavelength_nm": 520}],
            "propagation": {"distance_mm": 30},
            "iris": {"shape": "square", "half_width": 1.0},
            "camera": {"width": 64, "height": 48, "pixel_um": 8, "registered": True, "bit_depth": 12,
                       "black_level": 64, "full_well_e": 10500, "read_noise_e": 5},
        }
    )  # fmt: skip
    effects = catalogue()
    distance = absent(effects["distance"], bench)
    distance = distance.with_values({"offset": np.array(0.3217)})
    return Model(bench, (distance, absent(effects["phase_response"], bench)), {"green": 88.7})


def whole(path: Path, **given: Any) -> Page:
    write_report(path, given.pop("title", "A bench"), **given)
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("reports") / "all.html"
    return whole(
        path,
        comparison=comparison(),
        diagnosis=diagnosis(),
        ladder={"steps": LADDER, "noise_nrmse": 0.0678},
        model=model(),
    )


def test_the_file_needs_nothing_else(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "all.html"
    whole(path, comparison=comparison(), diagnosis=diagnosis(), ladder=LADDER, model=model())
    text = path.read_text(encoding="utf-8")
    assert "http:" not in text and "https:" not in text and "@import" not in text
    assert not page.all("script") and not page.all("link") and not page.all("iframe")
    for _, attributes in page.elements:
        for key in ("src", "href", "xlink:href", "srcset", "poster"):
            assert attributes.get(key, "#").startswith(("#", "data:image/png;base64,"))
    links = re.findall(r"url\(\s*['\"]?([^)]*)", text)
    assert links and all(u.startswith("#") for u in links)
    assert path.stat().st_size < 400_000


def test_every_number_of_the_results_is_there(page: Page) -> None:
    said = (
        "15.7 %", "6.78 %", "0.0197", "31.3 dB", "1.01 ×",  # facts
        "45.7 %", "illumination", "− zero_order", "7.01 %",  # ladder
        "0.0177", "removes nothing",  # stages
        "0.0186", "0.0181 to 0.0191", "1.234 ± 0.056 mrad", "sensor_blur", "0.0011",  # ranking
        "the same patterns at 48 mm", "spatial_coherence and sensor_blur explain",  # undecided
        "0.0003", "0.02", "5 %", "0.000394",  # thresholds
        "0.322 mm", "88.7",  # model
        "excess 0.234 there", "spatial_coherence is missing: it explains 94 %",
    )  # fmt: skip
    for text in said:
        assert text in page.text, text


def test_every_picture_has_a_description(page: Page) -> None:
    pictures = page.all("img")
    assert len(pictures) == 5  # measured, predicted, difference; field; a probe
    assert all(len(p["alt"]) > 40 for p in pictures)
    assert any("lower left" in p["alt"] for p in pictures)
    drawn = page.all("svg")
    assert len(drawn) == 7  # ladder, stages, a curve, forest, frequency, brightness, time
    assert all(d["role"] == "img" and len(d["aria-label"]) > 40 for d in drawn)


def test_ids_are_used_once(page: Page) -> None:
    ids = [a["id"] for _, a in page.elements if "id" in a]
    assert ids and len(ids) == len(set(ids))


def test_charts_take_the_pages_colours(tmp_path: Path) -> None:
    whole(tmp_path / "r.html", comparison=comparison(), diagnosis=diagnosis(), ladder=LADDER)
    charts = re.findall(r"<svg.*?</svg>", (tmp_path / "r.html").read_text(encoding="utf-8"), re.DOTALL)
    assert charts and all("var(--ink)" in c for c in charts)
    assert not any(re.search(r"#0[1-7]0[1-7]0[1-7]|#000000", c) for c in charts)


def test_names_cannot_become_markup(tmp_path: Path) -> None:
    given = {
        "title": HOSTILE,
        "comparison": comparison(channel=HOSTILE),
        "diagnosis": diagnosis(name=HOSTILE),
        "ladder": [LADDER[0], {**LADDER[1], "added": HOSTILE}],
        "model": model(name="a<b>"),
    }
    page = whole(tmp_path / "r.html", **given)
    assert not page.all("script")
    assert page.text.count(HOSTILE) > 3


def test_sections_without_data_are_left_out(tmp_path: Path) -> None:
    page = whole(tmp_path / "empty.html")
    assert [t for t, _ in page.elements].count("h2") == 1 and not page.all("svg")
    page = whole(tmp_path / "ladder.html", ladder=LADDER)
    assert "ladder of errors" in page.text and "Which effect" not in page.text
    page = whole(tmp_path / "compare.html", comparison=comparison())
    assert "Over the field" in page.text and "ladder of errors" not in page.text
    assert "2.3 times the camera's noise" in page.text


@pytest.mark.parametrize(
    ("verdict", "said"),
    [("complete", "Complete"), ("missing", "missing"), ("outside_catalogue", "outside the catalogue")],
)
def test_the_verdict_is_said_first(tmp_path: Path, verdict: str, said: str) -> None:
    found = diagnosis(verdict=verdict)
    values = found.as_json()
    del values["sentence"]
    page = whole(tmp_path / "r.html", diagnosis=found)
    assert said in page.text[: page.text.index("held-out error")]


def test_the_models_own_history_is_a_ladder(tmp_path: Path) -> None:
    steps = ({"added": "", "nrmse": 0.4, "excess": 0.16}, {"added": "distance", "nrmse": 0.1, "excess": 0.01})
    given = model()
    page = whole(tmp_path / "r.html", model=Model(given.bench, given.present, given.gain, history=steps))
    assert "+ distance" in page.text


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    path.write_text("before")
    broken = SimpleNamespace(as_json=lambda: {"heldout": {}, "verdict": "missing"})
    with pytest.raises(KeyError):
        write_report(path, "t", diagnosis=broken)
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(InputError):
        write_report(tmp_path / "no" / "r.html", "t")


def test_large_pictures_become_small_and_keep_a_detail(tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    page = whole(path, comparison=comparison((1080, 1920)))
    assert path.stat().st_size < 1_500_000
    assert "each point is the mean of 4 × 4 pixels" in page.text and "pixel by pixel" in page.text


def test_colours_span_the_stated_scale() -> None:
    array = np.array([[-5.0, 0.0], [5.0, np.nan]])
    drawn = heat_map("t", array, "alt", "counts", (-5.0, 5.0), "RdBu_r")
    data = base64.b64decode(drawn.uri.split(",")[1])
    pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
    assert pixels[0, 0, 2] > pixels[0, 0, 0] and pixels[1, 0, 0] > pixels[1, 0, 2]
    assert np.ptp(pixels[0, 1]) < 6 and tuple(pixels[1, 1]) == (128, 128, 128)
    assert [t.text for t in drawn.scale] == ["−5.00", "0", "5.00"]


def test_blocks_leave_out_what_is_not_known() -> None:
    array = np.array([[1.0, np.nan, 4.0], [3.0, np.nan, 4.0], [9.0, 9.0, 9.0]])
    assert blocks(array, 2).tolist() == [[2.0]]
    assert place(0.9, 0.1) == "lower left" and place(0.5, 0.5) == "centre" and place(0.1, 0.5) == "top centre"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.012345, "0.0123"), (1234.5, "1234"), (-2.0, "−2.00"), (0, "0"), (None, "–"), (float("nan"), "–"),
     (2.4e-6, "2.40 × 10⁻⁶")],
)  # fmt: skip
def test_numbers_have_three_digits(value: float | None, text: str) -> None:
    assert number(value) == text
    assert percent(0.1234) == "12.3 %"


def test_values_are_rounded_to_their_errors() -> None:
    assert measured(-0.199712, 0.00042) == "−0.19971 ± 0.00042"
    assert measured(12.3456, 0.5, "mm") == "12.35 ± 0.50 mm"
    assert measured(3.0, None, "1") == "3.00"


def test_parameters_by_colour_and_long_lists_are_one_line_each() -> None:
    given = {
        "gain": {"value": {"red": 1.1, "blue": 0.9}, "error": {"red": 0.1, "blue": 0.1}, "unit": "1"},
        "offset_mm": {"value": 0.5, "error": None, "unit": "mm"},
        "map": {"value": [0.0, 0.3, -0.4, 0, 0, 0], "error": [0.01] * 6, "unit": "rad"},
        "plain": 7,
    }
    shown = parameters(given)
    assert [p.name for p in shown] == ["gain, red", "gain, blue", "offset", "map", "plain"]
    assert shown[0].text == "1.10 ± 0.10" and shown[2].text == "0.500 mm"
    assert "6 terms, together 0.500 rad" in shown[3].text and len(shown[3].terms) == 6


@pytest.mark.parametrize(("error", "value"), [(float("nan"), 0.0), (None, 0.0), (0.2, 0.0), (None, 3.0)])
def test_a_number_of_which_the_captures_say_nothing_is_no_zero(error: float | None, value: float) -> None:
    share = {"value": value, "error": error, "unit": "1"}
    fitted = {"counts": {"value": [70.0, 2.0], "error": [0.5, 0.6], "unit": "counts"}, "laser_share": share}
    text = parameters(fitted)[1].text
    assert (text == "not told by these captures") == (error != 0.2 and value == 0)
    assert parameters({"laser_share": share})[0].text != "not told by these captures"  # nothing was fitted
    apart = {"value": {"red": 0.0, "blue": 0.4}, "error": {"red": None, "blue": 0.1}, "unit": "1"}
    assert [p.text for p in parameters({"laser_share": apart})] == [
        "not told by these captures",
        "0.40 ± 0.10",
    ]


def test_a_map_that_went_on_is_a_step_of_the_ladder() -> None:
    errors = {"nrmse": 0.1, "noise_nrmse": 0.05, "excess": 0.01}
    steps = [
        {"added": "", **errors},
        {"added": "illumination", **errors},
        {"added": "", "refined": "illumination", **errors},
        {"added": "", "removed": "crosstalk", **errors},
    ]
    changes = [row["change"] for row in ladder_rows(steps)]
    assert changes == ["ideal model", "+ illumination", "map of illumination", "− crosstalk"]
