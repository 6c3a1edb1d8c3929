"""Emulated hardware as a program: what it says where it cannot start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


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
