"""The lasers in a small process of their own, so that every way for the rest to die ends dark.

with open_guarded_lasers("/dev/i2c-1", CHANNELS) as lasers:     # the interface of Lasers
    lasers.arm()
    lasers.heartbeat()                                          # from the loop that must be alive

The guard owns the bus and writes the board's heartbeat every 20 ms; nothing heavy runs beside it. It goes dark
- at once, when the process that opened it ends in any way (its end of the socket closes), or on a signal;
- when that process says nothing for 100 ms while the board is armed: hanging, stopped, or a loop that got stuck;
- by the safety controller's dead-man 100 ms later at most, when the guard itself is killed or hangs.
"""

from __future__ import annotations

import dataclasses
import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.lasers import RAMP_S, RAMP_STEPS, Lasers, open_lasers

LEASE_S, TICK_S = 0.100, 0.020
STEP_S = RAMP_S / RAMP_STEPS
ANSWER_WITHIN_S = 2.0
PACKET = 65536


class Guard:
    """The guard's side: one client on a connected SOCK_SEQPACKET socket, each request one JSON packet."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client
        self._lasers: Lasers | None = None
        self._armed = False
        self._ramp: Iterator[None] | None = None
        self._failure: str | None = None  # what went wrong between requests; told until it is armed again
        self._heard_at = self._acted_at = time.monotonic()

    def run(self) -> None:
        """Serve until the client is gone. The lasers are dark when this returns or raises."""
        try:
            while True:
                due = self._acted_at + (STEP_S if self._ramp else TICK_S)
                ready, _, _ = select.select([self._client], [], [], max(0.0, due - time.monotonic()))
                if ready:
                    packet = self._client.recv(PACKET)
                    if not packet:
                        return
                    self._heard_at = time.monotonic()
                    self._client.send(json.dumps(self._answer(packet)).encode())
                if time.monotonic() >= due:
                    self._act()
        except ConnectionError:
            return
        finally:
            if self._lasers:
                self._lasers.close()

    def _act(self) -> None:
        """What is due between requests: a step of the ramp, the heartbeat, or darkness."""
        self._acted_at = time.monotonic()
        if not (self._armed and self._lasers):
            return
        if self._acted_at - self._heard_at > LEASE_S:
            self._stop("the program that drives the lasers was silent for 100 ms, so they were switched off")
            return
        try:
            if self._ramp:
                self._step(self._ramp)
            else:
                self._lasers.heartbeat()
        except DeviceError as error:
            self._stop(str(error))

    def _stop(self, failure: str) -> None:
        self._armed, self._ramp, self._failure = False, None, failure
        if self._lasers:
            self._lasers.trip()

    def _answer(self, packet: bytes) -> dict[str, Any]:
        """What one request gives; never raises."""
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
            self._lasers = open_lasers(given[0], [LaserChannel(**channel) for channel in given[1]])
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
        """Begin to go there; the steps follow in `_act`."""
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


class GuardedLasers:
    """The client's side: the interface of `Lasers`, with the bus in a guard process. Safe to use from several threads.

    Raises as `Lasers` does, and DeviceGoneError (a DeviceError; the lasers are dark) once the guard is gone.
    """

    def __init__(self, bus: str, channels: Sequence[LaserChannel]) -> None:
        self._lock = threading.Lock()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_WITHIN_S)
        with theirs:
            command = [sys.executable, "-m", "firmware_iface.lasers.guard", str(theirs.fileno())]
            self._process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
        try:
            asked = [dataclasses.asdict(channel) for channel in channels]
            self.channels: tuple[str, ...] = tuple(self._ask("open", bus, asked, within_s=30.0))
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The guard's process id."""
        return self._process.pid

    def set_power(self, channel: str, fraction: float) -> None:
        """As `Lasers.set_power`: returns when the ramp is over."""
        self._ask("set_power", channel, float(fraction))
        while self._ramping:
            time.sleep(STEP_S)
            self.heartbeat()

    def power(self, channel: str) -> float:
        """As `Lasers.power`."""
        return float(self._ask("power", channel))

    def off(self) -> None:
        """As `Lasers.off`; where the guard is gone, its end has made it dark."""
        try:
            self._ask("off")
        except DeviceGoneError:
            return

    def clear(self) -> None:
        """As `Lasers.clear`."""
        self._ask("clear")

    def arm(self) -> None:
        """As `Lasers.arm`; from now on `heartbeat` is due every 50 ms."""
        self._ask("arm")

    def heartbeat(self) -> None:
        """Say that the caller is alive; raises DeviceError where the lasers have been switched off."""
        self._ask("beat")

    def expect(self, shares: Mapping[str, Sequence[float]] | None) -> float:
        """As `Lasers.expect`."""
        return float(self._ask("expect", shares))

    def status(self) -> dict[str, Any]:
        """As `Lasers.status`."""
        return dict(self._ask("status"))

    @contextmanager
    def beating(self) -> Iterator[None]:
        """A thread sends the heartbeat meanwhile, for programs without a loop of their own.

        It shows that the interpreter runs, not that the program gets on: a service calls `heartbeat` from its loop.
        """
        ended = threading.Event()

        def beat() -> None:
            while not ended.wait(TICK_S):
                try:
                    self.heartbeat()
                except DeviceError:
                    return  # dark; whoever uses the lasers next is told

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def close(self) -> None:
        """End the guard, which goes dark first. May be called again."""
        self._socket.close()
        try:
            self._process.wait(ANSWER_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()  # it hangs on its bus: the dead-man has made the board dark
            self._process.wait()

    def __enter__(self) -> GuardedLasers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, act: str, *given: Any, within_s: float = ANSWER_WITHIN_S) -> Any:
        with self._lock:
            try:
                self._socket.settimeout(within_s)
                self._socket.send(json.dumps({"do": act, "with": given}).encode())
                packet = self._socket.recv(PACKET)
            except OSError as error:
                self._socket.close()  # an answer that comes later must not be taken for the next one
                raise DeviceGoneError(
                    f"the lasers' guard does not answer ({error}); open the lasers again."
                ) from error
        if not packet:
            raise DeviceGoneError("the lasers' guard has ended, and the lasers are dark; open them again.")
        answer = json.loads(packet)
        if "input" in answer:
            raise InputError(answer["input"])
        if "device" in answer:
            raise DeviceError(answer["device"])
        self._ramping = bool(answer["ramping"])
        return answer["result"]


def open_guarded_lasers(bus: str, channels: Sequence[LaserChannel]) -> GuardedLasers:
    """Open the lasers on a bus (see wire.open_bus) in a guard process. Raises InputError, DeviceError."""
    return GuardedLasers(bus, channels)


def main(arguments: Sequence[str]) -> int:
    """Serve the client on the open file descriptor that is named."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(0))  # by way of `finally`, which goes dark
    with socket.socket(fileno=int(arguments[0])) as client:
        Guard(client).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
