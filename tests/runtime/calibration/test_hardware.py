"""The same calibration through the drivers: a USB panel and guarded I2C lasers, emulated byte by byte."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from runtime.cli import main
from tests.campaigns.headset import hardware, write_configuration
from tests.runtime.calibration.drifting import DISTANCE_MM, ideal_bundle
from tests.trainer.hidden import bench_file

pytestmark = pytest.mark.usefixtures("only_service")

SHAPE = (64, 80)


def test_a_headset_behind_its_drivers_is_calibrated_and_left_dark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration = write_configuration(tmp_path)
    bench = bench_file(
        tmp_path, 'kind = "panel_wavefront"', height=SHAPE[0], width=SHAPE[1], distance_mm=DISTANCE_MM
    )
    bench.rename(tmp_path / "bench.toml")
    bundle = ideal_bundle(tmp_path / "measured", SHAPE)
    with hardware(tmp_path) as remote:
        assert main(["calibrate", str(bundle), "--headset", str(configuration), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        light = [power for _, power in remote.light()]
        assert light[-1] == 0 and max(light) == pytest.approx(
            50, rel=0.02
        )  # the configuration's half of full power
        assert result["verdict"] == "recalibrated" and result["heldout"]["after"]["excess"] < 0.001

        remote.set_to("interlock", False)
        assert main(["calibrate", str(bundle), "--headset", str(configuration)]) == 2
        said = capsys.readouterr().err
        assert "interlock" in said and said.count("\n") == 1
        assert remote.light()[-1][1] == 0
