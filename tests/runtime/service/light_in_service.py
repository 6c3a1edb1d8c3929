"""Pictures through a running service until there is light, for tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.service.client import Client, LostFrame, RefusedError
from runtime.service.protocol import LaserState, PartState, Shown
from tests.campaigns.headset import picture
from tests.waiting import until


def wait_until_fresh(client: Client) -> None:
    """Wait until panel and camera work."""
    until(lambda: {client.status().panel, client.status().camera} == {PartState.FRESH}, 15)


def within_five_attempts(once: Callable[[], None]) -> None:
    """Try up to five times: on a busy machine something may become stale, and then a program has to arm again."""
    for _ in range(4):
        with suppress(AssertionError):
            return once()
    return once()


def show(client: Client, frames: int) -> list[Shown | LostFrame]:
    """Outcomes of `frames` frames."""
    outcomes: list[Shown | LostFrame] = []
    for k in range(frames):
        client.show(picture(client, k))
        outcomes += client.outcomes()
    while client.in_flight:
        outcomes += client.outcomes(5)
    return outcomes


def light_up(client: Client, remote: RemoteHardware) -> None:
    """Clear, arm and show until there is light; again where something became stale on a busy machine."""
    end = time.monotonic() + 30
    while emitted_uw(remote) == 0:
        assert time.monotonic() < end, client.status()
        if client.status().lasers in (LaserState.OFF, LaserState.FAULT):
            with suppress(RefusedError):
                client.clear()
                client.arm()
        show(client, 3)


def emitted_uw(remote: RemoteHardware) -> float:
    return remote.light()[-1][1]
