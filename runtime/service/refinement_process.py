"""Refinement of the displayed picture: `python -m runtime.service.refinement_process FD CONFIGURATION`.

Each pattern stays on display until the camera has captured it. So learning from a capture makes no frame late, even
where it takes long. It has a process of its own, with one core that it leaves to everything else (`in_background`): in
the solver's process it would hold up the solver's signs of life on a large panel. The network that learns is read from
the bundle for this picture alone and is discarded with it: a refinement cannot change the patterns of other pictures,
the bundle or the lasers. `refinement_client` is the solver's side.
"""

from __future__ import annotations

import os
import struct
import sys
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
from runtime.service.child_processes import child_link
from runtime.service.configuration import Configuration, read_configuration
from runtime.service.frame_solver import raised
from runtime.service.process_messages import (
    REFINEMENT,
    RefinedPattern,
    RefinementCapture,
    RefinementEnd,
    RefinementTarget,
    StopRefinement,
)
from runtime.service.shared_memory import crc32, read_sealed, sealed_copy
from runtime.service.socket_link import MessageLink
from runtime.solver import quality, shown, solve


def main(fd: str, configuration: str) -> None:
    """Refine one picture; its drift log goes to standard error, one line of JSON for each capture."""
    link = child_link(fd, REFINEMENT)
    _, task, target = link.receive()
    assert isinstance(task, RefinementTarget) and target is not None
    picture = read_sealed(target, (1, task.height, task.width), np.float32)
    try:
        end = _refine(link, read_configuration(configuration), picture, task)
    except InputError as error:
        end = RefinementEnd(task.number, 0, 0.0, 0.0, str(error))
    except OSError:
        raise
    except Exception as error:  # after any error, frames are still shown and the program gets the reason
        end = RefinementEnd(task.number, 0, 0.0, 0.0, f"it failed: {error}")
    link.send(end)


def _refine(
    link: MessageLink, configuration: Configuration, target: np.ndarray, task: RefinementTarget
) -> RefinementEnd:
    prepared = _prepared(configuration, target)
    state, steps = prepared.state, prepared.state.steps
    while state.stopped is None:
        if len(steps) == task.captures:
            state.stopped = "all captures are taken"
            break
        _display(link, prepared, target)
        _, message, fd = link.receive()
        if isinstance(message, StopRefinement):
            state.stopped = "its picture is no longer displayed"
            break
        assert isinstance(message, RefinementCapture) and fd is not None
        counts = read_sealed(fd, (message.height, message.width), np.uint16)
        if counts.shape != prepared.view.shape:
            raise InputError(
                f"the camera's picture is {counts.shape} and was {prepared.view.shape}: calibrate"
            )
        light = counts.astype(np.float32) - np.float32(task.black)
        state.take(on_panel(light, prepared.view, target.shape[1:])[None])
    if not steps:
        return RefinementEnd(task.number, 0, 0.0, 0.0, state.stopped)
    _display(link, prepared, target)
    return RefinementEnd(task.number, len(steps), steps[0].psnr_db, state.best_psnr_db, state.stopped)


@dataclass(frozen=True)
class _PreparedRefinement:
    """A refinement that is ready to begin, where the camera sees the image plane, and what predicts spots of light."""

    state: Refinement
    view: View
    mrad: float
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
    first = solve(path, target[0], grid="panel").phase[
        None
    ]  # of 20 iterations, the finer grid makes no better use
    view = view_of(bundle) or View(path.grid.shape)
    state = Refinement([path], approximator, target, first, sys.stderr)
    mrad = mrad_per_pixel(configuration.devices["lasers"])
    return _PreparedRefinement(state, view, mrad, slow_response_share(bundle))


def _display(link: MessageLink, prepared: _PreparedRefinement, target: np.ndarray) -> None:
    """Send the pattern to display now, and after the end the best."""
    gray, path = prepared.state.gray, prepared.state.paths[0]
    light = shown(path, gray[0])
    shares = raised(spot_shares(light, prepared.mrad), prepared.slow_share) if prepared.mrad else ()
    psnr_db = quality(light, target[0]).psnr_db
    packed = struct.pack(f"<{len(shares)}f", *shares)
    _, height, width = gray.shape
    fd = sealed_copy(gray)
    try:
        link.send(RefinedPattern(crc32(gray), height, width, psnr_db, packed), fds=[fd])
    finally:
        os.close(fd)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except ConnectionError:
        os._exit(0)
