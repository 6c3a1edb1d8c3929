"""Metrics: every name that monitoring relies on exists from the start, and counts the events."""

from __future__ import annotations

import socket
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from firmware_iface.errors import InputError
from runtime.service.fault_log import FaultLog
from runtime.service.metrics import STAGES, Metrics
from runtime.service.protocol import LaserState


def scraped(metrics: Metrics) -> dict[tuple[str, ...], float]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    metrics.serve(port)
    text = urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10).read().decode()
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_what_happened_is_read_over_http(capsys: pytest.CaptureFixture[str]) -> None:
    metrics = Metrics()
    metrics.shown.inc()
    metrics.late.inc(0)
    metrics.lasers(LaserState.FAULT)
    metrics.laser_power.labels("green").set(0.5)
    metrics.stage_seconds.labels("solve").observe(0.003)
    faults = FaultLog(metrics)
    for _ in range(3):
        faults.note("panel", "unplugged")
    found = scraped(metrics)
    assert found["hololoop_frames_shown_total",] == 1 and found["hololoop_frames_late_total",] == 0
    assert found["hololoop_faults_total", "panel"] == faults.count == 3
    assert capsys.readouterr().err == "panel: unplugged\n"  # written once
    states = {state: found["hololoop_laser_state", state.name.lower()] for state in LaserState}
    assert states == {state: float(state is LaserState.FAULT) for state in LaserState}
    assert found["hololoop_laser_power", "green"] == 0.5
    assert {stage: found["hololoop_frame_stage_seconds_count", stage] for stage in STAGES} == {
        stage: float(stage == "solve") for stage in STAGES
    }
    assert found["hololoop_frame_stage_seconds_bucket", "0.002", "solve"] == 0
    assert found["hololoop_frame_stage_seconds_bucket", "0.004", "solve"] == 1


def test_a_port_that_is_taken_is_an_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="metrics_port"):
            Metrics().serve(taken.getsockname()[1])
