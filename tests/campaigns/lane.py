"""One headset under test: emulated hardware, the service over it, a program that shows pictures without pause."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from firmware_iface.virtual.remote_hardware import RemoteHardware, i2c_bus
from runtime.service.client import Client, LostFrame, RefusedError
from runtime.service.protocol import LaserState, PartState, Shown
from tests.campaigns.headset import ENVIRONMENT, connected, hardware, picture, urgent, write_configuration
from tests.campaigns.service import noted, noted_fields

PICTURES = 16
REFRESH_HZ, SOLVE_MS, STALE_MS = 100.0, 3.0, 80.0
COLOURS_HZ, COLOURS_MS = 50.0, 3.0  # of pictures in three colours, and time for their patterns
RECOVERY_S = 45.0  # a busy machine makes light stale again and again
LOST_FOR_S = 1.0  # without the safety controller, before a person looks at the laser board


class Lane:
    """A running headset in a folder of its own.

    Parameters
    ----------
    folder : Path
    seed : int
    oak : str or None
        Loopback address of an emulated OAK camera; None: the camera without a link.
    refresh_hz : float, Hz
        Of pictures in one colour.
    colours : bool
        Whether it shows three colours in turn.
    patterns : int
        Of each colour of a picture, in fields of their own.
    file : Path or None
        A configuration that is in the folder already, from `write_configuration`; None: one is written.

    Attributes
    ----------
    remote : RemoteHardware
    client : Client
    service : subprocess.Popen
    accepted, shown, lost : int
        Frames.
    latest : int
        Number of the frame that was accepted last.
    outcomes : list of Shown or Lost
        Those that were taken last.
    stored : int
        How often the DAC's EEPROM was written dark again.
    """

    def __init__(
        self,
        folder: Path,
        seed: int,
        oak: str | None = None,
        refresh_hz: float = REFRESH_HZ,
        colours: bool = False,
        file: Path | None = None,
        patterns: int = 1,
    ) -> None:
        self.folder, self.seed = folder, seed
        solve_ms = min(SOLVE_MS, 300 / refresh_hz)
        if colours or patterns > 1:
            refresh_hz, solve_ms = COLOURS_HZ, COLOURS_MS
        self.file = file or write_configuration(
            folder, refresh_hz, solve_ms, STALE_MS, oak, colours, patterns=patterns
        )
        self.accepted = self.shown = self.lost = 0
        self.outcomes: list[Shown | LostFrame] = []
        self.latest = self.stored = 0
        self._stack = ExitStack()
        self.remote: RemoteHardware = self._stack.enter_context(hardware(folder, seed, oak))
        self.service = self.start_service()
        self.client: Client = connected(self.file)
        self.pictures = [picture(self.client, k) for k in range(PICTURES)]
        self._next = 0

    def close(self) -> None:
        """End everything."""
        with suppress(OSError):
            self.client.close()
        self.end_service(signal.SIGTERM)
        self._stack.close()

    # --- the service

    def start_service(self) -> subprocess.Popen[bytes]:
        """Start it, as systemd does after each end."""
        with (self.folder / "service.log").open("ab") as log, urgent():
            command = [sys.executable, "-m", "tests.campaigns.service", str(self.file)]
            return subprocess.Popen(command, env=ENVIRONMENT, stderr=log)

    def end_service(self, number: int) -> None:
        """Send it a signal that ends it, and wait."""
        self.service.send_signal(number)
        self.service.wait(20)

    def child(self, name: str) -> int:
        """The number of the service's "solver" or "camera" process; 0 while there is none."""
        with suppress(OSError):
            for pid in Path(f"/proc/{self.service.pid}/task/{self.service.pid}/children").read_text().split():
                if f" {name}_process" in _words(pid) or (
                    name == "solver" and "campaigns.service" in _words(pid)
                ):
                    return int(pid)
        return 0

    def signal_child(self, name: str, number: int) -> float:
        """Send a child process a signal; the time, monotonic s."""
        at = time.monotonic()
        if pid := self.child(name):
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        return at

    # --- the program

    def frame(self) -> None:
        """Show one picture and take the outcomes of earlier ones."""
        self._next = (self._next + 1) % len(self.pictures)
        try:
            self.latest = self.client.show(self.pictures[self._next])
            self.accepted += 1
        except RefusedError:  # the solver is being started again
            time.sleep(0.002)
        self.take()

    def take(self, within_s: float = 0.0) -> list[Shown | LostFrame]:
        """Outcomes since the last time."""
        self.outcomes = list(self.client.outcomes(within_s))
        self.shown += sum(isinstance(o, Shown) for o in self.outcomes)
        self.lost += sum(isinstance(o, LostFrame) for o in self.outcomes)
        return self.outcomes

    def reconnect(self, within_s: float = RECOVERY_S) -> None:
        """A new program in place of the one that ended."""
        with suppress(OSError):
            self.client.close()
        self.client = connected(self.file, within_s)

    def unanswered(self, within_s: float = 5.0) -> int:
        """How many accepted frames have no outcome, once there was time for one."""
        end = time.monotonic() + within_s
        while self.client.in_flight and time.monotonic() < end:
            self.take(0.05)
        return len(self.client.in_flight)

    # --- the light

    def lit(self) -> bool:
        """Whether any laser emits."""
        return self.remote.light(time.monotonic())[-1][1] > 0

    def dark_since(self, at_s: float) -> float | None:
        """When the light went out for good after `at_s`, monotonic s; None while there is some."""
        changes = self.remote.light(at_s)
        if changes[-1][1] > 0:
            return None
        return max(at_s, changes[-1][0])

    def light_up(self, within_s: float = RECOVERY_S) -> bool:
        """Bring the headset to light, as a program does: show, clear and arm where needed. Whether that succeeded."""
        end = time.monotonic() + within_s
        answered = time.monotonic()
        while time.monotonic() < end:
            state = self.client.status()
            if state.lasers != LaserState.LOST:
                answered = time.monotonic()
            elif time.monotonic() > answered + LOST_FOR_S:
                self.store_dark()
                answered = time.monotonic()
            parts = {state.panel, state.solver, state.camera}
            if state.lasers == LaserState.EMITTING and parts == {PartState.FRESH} and self.lit():
                return True
            if parts == {PartState.FRESH} and state.lasers in (LaserState.OFF, LaserState.FAULT):
                with suppress(RefusedError):
                    self.client.clear()
                    self.client.arm()
            self.frame()
        return False

    def store_dark(self) -> None:
        """Write the DAC's EEPROM dark with the key off, as a person does after noise on the bus has changed it."""
        bus = i2c_bus(f"virtual:{self.folder / 'hardware.sock'}")
        self.remote.set_to("key", False)
        command = [sys.executable, "-m", "firmware_iface.lasers.store_dark", bus]
        subprocess.run(command, env=ENVIRONMENT, capture_output=True)
        self.remote.set_to("key", True)
        self.stored += 1

    def torn(self) -> int:
        """How many different images the panel has displayed that are no pattern of the solver's."""
        blank = np.zeros(self.client.shape[1:], np.uint8)
        return len(self.remote.whole() - noted(self.folder) - {_crc(blank)})

    def lit_fields(self) -> int:
        """How many different fields the panel has displayed with light."""
        return len(self.remote.lit())

    def wrongly_lit(self) -> int:
        """How many different fields had light that was not their own, or were no pattern of the solver's."""
        lit = self.remote.lit()
        return len(lit - noted_fields(self.folder)) if lit else 0


def _words(pid: str) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ").replace("runtime.service.", " ")


def _crc(gray: np.ndarray) -> int:
    from runtime.service.shared_memory import crc32

    return crc32(gray)
