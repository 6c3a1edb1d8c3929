"""The lasers in a guard process of their own, which is dark after any failure of the program that uses them.

with open_guarded_lasers("/dev/i2c-1", CHANNELS) as lasers:     # the interface of Lasers
    lasers.arm()
    lasers.heartbeat()                                          # from the loop that must be alive

The guard (`guard_process`) owns the bus and writes the board's heartbeat every 20 ms, and does little else. It
goes dark
- at once, when the process that opened it ends in any way (its end of the socket closes), or on a signal;
- when that process sends nothing for 100 ms while the board is armed: it hangs, was stopped, or its loop is stuck;
- by the safety controller's dead-man 100 ms later at most, when the guard itself is killed or hangs.
"""

from __future__ import annotations

import dataclasses
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from firmware_iface.errors import DeviceError, DeviceGoneError, InputError
from firmware_iface.lasers.channels import LaserChannel
from firmware_iface.lasers.eye_safety import GatedLight
from firmware_iface.lasers.lasers import RAMP_S, RAMP_STEPS
from firmware_iface.repeated import repeated

TICK_S = 0.020
STEP_S = RAMP_S / RAMP_STEPS
ANSWER_WITHIN_S = 2.0
PACKET = 65536


class GuardedLasers:
    """The interface of `Lasers`, with the bus in a guard process. Safe to use from several threads.

    Parameters
    ----------
    bus : str
        See `i2c_transfers.open_bus`.
    channels : sequence of LaserChannel
        One to three, in the order of the DAC's outputs.
    gated : GatedLight or None
        As `Lasers` takes it.

    Raises
    ------
    InputError, DeviceError
        As `Lasers` does.
    DeviceGoneError
        From every method, once the guard has ended; the lasers are dark then.
    """

    def __init__(self, bus: str, channels: Sequence[LaserChannel], gated: GatedLight | None = None) -> None:
        self._lock = threading.Lock()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_WITHIN_S)
        with theirs:
            command = [sys.executable, "-m", "firmware_iface.lasers.guard_process", str(theirs.fileno())]
            self._process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
        try:
            asked = [dataclasses.asdict(channel) for channel in channels]
            opened = self._ask("open", bus, asked, gated and dataclasses.asdict(gated), within_s=30.0)
            self.channels: tuple[str, ...] = tuple(opened)
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
        """As `Lasers.off`; where the guard has ended, the lasers are dark already."""
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
        """Tell the guard that the caller is alive.

        Raises
        ------
        DeviceError
            Where the lasers have been switched off.
        """
        self._ask("beat")

    def expect(self, shares: Mapping[str, Sequence[float]] | None) -> float:
        """As `Lasers.expect`."""
        return float(self._ask("expect", shares))

    def status(self) -> dict[str, Any]:
        """As `Lasers.status`."""
        return dict(self._ask("status"))

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Send the heartbeat from a thread during the block, for programs without a loop of their own.

        It shows that the interpreter runs, not that the program makes progress: a service calls `heartbeat` from its
        loop.
        """

        def beat() -> bool:
            try:
                self.heartbeat()
            except DeviceError:
                return False  # dark; the next use of the lasers raises
            return True

        with repeated(beat, TICK_S):
            yield

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


def open_guarded_lasers(
    bus: str, channels: Sequence[LaserChannel], gated: GatedLight | None = None
) -> GuardedLasers:
    """Open the lasers on a bus in a guard process.

    Parameters
    ----------
    bus : str
        See `i2c_transfers.open_bus`.
    channels : sequence of LaserChannel
    gated : GatedLight or None
        As `Lasers` takes it.

    Returns
    -------
    GuardedLasers

    Raises
    ------
    InputError
        Where the bus cannot be opened or the channels do not fit the board.
    DeviceError
        Where a part of the board fails.
    """
    return GuardedLasers(bus, channels, gated)
