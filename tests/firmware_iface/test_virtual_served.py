"""Emulated hardware as a program: what it says where it cannot start, and light without a panel."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from firmware_iface.errors import DeviceError
from firmware_iface.lasers import VIRTUAL_CHANNELS
from firmware_iface.lasers.guarded_lasers import open_guarded_lasers
from firmware_iface.virtual.remote_hardware import i2c_bus, running

pytestmark = pytest.mark.usefixtures("real_time")


@pytest.mark.parametrize(
    ("bench", "socket", "message"),
    [
        ("virtual:nosuch", "hardware.sock", "there is no virtual bench 'nosuch'"),
        ("nosuch.toml", "hardware.sock", "there is no bench 'nosuch.toml'"),
        ("virtual:small_demo", "nosuch/hardware.sock", "nosuch/hardware.sock"),
    ],
)
def test_what_it_cannot_serve_is_one_line(tmp_path: Path, bench: str, socket: str, message: str) -> None:
    command = [
        sys.executable,
        "-m",
        "firmware_iface.virtual.served",
        str(tmp_path / socket),
        "--bench",
        bench,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and message in done.stderr


def test_lasers_without_a_panel_shine_only_where_nothing_gates_them(tmp_path: Path) -> None:
    socket = tmp_path / "hardware.sock"
    with (
        running(socket, "virtual:ideal") as remote,
        open_guarded_lasers(i2c_bus(f"virtual:{socket}"), VIRTUAL_CHANNELS) as lasers,
    ):
        with pytest.raises(DeviceError):
            lasers.clear()
            lasers.arm()
            lasers.set_power("green", 0.5)
        assert max(power for _, power in remote.light()) == 0
        remote.set_to("gated", False)
        for _ in range(5):  # again where a busy machine held up the heartbeat
            with suppress(DeviceError):
                lasers.clear()
                lasers.arm()
                lasers.set_power("green", 0.5)
                break
        assert remote.light()[-1][1] > 0
