"""Effects that differ from colour to colour, hidden in simulated benches of three colours."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.trainer.hidden import bench_file, ran, with_few_effects

GREEN = '[[channel]]\nname = "green"\nwavelength_nm = 520\n'
RED, BLUE = (
    GREEN.replace("green", name).replace("520", nm) for name, nm in (("red", "638"), ("blue", "450"))
)


@pytest.mark.parametrize("phase_deg", [120, -200])
def test_a_coherent_ghost_is_late_by_one_path_for_all_colours(
    phase_deg: float, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one phase for all colours, a tenth of what the ghost makes is left, outside the catalogue."""
    with_few_effects(monkeypatch, "coherent_ghost", "distance")
    ghost = f'kind = "coherent_ghost"\namplitude = 0.2\nphase_deg = {phase_deg}'
    bench = bench_file(tmp_path, ghost, width=128, height=96)
    bench.write_text(bench.read_text().replace(GREEN, RED + GREEN + BLUE))
    captures = tmp_path / "captures"
    ran(capsys, "capture", "--bench", bench, "--out", captures, "--patterns", 4)
    found = ran(capsys, "explain", captures, "--out", tmp_path / "model.toml")
    assert [s["added"] for s in found["steps"]] == [None, "coherent_ghost"]
    assert found["steps"][-1]["excess"] < 3e-4
    (effect,) = found["effects"]
    value = {name: p["value"] for name, p in effect["parameters"].items()}
    assert math.hypot(value["real"], value["imaginary"]) == pytest.approx(0.2, abs=0.002)
    assert value["path_difference_nm"] == pytest.approx(phase_deg / 360 * 520, abs=3)
