"""The process that owns the laser bus: it writes the heartbeat and switches the lasers off when its client is silent.

Started by `GuardedLasers` with one argument, the number of an open socket.
"""

from __future__ import annotations

import json
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from firmware_iface.errors import DeviceError, InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.guarded_lasers import PACKET, STEP_S, TICK_S
from firmware_iface.lasers.lasers import Lasers
from firmware_iface.lasers.open_board import open_lasers

LEASE_S = 0.100


class Guard:
    """The server of one client.

    Parameters
    ----------
    client : socket
        A connected SOCK_SEQPACKET socket; each request is one JSON packet.
    """

    def __init__(self, client: socket.socket) -> None:
        self._client = client
        self._lasers: Lasers | None = None
        self._armed = False
        self._ramp: Iterator[None] | None = None
        self._failure: str | None = (
            None  # a failure between requests; reported until the lasers are armed again
        )
        self._heard_at = self._acted_at = time.monotonic()

    def run(self) -> None:
        """Serve until the client ends. The lasers are dark when this returns or raises."""
        try:
            while True:
                due = self._acted_at + (STEP_S if self._ramp else TICK_S)
                ready, _, _ = select.select([self._client], [], [], max(0.0, due - time.monotonic()))
                if ready:
                    packet = self._client.recv(PACKET)
                    if not packet:
                        return
                    answer = self._answer(packet)
                    self._heard_at = time.monotonic()  # until now it waited for this answer
                    self._client.send(json.dumps(answer).encode())
                if time.monotonic() >= due:
                    self._act()
        except ConnectionError:
            return
        finally:
            if self._lasers:
                self._lasers.close()

    def _act(self) -> None:
        """Do what is due between requests: a step of the ramp, the heartbeat, or switching off."""
        self._acted_at = time.monotonic()
        if not (self._armed and self._lasers):
            return
        if self._acted_at - self._heard_at > LEASE_S and not self._is_asked():
            self._stop("the program that drives the lasers was silent for 100 ms, so they were switched off")
            return
        try:
            if self._ramp:
                self._step(self._ramp)
            else:
                self._lasers.heartbeat()
        except DeviceError as error:
            self._stop(str(error))

    def _is_asked(self) -> bool:
        """Whether a request waits, because this process had to wait for the processor, or the client has ended."""
        return bool(select.select([self._client], [], [], 0.0)[0])

    def _stop(self, failure: str) -> None:
        self._armed, self._ramp, self._failure = False, None, failure
        if self._lasers:
            self._lasers.trip()

    def _answer(self, packet: bytes) -> dict[str, Any]:
        """Answer one request; never raises."""
        try:
            request = json.loads(packet)
            act, given = request["do"], request["with"]
            if self._failure and act in ("beat", "set_power"):
                raise DeviceError(self._failure)
            return {"result": self._do(act, given), "ramping": self._ramp is not None}
        except DeviceError as error:
            self._armed, self._ramp = False, None
            return {"device": str(error)}
        except InputError as error:
            return {"input": str(error)}
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            return {"input": f"the guard does not understand the request ({error!r}); use its own client."}

    def _do(self, act: str, given: list[Any]) -> Any:
        if act == "open" and not self._lasers:
            bus, channels, gated = given
            self._lasers = open_lasers(
                bus, [LaserChannel(**channel) for channel in channels], gated and GatedLight(**gated)
            )
            return list(self._lasers.channels)
        if not self._lasers:
            raise InputError("the lasers are not open; open them first.")
        acts: dict[str, Callable[..., Any]] = {
            "arm": self._arm,
            "beat": lambda: None,
            "set_power": self._set_power,
            "off": self._off,
            "clear": self._lasers.clear,
            "expect": self._lasers.expect,
            "power": self._lasers.power,
            "status": self._lasers.status,
        }
        if act not in acts:
            raise InputError(f"the guard knows no '{act}'; use its own client.")
        return acts[act](*given)

    def _arm(self) -> None:
        assert self._lasers is not None
        self._lasers.arm()
        self._armed, self._failure, self._acted_at = True, None, time.monotonic()

    def _set_power(self, channel: str, fraction: float) -> None:
        """Begin a ramp; its steps follow in `_act`."""
        assert self._lasers is not None
        self._step(self._lasers.ramp(channel, fraction))

    def _step(self, ramp: Iterator[None]) -> None:
        self._ramp = None
        for _ in ramp:
            self._ramp, self._acted_at = ramp, time.monotonic()
            return

    def _off(self) -> None:
        assert self._lasers is not None
        self._ramp = None
        self._lasers.off()


def main(arguments: Sequence[str]) -> int:
    """Serve the client on the open file descriptor given as argument."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(0))  # through `finally`, which goes dark
    with socket.socket(fileno=int(arguments[0])) as client:
        Guard(client).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
