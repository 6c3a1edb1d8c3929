"""Refinement of the picture on display, beside the frames: a thread of the solver's process.

The pattern that is tried stays on display until the camera has seen it, so learning from a capture, however long it
takes, makes no frame late. The network that learns is read from the bundle for this picture alone and goes with it:
what the solver makes of other pictures, the bundle and the lasers are out of reach.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_iface.configured_devices import mrad_per_pixel
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import spot_shares
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path
from runtime.camera.view import View, on_panel, view_of
from runtime.networks.onnx_approximator import approximator_of
from runtime.refinement.refine import Refinement
from runtime.service.configuration import Configuration
from runtime.service.frame_solver import Pattern
from runtime.service.inside import Refine, Refined
from runtime.service.ring import crc32
from runtime.solver import quality, shown, solve


class Refiner(threading.Thread):
    """Refines one picture, at most so many captures; its drift log goes to standard error, a line of JSON a capture.

    target: irradiance [1, H, W]. crc: of the picture's bytes in its slot. asked: how many captures, and counts without
    light. ended: told, in this thread, what came of it.

    Attributes: crc, pattern (to be displayed now, and after the end the best; None until the first is made).
    """

    def __init__(
        self,
        configuration: Configuration,
        target: np.ndarray,
        crc: int,
        asked: Refine,
        ended: Callable[[Refined], None],
    ) -> None:
        super().__init__(name="refining", daemon=True)
        self.crc = crc
        self.pattern: Pattern | None = None
        self._configuration, self._target, self._asked, self._ended = (
            configuration,
            target,
            asked,
            ended,
        )
        self._wants: int | None = None  # CRC-32 of the pattern whose capture is waited for
        self._seen: queue.SimpleQueue[np.ndarray | None] = queue.SimpleQueue()

    def look(self, crc: int, counts: np.ndarray) -> None:
        """What the camera saw, counts [h, w], while a pattern with this CRC-32 was displayed."""
        if crc == self._wants:
            self._wants = None
            self._seen.put(counts)

    def stop(self) -> None:
        """End it: its picture is no longer displayed."""
        self._seen.put(None)

    def run(self) -> None:
        try:
            self._ended(self._refined())
        except InputError as error:
            self._ended(Refined(self._asked.number, 0, 0.0, 0.0, str(error)))
        except OSError:
            pass  # the supervisor has gone, and this process goes too
        except Exception as error:  # whatever it was, frames go on and the program is told
            self._ended(Refined(self._asked.number, 0, 0.0, 0.0, f"it failed: {error}"))

    def _refined(self) -> Refined:
        learned = _ready(self._configuration, self._target)
        state, steps = learned.state, learned.state.steps
        while state.stopped is None:
            if len(steps) == self._asked.captures:
                state.stopped = "all captures are taken"
                break
            self._display(learned)
            counts = self._seen.get()
            if counts is None:
                state.stopped = "its picture is no longer displayed"
                break
            if counts.shape != learned.view.shape:
                raise InputError(
                    f"the camera's picture is {counts.shape} and was {learned.view.shape}: calibrate"
                )
            light = counts.astype(np.float32) - np.float32(self._asked.black)
            state.take(on_panel(light, learned.view, self._target.shape[1:])[None])
        if not steps:
            return Refined(self._asked.number, 0, 0.0, 0.0, state.stopped)
        self._display(learned)
        return Refined(self._asked.number, len(steps), steps[0].psnr_db, state.best_psnr_db, state.stopped)

    def _display(self, learned: _Ready) -> None:
        gray, path = learned.state.gray, learned.state.paths[0]
        light = shown(path, gray[0])
        mrad = mrad_per_pixel(self._configuration.devices["lasers"])
        shares = spot_shares(light, mrad) if mrad else ()
        psnr_db = quality(light, self._target[0]).psnr_db
        self._wants = crc32(gray)
        self.pattern = Pattern(gray, psnr_db, final=True, shares=shares)


@dataclass(frozen=True)
class _Ready:
    """A refinement that is ready to begin, and how the camera sees it."""

    state: Refinement
    view: View


def _ready(configuration: Configuration, target: np.ndarray) -> _Ready:
    """A camera that no calibration has seen is taken to be registered. Raises InputError where there is no network."""
    bundle = read_bundle(configuration.bundle)
    path = load_light_path(bundle, configuration.timing.channel or None)
    approximator = approximator_of(bundle, (1, *path.grid.shape))
    if approximator is None:
        raise InputError("the bundle has no approximator to refine: train one and export it with the bundle")
    if not target.any():
        raise InputError("the picture is black: there is nothing to see")
    first = solve(path, target[0]).phase[None]
    view = view_of(bundle) or View(path.grid.shape)
    return _Ready(Refinement([path], approximator, target, first, sys.stderr), view)
