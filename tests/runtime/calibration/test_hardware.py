"""The same calibration through the drivers: a USB panel and guarded I2C lasers, emulated byte by byte."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import pytest

from runtime.cli import main
from tests.campaigns.headset import hardware, write_configuration
from tests.runtime.calibration.drifting import DISTANCE_MM, ideal_bundle
from tests.trainer.hidden import bench_file

pytestmark = pytest.mark.usefixtures("real_time", "spared_maps")

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
    with ExitStack() as stack:
        for _ in range(5):  # a busy machine may stop the heartbeat: then the lasers are dark, and it ends
            remote = stack.enter_context(hardware(tmp_path))
            code = main(["calibrate", str(bundle), "--headset", str(configuration), "--json"])
            said = capsys.readouterr()
            if not (
                code == 2 and ("heartbeat" in said.err + said.out or "was silent" in said.err + said.out)
            ):
                break
            stack.pop_all().close()  # a person would look, and switch the board off and on
        assert code == 0, said
        result = json.loads(said.out)
        light = [power for _, power in remote.light()]
        assert light[-1] == 0 and max(light) == pytest.approx(
            50, rel=0.02
        )  # the configuration's half of full power
        assert result["verdict"] == "recalibrated" and result["heldout"]["after"]["excess"] < 0.001

        remote.set_to("interlock", False)
        assert main(["calibrate", str(bundle), "--headset", str(configuration)]) == 2
        refusal = capsys.readouterr().err
        assert "interlock" in refusal and refusal.count("\n") == 1
        assert remote.light()[-1][1] == 0
