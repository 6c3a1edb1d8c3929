"""The module `hololoop`: what is public in Python, and that nothing heavy comes with it."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hololoop
from runtime.program.threads import WAITING

ROOT = Path(__file__).resolve().parent.parent

PUBLIC = [
    "CaptureSet",
    "CheckResult",
    "ComparisonResult",
    "DeviceError",
    "DiagnosisResult",
    "ExplanationResult",
    "InputError",
    "Model",
    "PatternResult",
    "Solver",
    "check",
    "compare",
    "diagnose",
    "explain",
    "export",
    "read_captures",
    "read_model",
    "write_model",
]

BENCH = """
[panel]
width = 64
height = 48
pitch_um = 8.0
[propagation]
distance_mm = 4
[[defect]]
kind = "distance"
"""


def modules_after(script: str) -> set[str]:
    """Modules that a fresh interpreter has imported after a script."""
    done = subprocess.run(
        [sys.executable, "-c", f"{script}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def loaded_after(script: str) -> set[str]:
    """Top-level modules that a fresh interpreter has imported after a script."""
    return {name.split(".")[0] for name in modules_after(script)}


def test_threads_wait_asleep_unless_the_environment_says_otherwise() -> None:
    """OpenMP reads the environment when torch loads, so it is said as soon as hololoop is imported."""
    script = "import os, hololoop; print(os.environ['OMP_WAIT_POLICY'], os.environ['GOMP_SPINCOUNT'])"

    def said(**given: str) -> str:
        bare = {k: v for k, v in os.environ.items() if k not in WAITING}
        run = subprocess.run(
            [sys.executable, "-c", script],
            cwd=ROOT,
            env=bare | given,
            capture_output=True,
            text=True,
            check=True,
        )
        return run.stdout.strip()

    assert said() == "PASSIVE 0"
    assert said(OMP_WAIT_POLICY="ACTIVE") == "ACTIVE 0"


def test_these_names_are_public_and_no_others() -> None:
    assert sorted(hololoop.__all__) == PUBLIC
    assert dir(hololoop) == PUBLIC
    for name in PUBLIC:
        assert getattr(hololoop, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'Catalog'"):
        hololoop.Catalog  # noqa: B018


def test_what_type_checkers_see_is_what_is_given() -> None:
    """The imports under TYPE_CHECKING and the table that is used at run time name the same things."""
    module = ast.parse((ROOT / "hololoop.py").read_text(encoding="utf-8"))
    (checked,) = (node for node in module.body if isinstance(node, ast.If))  # if TYPE_CHECKING
    seen = {}
    for node in checked.body:
        assert isinstance(node, ast.ImportFrom)
        seen |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
    assert seen == hololoop._DEFINED_IN


def test_importing_it_brings_neither_torch_nor_numpy() -> None:
    modules = modules_after("import hololoop")
    loaded = {name.split(".")[0] for name in modules}
    assert "hololoop" in loaded
    assert not loaded & {"torch", "numpy", "scipy", "matplotlib", "trainer", "firmware_iface"}
    # Of its own packages only what says how threads wait and memory is kept.
    settings = {"runtime", "runtime.program", "runtime.program.large_blocks", "runtime.program.threads"}
    assert {name for name in modules if name.split(".")[0] == "runtime"} == settings


def test_the_solver_comes_without_torch_and_the_trainer() -> None:
    loaded = loaded_after("import hololoop; hololoop.Solver, hololoop.PatternResult, hololoop.InputError")
    assert "runtime" in loaded
    assert not loaded & {"torch", "trainer", "matplotlib"}


def test_no_package_imports_it() -> None:
    for package in hololoop._OWN:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert not any(name.split(".")[0] == "hololoop" for name in names), path


def test_a_missing_package_is_named_with_what_installs_it() -> None:
    script = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "import hololoop\n"
        "try:\n    hololoop.explain\n"
        "except ImportError as error:\n    assert \"pip install 'hololoop[trainer]'\" in str(error), error\n"
        "else:\n    raise SystemExit('no error')"
    )
    assert "hololoop" in loaded_after(script)


@pytest.fixture(scope="module", autouse=True)
def _few_effects() -> Iterator[None]:
    """What is found is what the commands find, which have tests of their own."""
    from tests.trainer.hidden import with_few_effects

    with pytest.MonkeyPatch.context() as patch:
        with_few_effects(patch, "distance", "zero_order", "illumination", "phase_response", "sensor_blur")
        yield


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> hololoop.CaptureSet:
    """A small set from a bench whose image plane is 0.18 mm off."""
    from trainer.cli import main

    folder = tmp_path_factory.mktemp("hololoop")
    (folder / "bench.toml").write_text(BENCH)
    where = str(folder / "captures")
    assert main(["capture", "--bench", str(folder / "bench.toml"), "--patterns", "6", "--out", where]) == 0
    return hololoop.read_captures(where)


@pytest.fixture(scope="module")
def explanation(captures: hololoop.CaptureSet) -> hololoop.ExplanationResult:
    return hololoop.explain(captures)


def test_captures_and_their_check_show_themselves(captures: hololoop.CaptureSet) -> None:
    html = captures._repr_html_()
    assert "green" in html and "4 mm" in html
    found = hololoop.check(captures)
    assert found.sound and not found.problems
    assert "Nothing is wrong" in found._repr_html_()


def test_what_is_wrong_is_listed_and_escaped(captures: hololoop.CaptureSet, tmp_path: Path) -> None:
    folder = tmp_path / "a<b"
    folder.mkdir()
    found = hololoop.check(folder)
    assert not found.sound
    assert "<table>" in found._repr_html_() and "a<b" not in found._repr_html_()
    with pytest.raises(hololoop.InputError, match="is not a folder"):
        hololoop.check(tmp_path / "nowhere")


def test_a_comparison_is_the_commands(captures: hololoop.CaptureSet) -> None:
    found = hololoop.compare(captures)
    assert found.excess is not None and found.excess > 0.05
    assert found.as_json()["heldout"]["excess"] == found.excess
    assert found.nrmse is not None and found.noise_nrmse is not None and found.nrmse > found.noise_nrmse
    assert "data:image/png;base64," in found._repr_html_()


def test_an_explanation_has_a_model_a_ladder_and_a_figure(
    explanation: hololoop.ExplanationResult, tmp_path: Path
) -> None:
    assert explanation.model.names == ("distance",)
    assert [step["added"] for step in explanation.ladder] == [None, "distance"]
    assert explanation.verdict == "complete"
    assert explanation.sentence.startswith("Nothing is missing")
    assert explanation.ladder[0]["excess"] > 100 * explanation.ladder[-1]["excess"]
    figure = explanation.figure()
    figure.savefig(tmp_path / "explanation.png")
    assert figure._repr_png_().startswith(b"\x89PNG")
    html = explanation._repr_html_()
    assert "+ distance" in html and "Nothing is missing" in html and "data:image/png;base64," in html
    explanation.report(tmp_path / "explanation.html")
    assert "distance" in (tmp_path / "explanation.html").read_text(encoding="utf-8")


def test_a_diagnosis_ranks_what_is_missing(
    captures: hololoop.CaptureSet, explanation: hololoop.ExplanationResult
) -> None:
    found = hololoop.diagnose(captures, explanation.model)
    assert found.verdict == "complete" and found.stage is None
    assert found.ranking == found.as_json()["ranking"]
    assert "Nothing is missing" in found._repr_html_()


def test_a_misread_set_is_refused(captures: hololoop.CaptureSet, tmp_path: Path) -> None:
    """The bench file says that more gray means less phase, which is not so."""
    import shutil

    folder = tmp_path / "reversed"
    shutil.copytree(captures.folder, folder)
    text = (folder / "bench.toml").read_text()
    assert "phase_sign = 1" in text
    (folder / "bench.toml").write_text(text.replace("phase_sign = 1", "phase_sign = -1"))
    for function in (hololoop.explain, hololoop.diagnose):
        with pytest.raises(hololoop.InputError, match="phase_sign"):
            function(folder)


def test_a_model_is_written_read_and_exported_and_a_picture_solved(
    captures: hololoop.CaptureSet, explanation: hololoop.ExplanationResult, tmp_path: Path
) -> None:
    hololoop.write_model(tmp_path / "model.toml", explanation.model, captures)
    assert captures.content_hash() in (tmp_path / "model.toml").read_text(encoding="utf-8")
    again = hololoop.read_model(tmp_path / "model.toml", captures)
    assert again.names == explanation.model.names
    result = hololoop.export(again, captures, tmp_path / "bundle")
    assert result["effects"] == ["distance"]
    with pytest.raises(hololoop.InputError):
        hololoop.export(again, captures, tmp_path / "bundle")
    hololoop.export(tmp_path / "model.toml", None, tmp_path / "bundle", replace=True)

    solver = hololoop.Solver(tmp_path / "bundle")
    assert (solver.channel, solver.plane_mm, solver.shape) == ("green", 4.0, (48, 64))
    y, x = np.mgrid[:48, :64]
    light = 0.2 + 0.8 * ((y - 20.0) ** 2 + (x - 30.0) ** 2 < 150)
    found = solver.solve(light, 10)
    assert found.gray.dtype == np.uint8 and found.gray.shape == (48, 64)
    assert found.iterations == 10 and found.psnr_db > 15
    assert float(np.corrcoef(found.predicted.ravel(), light.ravel())[0, 1]) > 0.8
    assert 0.5 < float(found.predicted[light == 1].mean()) < 2
    first = found.gray.copy()
    found.save(tmp_path / "pattern.png")
    assert np.array_equal(np.asarray(Image.open(tmp_path / "pattern.png")), first)
    assert found._repr_html_().count("data:image/png;base64,") == 2

    Image.fromarray(np.full((30, 90), 128, np.uint8)).save(tmp_path / "picture.png")
    with pytest.raises(hololoop.InputError, match="is needed"):
        solver.solve(tmp_path / "picture.png")
    assert solver.solve(tmp_path / "picture.png", 1, fit=True).iterations == 1
    assert solver.solve(np.ones((96, 128)), 1, fit=True).iterations == 1
    assert np.array_equal(found.gray, first), "a result does not change with the next solve"
