"""A camera that does not look at the panel's own pixels is found from a dot pattern, through the command."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
from PIL import Image

from firmware_iface.virtual import VirtualHeadset, load_bench
from tests.trainer.hidden import LARGER, bench_file, ran
from trainer.cli import main

# 6 um camera pixels behind a relay, mirrored, a little rotated, off centre.
TRUTH = np.array([[-0.75, 0.02, 150.0], [0.02, 0.75, -2.0], [0.0, 0.0, 1.0]])


def test_dots_shown_seen_and_found(tmp_path: Path, capsys) -> None:
    spec = bench_file(tmp_path, **LARGER)
    camera = "registered = false\nhomography = " + str([[float(v) for v in row] for row in TRUTH])
    text = spec.read_text().replace("registered = true", camera)
    text = text.replace(
        "[camera]\nwidth = 160\nheight = 128\npixel_um = 8",
        "[camera]\nwidth = 200\nheight = 170\npixel_um = 6",
    )
    spec.write_text(text)
    headset = VirtualHeadset(load_bench(str(spec)), seed=1)

    # The user's bench file: no homography yet, and a comment that must stay.
    bench = tmp_path / "bench.toml"
    user_text = text.replace(camera, "registered = false  # measured by hand, roughly")
    bench.write_text("schema = 1\n" + user_text)
    shown = ran(capsys, "register", bench, "--spacing", 20, "--out", tmp_path / "dots.png")
    headset.panel.show(np.asarray(Image.open(shown["pattern"])))
    headset.lasers.set_power("green", 1.0)
    headset.camera.exposure_ms = 2.0
    Image.fromarray(headset.camera.capture()).save(tmp_path / "seen.png")

    found = ran(capsys, "register", bench, tmp_path / "seen.png", "--spacing", 20)
    matrix = np.array(found["homography"])
    corners = np.array([[20, 20, 1], [180, 20, 1], [20, 150, 1], [180, 150, 1.0]]).T
    there, expected = matrix @ corners, TRUTH @ corners
    assert np.abs(there[:2] / there[2] - expected[:2] / expected[2]).max() < 0.3
    written = bench.read_text()
    assert "# measured by hand, roughly" in written
    assert np.allclose(tomllib.loads(written)["camera"]["homography"], matrix, rtol=1e-8, atol=1e-6)

    assert main(["register", str(bench)]) == 2
    assert "--out DOTS.png" in capsys.readouterr().err
