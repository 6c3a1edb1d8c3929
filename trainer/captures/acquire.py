"""Takes a capture set from a bench: chooses patterns, sets the exposure, shows and captures.

The exposure of each colour is set once, from pictures of all of its patterns, and then stays the same. So only the
laser's power changes the gain. A bracket's exposures are BRACKET_STEP apart about it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import InputError, nearest
from runtime.headset.exposure_growth import while_growing
from runtime.headset.open_devices import configuration_of
from runtime.program.progress import Progress
from trainer.captures.bench_file import Bench, Camera, read_bench
from trainer.captures.capture_writer import CaptureWriter
from trainer.captures.full_pixels import brightest, may_be_full
from trainer.captures.open_bench import open_bench
from trainer.captures.patterns import Pattern, choose_patterns, default_count

PatternChooser = Callable[[str, float], list[Pattern]]

SATURATED = 0.002  # of all pixels of a colour
SATURATED_IN_ONE = 0.01  # of the pixels of one capture
AIM = 0.93  # of full scale, for the brightest pixels that count
EXPOSURES_MS = (0.02, 2000.0)
# From one exposure of a bracket to the next. Each pixel is then above a quarter of full scale in one frame, where shot
# noise is at most twice that of a full pixel. Smaller steps need more frames for the same range; larger ones lose more.
BRACKET_STEP = 4.0


class Lasers(Protocol):
    """The lasers of a headset."""

    def set_power(self, channel: str, fraction: float) -> None:
        """Set a laser to a fraction of full power."""

    def off(self) -> None:
        """Switch every laser off."""


class Headset(Protocol):
    """What a bench must have: a panel, lasers and a camera, a focus, and a clock."""

    @property
    def panel(self) -> Any: ...

    @property
    def lasers(self) -> Lasers: ...

    @property
    def camera(self) -> Any: ...

    @property
    def time_s(self) -> float: ...

    @property
    def simulated(self) -> bool: ...

    def move_to_plane(self, plane_mm: float) -> None:
        """Focus the camera on another plane."""


@dataclass(frozen=True)
class CaptureSummary:
    """A capture set that was taken.

    Attributes
    ----------
    folder : Path
    captures : int
        How many; a bracket is one.
    exposure_ms : dict of str to float, ms
        By channel; of a bracket, the one that a single picture would have.
    saturated : float
        Share of the pixels; of a bracket, those that every frame saturates.
    simulated : bool
        Whether the devices are.
    bracket : tuple of float
        Each frame's exposure over `exposure_ms`.
    """

    folder: Path
    captures: int
    exposure_ms: dict[str, float]
    saturated: float
    simulated: bool = False
    bracket: tuple[float, ...] = (1.0,)

    def as_json(self) -> dict[str, Any]:
        """The object of `capture --json`."""
        return {
            "folder": str(self.folder),
            "captures": self.captures,
            "exposure_ms": self.exposure_ms,
            "saturated_share": self.saturated,
            "simulated": self.simulated,
            "bracket": list(self.bracket),
        }


def acquire_from(
    spec: str,
    folder: Path,
    patterns: int | None = None,
    planes_mm: Sequence[float] | None = None,
    channels: Sequence[str] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    known: Path | None = None,
    frames: int = 1,
) -> CaptureSummary:
    """Open a bench by name and take a capture set from it.

    Parameters
    ----------
    spec : str
        `virtual:NAME`, the TOML file of a virtual bench, or the configuration of a real headset.
    folder : Path
        Where the set is written; new or empty.
    patterns, planes_mm, channels, seed, progress
        As from `acquire_captures`.
    known : Path, optional
        bench.toml of a real headset.
    frames : int
        As for `acquire_captures`.

    Returns
    -------
    CaptureSummary

    Raises
    ------
    InputError
        For an unknown bench, channel or plane, `known` with a virtual bench, or a folder that is not empty.
    DeviceError
        Where a device fails.
    """
    if known is not None and configuration_of(spec) is None:
        raise InputError(
            f"--known {known} is for a real headset, and --bench {spec} is a virtual one, which knows its own numbers: "
            "leave --known out, or give the headset's configuration as --bench"
        )
    with open_bench(spec, seed, read_bench(known) if known else None) as opened:
        planes = tuple(planes_mm) if planes_mm else opened.planes_mm
        return acquire_captures(
            opened.headset, opened.bench, folder, patterns, planes, channels, seed, progress, frames=frames
        )


def acquire_captures(
    headset: Headset,
    bench: Bench,
    folder: Path,
    patterns: int | None = None,
    planes_mm: Sequence[float] = (),
    channels: Sequence[str] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    choose: PatternChooser | None = None,
    frames: int = 1,
) -> CaptureSummary:
    """Show patterns on a bench, capture them, and write the set.

    Parameters
    ----------
    headset : Headset
    bench : Bench
    folder : Path
        Where the set is written; new or empty.
    patterns : int, optional
        How many for each colour and plane. The first is shown twice, to measure the noise.
    planes_mm : sequence of float, mm
        By default the bench's distance.
    channels : sequence of str, optional
        By default all of the bench's.
    seed : int
        For the choice of patterns.
    progress : callable, optional
        Called with the share done, 0 to 1, and what is done now.
    choose : callable, optional
        Gives the patterns of a channel and plane, in place of `choose_patterns`.
    frames : int
        Exposures of each pattern: 3 are a quarter, one and four times the exposure that a single picture would have.

    Returns
    -------
    CaptureSummary

    Raises
    ------
    InputError
        For an unknown channel or plane, a folder that is not empty, or a dark bench.
    DeviceError
        Where a device fails.
    """
    names = [c.name for c in bench.channels]
    chosen = list(dict.fromkeys(channels or names))
    for name in chosen:
        if name not in names:
            raise InputError(f"--channels: there is no channel '{name}'; {nearest(name, names)}")
    planes = list(dict.fromkeys(float(p) for p in planes_mm)) or [bench.distance_mm]
    count = default_count(len(chosen)) if patterns is None else patterns
    if choose is None:
        choose = partial(choose_patterns, bench, count=count, seed=seed)
    else:
        count = len(choose(chosen[0], planes[0]))
    steps = len(chosen) * len(planes) * (count + (count + 1) * frames)
    bracket = tuple(BRACKET_STEP ** (k - (frames - 1) // 2) for k in range(frames))
    done = 0

    def report(what: str) -> None:
        nonlocal done
        if progress:
            progress(done / steps, what)
        done += 1

    for plane in planes:  # before the patterns are made: a plane out of reach is reported at once
        headset.move_to_plane(plane)
    exposures: dict[str, float] = {}
    saturated: list[float] = []
    started: float | None = None
    with CaptureWriter(folder, bench) as writer:
        for channel in chosen:
            shown = [(p, choose(channel, p)) for p in planes]
            headset.lasers.off()
            headset.lasers.set_power(channel, 1.0)
            try:
                exposures[channel] = _expose(headset, bench.camera, shown, channel, bracket[-1], report)
                for plane, several in shown:
                    headset.move_to_plane(plane)
                    for number, pattern in _with_repeat(several):
                        extra = {"kind": pattern.kind, "simulated": "yes" if headset.simulated else "no"}
                        if frames > 1:
                            extra["bracket"] = f"{channel}-{plane:g}-{len(saturated):04d}"
                        shares = []
                        planned = [exposures[channel] * factor for factor in bracket]
                        for exposure, time, counts in _frames(headset, pattern, planned):
                            report(f"{channel}, {plane:g} mm")
                            started = time if started is None else started
                            shares.append(float((counts >= bench.camera.saturation).mean()))
                            writer.add(
                                pattern.gray,
                                counts,
                                channel,
                                plane_mm=plane,
                                pattern=f"{channel}-{plane:g}-{number:03d}",
                                exposure_ms=exposure,
                                time_s=round(time - started, 6),
                                **extra,
                            )
                        saturated.append(min(shares))
            finally:
                headset.lasers.off()
    if progress:
        progress(1.0, "done")
    return CaptureSummary(
        Path(folder), len(saturated), exposures, float(np.mean(saturated)), headset.simulated, bracket
    )


def _with_repeat(patterns: list[Pattern]) -> list[tuple[int, Pattern]]:
    return [(0, patterns[0]), *enumerate(patterns)]


def _frames(
    headset: Headset, pattern: Pattern, exposures_ms: Sequence[float]
) -> Iterator[tuple[float, float, NDArray[np.uint16]]]:
    """Exposure, ms, as the camera set it, time, s, and counts of each picture of a pattern, which is shown once."""
    headset.panel.show(pattern.gray)
    for exposure in exposures_ms:
        if len(exposures_ms) > 1:
            headset.camera.exposure_ms = exposure
        time = headset.time_s
        yield float(headset.camera.exposure_ms), time, headset.camera.capture()


def _capture(headset: Headset, pattern: Pattern) -> NDArray[np.uint16]:
    headset.panel.show(pattern.gray)
    counts: NDArray[np.uint16] = headset.camera.capture()
    return counts


def _expose(
    headset: Headset,
    camera: Camera,
    shown: list[tuple[float, list[Pattern]]],
    channel: str,
    longer: float,
    report: Callable[[str], None],
) -> float:
    """Set and return the exposure, ms, at which few pixels of these patterns saturate; the camera has one `longer`.

    It is shorter where pixels are full before: brighter light then gives hardly more counts.
    """
    exposure = 10.0
    headset.camera.exposure_ms = exposure
    pictures: list[NDArray[np.uint16]] = []
    for plane, several in shown:
        headset.move_to_plane(plane)
        for pattern in several:
            report(f"exposure for {channel}")
            counts = _capture(headset, pattern)
            while _too_bright(counts, camera) and exposure > 2 * EXPOSURES_MS[0]:
                exposure /= 4
                headset.camera.exposure_ms = exposure
                pictures = [_dimmed(c, camera) for c in pictures]
                counts = _capture(headset, pattern)
            pictures.append(counts)
    every = float(np.quantile(np.concatenate([c.reshape(-1) for c in pictures]), 1 - SATURATED))
    single = [float(np.quantile(c, 1 - SATURATED_IN_ONE)) for c in pictures]
    bright = max(every, *single) - camera.black_level
    if bright <= 3 * camera.read_noise_e * camera.counts_per_electron + 1:
        raise InputError(
            f"the camera sees nothing at {exposure:g} ms: check that the laser is on and the light path open, "
            "and try again"
        )
    factor = AIM * camera.full_scale / bright
    longest = min(EXPOSURES_MS[1], headset.camera.longest_exposure_ms / longer)
    needed = min(max(exposure * factor, EXPOSURES_MS[0]), longest)
    first = int(np.argmax(single))
    if may_be_full(pictures[first], camera):
        plane, pattern = [(plane, p) for plane, several in shown for p in several][first]
        headset.move_to_plane(plane)
        needed = while_growing(needed, EXPOSURES_MS[0], partial(_brightness, headset, camera, pattern))
    exposure = float(f"{needed:.3g}")
    headset.camera.exposure_ms = exposure
    return exposure


def _brightness(headset: Headset, camera: Camera, pattern: Pattern, exposure_ms: float) -> float:
    """How bright a pattern's brightest pixels are at an exposure, share of full scale."""
    headset.camera.exposure_ms = exposure_ms
    return brightest(_capture(headset, pattern), camera)


def _too_bright(counts: NDArray[np.uint16], camera: Camera) -> bool:
    return float((counts >= camera.saturation).mean()) > SATURATED_IN_ONE / 2


def _dimmed(counts: NDArray[np.uint16], camera: Camera) -> NDArray[np.uint16]:
    """What the counts would be at a quarter of the exposure."""
    below = (counts.astype(np.float32) - camera.black_level) / 4 + camera.black_level
    return np.maximum(np.rint(below), 0).astype(np.uint16)
