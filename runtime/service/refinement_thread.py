"""Refinement of the displayed picture while frames are shown: a thread of the solver's process.

Each pattern stays on display until the camera has captured it. So learning from a capture makes no frame late, even
where it takes long. The network that learns is read from the bundle for this picture alone and is discarded with it: a
refinement cannot change the patterns of other pictures, the bundle or the lasers.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_iface.configured_devices import mrad_per_pixel, panel_fields
from firmware_iface.errors import InputError
from firmware_iface.lasers.eye_safety import spot_shares
from runtime.bundle.bundle_folder import read_bundle
from runtime.bundle.light_path_arrays import load_light_path, slow_response_share
from runtime.camera.view import View, on_panel, view_of
from runtime.networks.onnx_approximator import approximator_of
from runtime.refinement.picture_refinement import Refinement
from runtime.service.configuration import Configuration
from runtime.service.frame_solver import Pattern, raised
from runtime.service.process_messages import RefinementEnd, RefinePicture
from runtime.service.shared_memory import crc32
from runtime.solver import quality, shown, solve


class RefinementThread(threading.Thread):
    """Refines one picture. Its drift log goes to standard error, one line of JSON for each capture.

    Parameters
    ----------
    configuration : Configuration
    target : float32 array [1, H, W]
        Irradiance.
    crc : int
        CRC-32 of the picture's bytes in its slot.
    request : RefinePicture
        Number of captures at most, and counts without light.
    ended : callable
        Called with the result, in this thread.

    Attributes
    ----------
    crc : int
    pattern : Pattern or None
        The pattern to display now, and after the end the best; None until the first is made.
    """

    def __init__(
        self,
        configuration: Configuration,
        target: np.ndarray,
        crc: int,
        request: RefinePicture,
        ended: Callable[[RefinementEnd], None],
    ) -> None:
        super().__init__(name="refinement", daemon=True)
        self.crc = crc
        self.pattern: Pattern | None = None
        self._configuration, self._target = configuration, target
        self._request, self._ended = request, ended
        self._awaited: int | None = None  # CRC-32 of the pattern whose capture is needed
        self._captures: queue.SimpleQueue[np.ndarray | None] = queue.SimpleQueue()

    def take(self, crc: int, counts: np.ndarray) -> None:
        """Take a capture, counts [h, w], of the display while it showed the pattern with this CRC-32."""
        if crc == self._awaited:
            self._awaited = None
            self._captures.put(counts)

    def stop(self) -> None:
        """End it: its picture is no longer displayed."""
        self._captures.put(None)

    def run(self) -> None:
        try:
            self._ended(self._refine())
        except InputError as error:
            self._ended(RefinementEnd(self._request.number, 0, 0.0, 0.0, str(error)))
        except OSError:
            pass  # the supervisor has ended, and this process ends too
        except Exception as error:  # after any error, frames are still shown and the program gets the reason
            self._ended(RefinementEnd(self._request.number, 0, 0.0, 0.0, f"it failed: {error}"))

    def _refine(self) -> RefinementEnd:
        prepared = _prepared(self._configuration, self._target)
        state, steps = prepared.state, prepared.state.steps
        while state.stopped is None:
            if len(steps) == self._request.captures:
                state.stopped = "all captures are taken"
                break
            self._display(prepared)
            counts = self._captures.get()
            if counts is None:
                state.stopped = "its picture is no longer displayed"
                break
            if counts.shape != prepared.view.shape:
                raise InputError(
                    f"the camera's picture is {counts.shape} and was {prepared.view.shape}: calibrate"
                )
            light = counts.astype(np.float32) - np.float32(self._request.black)
            state.take(on_panel(light, prepared.view, self._target.shape[1:])[None])
        if not steps:
            return RefinementEnd(self._request.number, 0, 0.0, 0.0, state.stopped)
        self._display(prepared)
        return RefinementEnd(
            self._request.number, len(steps), steps[0].psnr_db, state.best_psnr_db, state.stopped
        )

    def _display(self, prepared: _PreparedRefinement) -> None:
        gray, path = prepared.state.gray, prepared.state.paths[0]
        light = shown(path, gray[0])
        mrad = mrad_per_pixel(self._configuration.devices["lasers"])
        shares = raised(spot_shares(light, mrad), prepared.slow_share) if mrad else ()
        psnr_db = quality(light, self._target[0]).psnr_db
        self._awaited = crc32(gray)
        self.pattern = Pattern(gray, psnr_db, final=True, shares=shares)


@dataclass(frozen=True)
class _PreparedRefinement:
    """A refinement that is ready to begin, where the camera sees the image plane, and how slow the panel is."""

    state: Refinement
    view: View
    slow_share: float


def _prepared(configuration: Configuration, target: np.ndarray) -> _PreparedRefinement:
    """Read the bundle and solve for the first pattern. A camera without a calibration counts as registered.

    Raises
    ------
    InputError
        Where several patterns are shown in turn, the bundle has no network, or the picture is black.
    """
    bundle = read_bundle(configuration.bundle)
    if panel_fields(configuration.devices["panel"]) > 1:
        raise InputError(
            "a refinement is of one colour's one pattern, and several are shown in turn: to refine one, write channel "
            "in [service] and no fields in [panel]"
        )
    path = load_light_path(bundle, configuration.timing.channel or None)
    approximator = approximator_of(bundle, (1, *path.grid.shape))
    if approximator is None:
        raise InputError("the bundle has no approximator to refine: train one and export it with the bundle")
    if not target.any():
        raise InputError("the picture is black: there is nothing to see")
    first = solve(path, target[0]).phase[None]
    view = view_of(bundle) or View(path.grid.shape)
    state = Refinement([path], approximator, target, first, sys.stderr)
    return _PreparedRefinement(state, view, slow_response_share(bundle))
