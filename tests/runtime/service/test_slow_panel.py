"""The service over emulated hardware whose panel is slow: a video with what its bundle says of that, and without."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from runtime.service.protocol import LaserState, Shown
from runtime.solver import quality
from tests.campaigns.headset import SHAPE, write_configuration
from tests.campaigns.lane import PICTURES, Lane
from tests.runtime.benches import scene

pytestmark = pytest.mark.usefixtures("real_time")

BLACK, LEAST = 64, 5  # counts of the simulated camera without light, and above them where there is some
SHARE, REFRESH_HZ = 0.25, 25.0
BENCH = f"""
[camera]
read_noise_e = 0.5
full_well_e = 1e6
[[defect]]
kind = "slow_response"
share = {SHARE}
"""


class Seen(NamedTuple):
    """What the camera saw (dB, medians) of a video and of a still picture, and what the panel was sent.

    `plain` is the share of the video's patterns that were ever sent as they are, and `last` whether the last one was,
    when no picture came after it.
    """

    video_db: float
    still_db: float
    plain: float
    last: bool


def pictures() -> list[np.ndarray]:
    """Two pictures, irradiance [H, W]."""
    one = scene(SHAPE) / scene(SHAPE).max()
    return [one, np.roll(one[::-1, ::-1], 9, axis=1)]


def seen(folder: Path, share: float) -> Seen:
    folder.mkdir()
    file = write_configuration(folder, REFRESH_HZ, 25.0, slow_share=share, half_width=0.7)
    # the panel shows each pattern for one period
    file.write_text(file.read_text().replace("refresh_hz = 1000.0", f"refresh_hz = {REFRESH_HZ}"))
    bench = folder / "bench.toml"
    bench.write_text(bench.read_text() + BENCH)
    lane = Lane(folder, 0, file=file)
    shown: list[int] = []

    def frame() -> None:
        lane.frame()
        shown.extend(one.pattern_crc for one in lane.outcomes if isinstance(one, Shown))

    def captured(number: int) -> float:
        found: list[float] = []
        tried = 0
        while len(found) < number:
            tried += 1
            assert tried < 20 * number, f"{len(found)} of {tried} captures have light"
            frame()
            light = lane.client.capture().astype(float) - BLACK
            state = lane.client.status().lasers
            if state == LaserState.EMITTING and light.mean() > LEAST:
                found.append(max(quality(light, one).psnr_db for one in targets))
            elif state in (LaserState.OFF, LaserState.FAULT):
                assert lane.light_up()
        return float(np.median(found))

    targets = pictures()
    counts = [np.rint(65535 * one[None]).astype(np.uint16) for one in targets]
    lane.pictures = [counts[k % 2] for k in range(PICTURES)]
    try:
        assert lane.light_up()
        shown.clear()
        video_db = captured(40)
        assert lane.unanswered() == 0
        video = set(shown)
        plain = len(video & lane.remote.whole()) / len(video)
        lane.pictures = [counts[0]] * PICTURES
        for _ in range(15):
            frame()
        still_db = captured(40)
        assert lane.unanswered() == 0
        shown.extend(one.pattern_crc for one in lane.outcomes if isinstance(one, Shown))
        time.sleep(30 / REFRESH_HZ)
        return Seen(video_db, still_db, plain, shown[-1] in lane.remote.whole())
    finally:
        lane.close()


def test_a_video_is_nearer_to_its_pictures_where_the_bundle_says_that_the_panel_is_slow(
    tmp_path: Path,
) -> None:
    without, overdriven = (seen(tmp_path / str(share), share) for share in (0.0, SHARE))
    assert overdriven.video_db > without.video_db + 3
    # a capture of a still picture in which pixels go once around the phase has 18 dB; half of them have 25 or more
    assert overdriven.still_db > without.still_db - 3
    assert without.plain == 1 and without.last, "without the share, every pattern is sent as it is"
    assert overdriven.plain < 0.5 and overdriven.last, "a picture that stays ends as its own pattern"
