"""systemd: notifications, the watchdog, the passed socket, and unit files that systemd accepts."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from firmware_iface.errors import InputError
from runtime.service.configuration import read_configuration
from runtime.service.systemd import Notifier, passed_socket
from runtime.service.systemd_units import write_units
from tests.campaigns.headset import write_configuration


def test_notifications_arrive_as_sd_notify_sends_them(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        notifier = Notifier(
            {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}
        )
        assert notifier.watchdog_s == 1.0
        notifier.ready("up")
        notifier.alive()
        notifier.stopping()
        assert [manager.recv(100) for _ in range(3)] == [b"READY=1\nSTATUS=up", b"WATCHDOG=1", b"STOPPING=1"]
    notifier.alive()  # a manager that has ended is no reason to fail


def test_an_abstract_socket_is_understood() -> None:
    name = f"hololoop-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name)
        Notifier({"NOTIFY_SOCKET": "@" + name}).alive()
        assert manager.recv(100) == b"WATCHDOG=1"


def test_without_systemd_nothing_is_sent() -> None:
    notifier = Notifier({})
    notifier.ready("up")
    assert notifier.watchdog_s is None


def test_a_watchdog_for_another_process_is_not_ours() -> None:
    assert Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}).watchdog_s is None


def test_no_socket_is_taken_that_was_passed_to_another_process() -> None:
    assert passed_socket({"LISTEN_PID": "1", "LISTEN_FDS": "1"}) is None
    assert passed_socket({}) is None


def test_two_sockets_are_one_too_many() -> None:
    with pytest.raises(InputError, match="2 sockets"):
        passed_socket({"LISTEN_PID": str(os.getpid()), "LISTEN_FDS": "2"})


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze")
def test_systemd_accepts_the_unit_files(tmp_path: Path) -> None:
    paths = write_units(read_configuration(write_configuration(tmp_path)), tmp_path / "units")
    done = subprocess.run(
        ["systemd-analyze", "verify", *map(str, paths)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    text = paths[0].read_text()
    for line in ("Type=notify", "WatchdogSec=", "ExecStopPost=", "Requires=hololoop.socket"):
        assert line in text
    assert f"ListenSequentialPacket={tmp_path}/service.sock" in paths[1].read_text()
