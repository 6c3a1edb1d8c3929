"""The service's metrics in Prometheus's format, on 127.0.0.1."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server

from firmware_iface.errors import InputError
from runtime.service.protocol import LaserState

STAGES = ("queue", "solve", "transfer", "total")
BUCKETS = (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.033, 0.066, 0.125, 0.25, 0.5, 1.0)


class Metrics:
    """Counters and histograms of one service, in a registry of its own."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.stage_seconds = Histogram(
            "hololoop_frame_stage_seconds",
            "Time of a frame in each stage: queue (End to the solver), solve, transfer (to the panel), total",
            ["stage"],
            buckets=BUCKETS,
            registry=self.registry,
        )
        for stage in STAGES:
            self.stage_seconds.labels(stage)
        self.shown = self._counter("frames_shown", "Frames put on the panel")
        self.late = self._counter("frames_late", "Frames put on the panel after their predicted display time")
        self.failed = self._counter(
            "frames_failed", "Accepted frames that were not shown, by reason", "reason"
        )
        self.faults = self._counter("faults", "Faults met, by kind", "kind")
        self.restarts = self._counter("restarts", "Child processes started again", "process")
        self.laser_state = Gauge(
            "hololoop_laser_state",
            "1 for the state that the lasers are in",
            ["state"],
            registry=self.registry,
        )
        self.laser_power = Gauge(
            "hololoop_laser_power", "Power asked for, fraction of full", ["channel"], registry=self.registry
        )
        self.lasers(LaserState.OFF)

    def _counter(self, name: str, about: str, *labels: str) -> Counter:
        return Counter(f"hololoop_{name}", about, labels, registry=self.registry)

    def lasers(self, state: LaserState) -> None:
        """Set the lasers' state."""
        for one in LaserState:
            self.laser_state.labels(one.name.lower()).set(one == state)

    def serve(self, port: int) -> None:
        """Answer http://127.0.0.1:port/metrics in a thread.

        Raises
        ------
        InputError
            Where the port is taken.
        """
        try:
            start_http_server(port, "127.0.0.1", self.registry)
        except OSError as error:
            raise InputError(f"metrics_port {port} cannot be used ({error.strerror}): give another") from None
