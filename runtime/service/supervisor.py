"""The service's own process: it starts all parts, checks their signs of life and reports them.

It has three threads: the event loop with all sockets, the display with the panel, and the heartbeat with the lasers.
None waits for another. The solver and the camera, whose libraries may hang or crash, are processes of their own.
"""

from __future__ import annotations

import signal
import socket
import sys
import time
from contextlib import suppress
from functools import partial

from firmware_iface.configured_devices import laser_power, open_lasers
from runtime.service import protocol
from runtime.service.camera_client import CameraClient
from runtime.service.configuration import Configuration
from runtime.service.connected_programs import MOST_SESSIONS, ConnectedPrograms
from runtime.service.event_loop import EventLoop
from runtime.service.fault_log import FaultLog
from runtime.service.frame_pipeline import FramePipeline
from runtime.service.laser_heartbeat import LaserHeartbeat
from runtime.service.listening_socket import listening_socket
from runtime.service.metrics import Metrics
from runtime.service.protocol import LaserState, PartState
from runtime.service.refinement_captures import RefinementCaptures
from runtime.service.solver_client import SolverSend
from runtime.service.systemd import Notifier

TURN_S, TURN_WAITED_S = 0.010, 0.001  # of the loop; the shorter while a program waits for a frame
SWITCH_S = 0.0005  # Python's default of 5 ms before it switches threads would make a frame late
READY = "serving; the lasers are dark until a program clears and arms them"
LOOPS_NS = 1_000_000_000  # while a thread has not turned for so long, the watchdog is not fed


class Supervisor:
    """All parts of the service, in one process."""

    def __init__(self, configuration: Configuration) -> None:
        self.configuration = configuration
        self.notifier, self.metrics, self.loop = Notifier(), Metrics(), EventLoop()
        self.faults = FaultLog(self.metrics)
        self.camera = CameraClient(configuration, self.loop, self.faults, self.metrics)
        self.lasers = LaserHeartbeat(
            # a program's Clear opens them again, and by then the solver has said which colours it shows
            lambda: open_lasers(configuration.devices["lasers"], self.pipeline.gated),
            laser_power(configuration.devices["lasers"]),
            self._fresh_until,
            lambda: self.pipeline.display.lit_until_ns,
            lambda kind, text: self.loop.later(partial(self.faults.note, kind, text)),
            lambda: self.pipeline.solver.colours,
            lambda: self.pipeline.lit_colours,
        )
        self.pipeline = FramePipeline(
            configuration, self.loop, self.faults, self.metrics, self.lasers.expect, self._captures
        )
        self.programs = ConnectedPrograms(
            configuration.users, self.loop, self.pipeline, self.lasers, self.camera, self.state
        )
        self.turned_ns = time.monotonic_ns()
        self.fed_ns = 0
        self.published: LaserState | None = None
        self.stopping = False

    def run(self) -> None:
        """Serve until SIGTERM or SIGINT.

        Raises
        ------
        InputError
            Where the configuration cannot be served.
        """
        listener = listening_socket(self.configuration.socket, MOST_SESSIONS)
        if self.configuration.timing.metrics_port:
            self.metrics.serve(self.configuration.timing.metrics_port)
        sys.setswitchinterval(SWITCH_S)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self.loop.later(self._stop))
        self.lasers.start()
        try:
            while self.pipeline.solver.shape is None and not self.stopping:
                self._turn()
            self.pipeline.display.start()
            listener.setblocking(False)
            self.loop.watch(listener, partial(self.programs.accept, listener))
            self._ready()
            while not self.stopping:
                self._turn()
        finally:
            self._end(listener)

    @property
    def counts(self) -> dict[str, int]:
        """Frames shown, late and failed, and faults, since the start."""
        p = self.pipeline
        return {"shown": p.shown_frames, "late": p.late, "failed": p.failed, "faults": self.faults.count}

    def state(self) -> protocol.State:
        """The state of the headset."""
        now, fresh, counts = time.monotonic_ns(), self._fresh_until(), self.counts

        def part(name: str, there: bool) -> PartState:
            if not there:
                return PartState.LOST
            return PartState.FRESH if fresh[name] >= now else PartState.STALE

        return protocol.State(
            now,
            counts["shown"],
            counts["late"],
            counts["failed"],
            self.lasers.state,
            self.lasers.faults,
            part("panel", self.pipeline.display.open),
            part("solver", self.pipeline.solver.fresh_until_ns > 0),
            part("camera", self.camera.fresh_until_ns > 0) if self.camera.configured else PartState.ABSENT,
            counts["faults"],
        )

    def _turn(self) -> None:
        now = self.turned_ns = time.monotonic_ns()
        self.pipeline.solver.turn(now)
        self.camera.turn(now * 1e-9)
        self.pipeline.refinement.turn()
        waited = self.programs.give_frames(now)
        self._feed_watchdog(now)
        self._publish()
        self.loop.turn(TURN_WAITED_S if waited else TURN_S)
        self.programs.remove_closed()

    def _feed_watchdog(self, now: int) -> None:
        """Report to systemd that all threads turn. A missing device is no reason to start the service again."""
        every = self.notifier.watchdog_s
        loops = (self.lasers, self.pipeline.display)
        if every is None or now < self.fed_ns + every * 5e8 or not self.pipeline.display.is_alive():
            return
        self.fed_ns = now
        if all(now - loop.turned_ns < LOOPS_NS for loop in loops):
            self.notifier.alive()

    def _publish(self) -> None:
        """Put the lasers' state and power into the metrics."""
        if self.lasers.state != self.published:
            self.published = self.lasers.state
            self.metrics.lasers(self.published)
        for channel, power in self.lasers.level.items():
            self.metrics.laser_power.labels(channel).set(power)

    def _ready(self) -> None:
        """Say to systemd and on standard error that programs may connect."""
        self.notifier.ready(READY)
        with suppress(OSError):
            print(f"ready at {self.configuration.socket}: {READY}", file=sys.stderr, flush=True)

    def _stop(self) -> None:
        self.stopping = True

    def _end(self, listener: socket.socket) -> None:
        """Switch the lasers off first, then end everything else."""
        self.lasers.stop()
        self.notifier.stopping()
        self.pipeline.close()
        self.programs.close()
        self.camera.close()
        listener.close()
        self.loop.close()

    def _captures(self, send: SolverSend) -> RefinementCaptures:
        return RefinementCaptures(self.camera, send, lambda: self.lasers.state)

    def _fresh_until(self) -> dict[str, int]:
        """Until when each part that light depends on counts as fresh; called in the lasers' thread."""
        stale_ns = self.pipeline.stale_ns
        fresh = {
            "the service": self.turned_ns + stale_ns,
            "panel": self.pipeline.display.answered_ns + stale_ns,
            "solver": self.pipeline.solver.fresh_until_ns,
        }
        if self.camera.configured:
            fresh["camera"] = self.camera.fresh_until_ns
        return fresh
