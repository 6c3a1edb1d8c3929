"""What the camera sees of the demo's patterns: in one colour, or in several that are shown in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from firmware_iface.panel.fields import colours_in_turn
from runtime.bundle.whole_files import whole_file
from runtime.headset.open_devices import Devices
from runtime.solver import Quality, quality
from runtime.solver.picture_files import white_of
from runtime.solver.targets import CHANNELS, fit_area
from trainer.captures.bench_file import Bench
from trainer.report.display_section import srgb_picture
from trainer.training.photographs import photograph

SHOTS = 4  # pictures of the camera that are averaged
SATURATED = 0.001  # share of pixels
AIM = 0.85  # share of the camera's range that these pixels are to reach


@dataclass(frozen=True)
class CameraPicture:
    """The camera's picture of a pattern, or of a pattern for each colour.

    Attributes
    ----------
    light : array [C, h, w]
        Above black; of one colour in counts/ms, of several in counts a frame.
    quality : Quality
        Against the target; several colours together, with one scale for all.
    by_channel : mapping of str to Quality
        Of each colour, with a scale of its own.
    """

    light: np.ndarray
    quality: Quality
    by_channel: Mapping[str, Quality] = field(default_factory=dict)


def target_of(name: str, channels: Sequence[str], shape: tuple[int, int]) -> np.ndarray:
    """A photograph as linear irradiance [C, H, W]: a part for each colour, and for a bench of one colour the green."""
    wanted = channels if len(channels) > 1 else ("green",)
    planes = photograph(name)[[CHANNELS.index(channel) for channel in wanted]]
    return fit_area(planes, shape).astype(np.float32)


def seen_by_camera(
    devices: Devices, bench: Bench, gray: np.ndarray, given: np.ndarray, target: np.ndarray
) -> CameraPicture:
    """The camera's picture of gray levels [C, H, W], mean of several shots; several colours are shown in turn.

    `given` [C] is the irradiance that a target of 1 should get from each pattern.
    """
    channels = [c.name for c in bench.channels]
    if len(channels) == 1:
        return _in_one_colour(devices, bench, gray, target)
    return _in_turn(devices, bench, gray, given, target)


def _in_one_colour(devices: Devices, bench: Bench, gray: np.ndarray, target: np.ndarray) -> CameraPicture:
    """At the longest exposure that does not saturate."""
    camera = devices.camera
    devices.panel.show(gray[0])
    devices.light(bench.channels[0].name)
    camera.exposure_ms = min(camera.exposure_ms * _headroom(devices, bench), camera.longest_exposure_ms)
    while _saturated(devices):
        camera.exposure_ms = camera.exposure_ms * 0.7
    light = _mean_light(devices, bench) / camera.exposure_ms
    devices.lasers.off()
    return CameraPicture(light[None], quality(light, target[0]))


def _in_turn(
    devices: Devices, bench: Bench, gray: np.ndarray, given: np.ndarray, target: np.ndarray
) -> CameraPicture:
    """All colours in turn, and then each of them alone in the same frame, since the camera sees their sum.

    Exposures are of as many whole frames as do not saturate. Each colour has light for as long as its target needs: the
    darker that is, the more a pattern gives it. Where one frame saturates with all colours, all have less time.
    """
    channels = [c.name for c in bench.channels]
    lasers = [devices.lasers.channels.index(channel) for channel in channels]
    camera, field_us = devices.camera, devices.panel.field_us
    frame_ms = min(1e-3 * field_us * len(channels), camera.longest_exposure_ms)
    camera.exposure_ms = frame_ms
    times = given.min() / given

    def show(times: np.ndarray) -> None:
        devices.panel.show_fields(colours_in_turn(gray, lasers, times.tolist(), field_us))

    show(times)
    devices.light_all(channels)
    while _saturated(devices):
        times = times * 0.7
        show(times)
    light = []
    for alone in np.diag(times):
        camera.exposure_ms = frame_ms
        show(alone)
        frames = max(1, int(min(_headroom(devices, bench), camera.longest_exposure_ms / frame_ms)))
        camera.exposure_ms = frames * frame_ms
        light.append(_mean_light(devices, bench) / frames)
    show(times)  # every gate is open when the lasers go off, so that their photodiodes see that they are dark
    devices.lasers.off()
    qualities = {c: quality(seen, t) for c, seen, t in zip(channels, light, target, strict=True)}
    return CameraPicture(np.stack(light), quality(np.stack(light), target), qualities)


def _saturated(devices: Devices) -> bool:
    """Whether a picture of what is lit has too many pixels at the top."""
    camera = devices.camera
    return bool((camera.capture() >= 2**camera.bit_depth - 1).mean() > SATURATED)


def _headroom(devices: Devices, bench: Bench) -> float:
    """How many times the exposure could be what it is, until all but the brightest pixels are near the top."""
    camera, black = devices.camera, _black(devices, bench)
    # NumPy's quantile of a large picture would keep the lasers' heartbeat waiting.
    pixels = np.cumsum(np.bincount(camera.capture().ravel()))
    bright = float(np.searchsorted(pixels, (1 - SATURATED) * pixels[-1])) - black
    return AIM * (2**camera.bit_depth - 1 - black) / max(bright, 1.0)


def _mean_light(devices: Devices, bench: Bench) -> np.ndarray:
    """Counts above black of the picture that is lit, mean of several shots, float [h, w]."""
    total = devices.camera.capture().astype(np.float64)
    for _ in range(SHOTS - 1):
        total += devices.camera.capture()
    return total / SHOTS - _black(devices, bench)


def _black(devices: Devices, bench: Bench) -> float:
    """The camera's counts without light."""
    return float(bench.camera.black_level * 2.0 ** (devices.camera.bit_depth - bench.camera.bit_depth))


def write_picture(path: Path, light: np.ndarray) -> None:
    """Irradiance [C, h, w] as an sRGB picture, its 99.8th percentile white."""
    with whole_file(path) as file:
        srgb_picture(light / white_of(light)).save(file, format="PNG")
