"""A simulated bench in a process of its own.

Its optics compute for long, and the clocks of emulated boards must not wait for them: a dead-man of 100 ms would.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.panel.panel import Gray
from firmware_iface.virtual.bench_description import BenchDescription
from firmware_iface.virtual.virtual_devices import LitField
from firmware_iface.virtual.virtual_headset import VirtualHeadset

Shown = Sequence[tuple[Gray, int]]  # patterns, and for how many periods each was shown
Expose = Callable[[Sequence[LitField], Mapping[str, float], float, Shown], NDArray[np.uint16]]


def bench_process(description: BenchDescription, seed: int) -> Expose:
    """Start a process with a virtual headset.

    Parameters
    ----------
    description : BenchDescription
    seed : int
        As `VirtualHeadset` takes it.

    Returns
    -------
    callable
        From what the panel shows in turn, each laser's power (fraction of full), an exposure (ms) and what the panel
        showed before (`VirtualHeadset.has_shown`) to the camera's picture, uint16 counts [h, w]. For one thread at a
        time. It raises InputError as `VirtualCamera` does, and DeviceError where the process has ended.
    """
    context = multiprocessing.get_context("spawn")  # the caller has threads
    ours, theirs = context.Pipe()
    context.Process(target=_serve, args=(theirs, description, seed), daemon=True).start()
    theirs.close()

    def expose(
        fields: Sequence[LitField], power: Mapping[str, float], exposure_ms: float, before: Shown
    ) -> NDArray[np.uint16]:
        try:
            ours.send((tuple(fields), dict(power), exposure_ms, tuple(before)))
            picture = ours.recv()
        except (EOFError, OSError):
            raise DeviceError(
                "the process of the simulated bench has ended; start the emulated hardware again."
            ) from None
        if isinstance(picture, InputError):
            raise picture
        return np.asarray(picture)

    return expose


def _serve(pipe: Connection, description: BenchDescription, seed: int) -> None:
    """Take pictures until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(5)  # below the boards
    headset = VirtualHeadset(description, seed)
    with suppress(EOFError, OSError):
        while True:
            fields, power, exposure_ms, before = pipe.recv()
            try:
                headset.has_shown(before)
                headset.panel.fields = fields
                for channel, fraction in power.items():
                    headset.lasers.set_power(channel, fraction)
                headset.camera.exposure_ms = exposure_ms
                pipe.send(headset.camera.capture())
            except InputError as error:
                pipe.send(error)
