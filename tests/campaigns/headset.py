"""A small headset for tests and campaigns: configuration, emulated hardware, service, client."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from firmware_iface.virtual.remote_hardware import RemoteHardware, running
from runtime.bundle.bundle_folder import write_bundle
from runtime.bundle.light_path_arrays import pack_light_paths
from runtime.service.client import Client, connect
from tests.runtime.benches import converted, ideal_path

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
SHAPE = (24, 32)
DISTANCE_MM = 6.0


@contextmanager
def urgent() -> Iterator[None]:
    """Schedule processes that start in the block as the unit file does, where that is allowed."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(10))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


BENCH = """
[panel]
height = {height}
width = {width}
[propagation]
distance_mm = {distance_mm}
"""

COLOURS = {"red": 638.0, "green": 520.0, "blue": 450.0}  # wavelength, nm; in the order of the board's lasers

CONFIGURATION = """
schema = 1
bundle = "bundle"
[service]
socket = "service.sock"
refresh_hz = {refresh_hz}
solve_ms = {solve_ms}
stale_limit_ms = {stale_limit_ms}
metrics_port = {metrics_port}
[panel]
{panel}[lasers]
bus = "virtual:{folder}/hardware.sock"
power = {{ {power} }}
[camera]
{camera}
"""


def write_configuration(
    folder: Path,
    refresh_hz: float = 50.0,
    solve_ms: float = 12.0,
    stale_limit_ms: float = 400.0,
    oak: str | None = None,
    colours: bool = False,
    shape: tuple[int, int] = SHAPE,
    metrics_port: int = 0,
    patterns: int = 1,
    half_width: float = 1.0,
    slow_share: float = 0.0,
    display: bool = False,
) -> Path:
    """A bundle, a bench and a configuration in `folder`; returns the configuration's path.

    The default limits are wide, so that a busy machine is not taken for a fault.

    Parameters
    ----------
    folder : Path
    refresh_hz : float, Hz
    solve_ms, stale_limit_ms : float, ms
    oak : str or None
        Loopback address of an emulated OAK camera; None: the camera without a link.
    colours : bool
        Whether three colours are shown in turn.
    shape : (int, int)
        (H, W), pixels of the panel. Where it is not SHAPE, frames come at most 60 times a second, a transfer may take
        as long as so many pixels need, and the camera gives the same picture again and again, since a simulated one
        would take longer than a frame.
    metrics_port : int
        Of the service's metrics; 0: none.
    patterns : int
        Of each colour of a picture.
    half_width : float
        Of the iris, as a share of the panel's band.
    slow_share : float
        Of the phase before that the panel keeps for a period, as the bundle says; the bench's panel is not slow.
    display : bool
        Whether the panel is at a display link, with 1080 x 1920 pixels, in place of the emulated board.
    """
    small = shape == SHAPE
    distance_mm = DISTANCE_MM * shape[0] / SHAPE[0]
    path = converted(ideal_path(shape, distance_mm * 1e-3, half_width), np.float32)
    shown = COLOURS if colours else {"green": 520.0}
    records, arrays = pack_light_paths([(name, distance_mm, nm, path) for name, nm in shown.items()])
    panel_keys = {"panel": {"slow_response_share": slow_share}} if slow_share else {}
    write_bundle(folder / "bundle", arrays, {"paths": records, "distance_mm": distance_mm, **panel_keys}, {})
    channels = [f'[[channel]]\nname = "{name}"\nwavelength_nm = {nm}\n' for name, nm in shown.items()]
    coarse = "[simulation]\nsubpixels = 2\n" if colours else ""  # three colours take a third of the time each
    bench = BENCH.format(height=shape[0], width=shape[1], distance_mm=distance_mm)
    iris = f"[iris]\nhalf_width = {half_width}\n"
    (folder / "bench.toml").write_text(bench + iris + "".join(channels) + coarse)
    file = folder / "headset.toml"
    camera = f'kind = "virtual"\nbus = "virtual:{folder}/hardware.sock"'
    if oak:
        camera = f'kind = "oak"\naddress = "{oak}"\nframes_per_s = 100.0'
    elif not small:
        camera = 'kind = "tests.campaigns.still_camera:still_camera"'
    fields = len(shown) * patterns
    panel = "refresh_hz = 1000.0\n" if small else f"refresh_hz = {60 * fields}\ntimeout_ms = 500\n"
    if display:
        panel = f'kind = "tests.campaigns.screen:{"colours" if colours else "screen"}"\n' + panel
    else:
        panel = f'bus = "virtual:{folder}/hardware.sock"\n' + panel
    file.write_text(
        CONFIGURATION.format(
            folder=folder,
            refresh_hz=refresh_hz,
            solve_ms=solve_ms,
            stale_limit_ms=stale_limit_ms,
            camera=camera,
            panel=panel + (f"fields = {fields}\n" if fields > 1 else ""),
            metrics_port=metrics_port,
            power=", ".join(f"{name} = 0.5" for name in shown),
        )
    )
    return file


@contextmanager
def hardware(folder: Path, seed: int = 0, oak: str | None = None) -> Iterator[RemoteHardware]:
    """Emulated hardware for the configuration in `folder`, in a process of its own."""
    with ExitStack() as stack:
        with urgent():
            remote = stack.enter_context(
                running(folder / "hardware.sock", str(folder / "bench.toml"), seed, oak)
            )
        yield remote


@contextmanager
def served(file: Path, **environment: str) -> Iterator[subprocess.Popen[str]]:
    """The service of a configuration, ready; ends with the block, by SIGTERM."""
    with urgent():
        process = subprocess.Popen(
            [sys.executable, "-m", "runtime.cli", "serve", str(file), "--json"],
            env={**ENVIRONMENT, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def connected(file: Path, within_s: float = 20.0, slots: int = 3) -> Client:
    """A client of the service of a configuration, once it answers."""
    until = time.monotonic() + within_s
    while True:
        try:
            return connect(file.parent / "service.sock", slots, timeout_s=within_s)
        except ValueError:
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


def picture(client: Client, seed: int = 0) -> np.ndarray:
    """A smooth picture of the client's shape, uint16."""
    colours, height, width = client.shape
    y, x = np.mgrid[0:height, 0:width]
    one = 0.5 + 0.4 * np.sin(0.3 * x + 0.2 * y + seed)
    if colours == 1:
        return np.broadcast_to(65535 * one, client.shape).astype(np.uint16)
    lights = np.array([1.0, 0.7, 0.4])
    lights[(seed // 2) % 3] *= seed % 2  # every second picture lacks a colour
    return (65535 * one * lights[:, None, None]).astype(np.uint16)


def knock(file: Path, messages: list[bytes]) -> None:
    """Send messages of any kind to the service of a configuration, and disconnect."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.connect(str(file.parent / "service.sock"))
        for message in messages:
            connection.send(message)
