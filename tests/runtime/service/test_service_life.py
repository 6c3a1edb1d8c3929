"""How a service starts, ends and is refused, each test with one of its own over emulated hardware."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from runtime.cli import main
from runtime.service import protocol
from runtime.service.configuration import read_configuration
from runtime.service.protocol import Code
from runtime.service.socket_link import MessageLink, PeerCredentials
from runtime.service.supervisor import Supervisor
from tests.campaigns.headset import ENVIRONMENT, connected, hardware, picture, served, write_configuration
from tests.runtime.service.light_in_service import (
    emitted_uw,
    light_up,
    show,
    wait_until_fresh,
    within_five_attempts,
)
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("real_time")


def test_frames_are_lit_by_all_lasers_when_the_light_of_each_pattern_is_predicted(tmp_path: Path) -> None:
    """Every pattern then waits until the lasers are ready for it."""
    file = write_configuration(tmp_path)
    power = "power = { red = 1.0, green = 1.0, blue = 1.0 }\nmrad_per_pixel = 5.0"
    file.write_text(file.read_text().replace("power = { green = 0.5 }", power))
    with hardware(tmp_path) as remote, served(file), connected(file) as client:
        wait_until_fresh(client)

        def once() -> None:
            light_up(client, remote)
            until(lambda: show(client, 2) and emitted_uw(remote) == pytest.approx(235, rel=0.02), 5)

        within_five_attempts(once)


def test_missing_hardware_is_one_fault_a_part_and_the_log_says_what_is_missing(tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    with served(file) as process, connected(file) as client:
        until(lambda: client.status().faults >= 3, 15)
        time.sleep(1.0)  # some fifty attempts for the panel, twenty for the lasers
        assert client.status().faults == 3
        process.send_signal(signal.SIGTERM)
        _, log = process.communicate(timeout=10)
    for kind in ("panel", "laser_bus", "camera"):
        assert f"{kind}: there is no emulated hardware" in log or f"{kind}: the bus" in log, log


def test_a_user_who_is_not_listed_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the kernel's credentials, before anything is read."""
    supervisor = Supervisor(read_configuration(write_configuration(tmp_path)))
    monkeypatch.setattr(MessageLink, "peer", lambda link: PeerCredentials(1, 12345, 12345))
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as program,
    ):
        listener.bind(str(tmp_path / "here"))
        listener.listen(1)
        program.connect(str(tmp_path / "here"))
        supervisor.programs.accept(listener)
        _, error = protocol.PROTOCOL.unpack(program.recv(512))
        assert error.code == Code.REFUSED and "12345" in error.text
        assert program.recv(512) == b"" and not supervisor.programs.sessions


def test_the_lasers_are_switched_off_by_a_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What the unit runs after every end of the service."""
    file = write_configuration(tmp_path)
    with hardware(tmp_path) as remote:
        assert main(["serve", "--dark", str(file), "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"dark": True}
        assert emitted_uw(remote) == 0
    assert main(["serve", "--dark", str(file)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_socket_that_systemd_passes_is_served(tmp_path: Path) -> None:
    """sd_listen_fds: the listener is descriptor 3, and connections wait in it until the service has started."""
    file = write_configuration(tmp_path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with listener, hardware(tmp_path):
        listener.bind(str(tmp_path / "service.sock"))
        listener.listen(4)
        start = (
            "import os, sys; os.dup2(int(sys.argv[1]), 3); os.set_inheritable(3, True); "
            "os.environ.update(LISTEN_FDS='1', LISTEN_PID=str(os.getpid())); "
            "os.execv(sys.executable, [sys.executable, '-m', 'runtime.cli', 'serve', sys.argv[2]])"
        )
        command = [sys.executable, "-c", start, str(listener.fileno()), str(file)]
        process = subprocess.Popen(command, pass_fds=[listener.fileno()], env=ENVIRONMENT)
        try:
            with connected(file) as client:
                assert len(show(client, 2)) == 2
        finally:
            process.terminate()
            process.wait(10)
    assert process.returncode == 0


def test_sigterm_switches_the_lasers_off_and_ends_the_service(tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    with notify, hardware(tmp_path) as remote:
        notify.bind(str(tmp_path / "notify"))
        notify.settimeout(20)
        with served(file, NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="400000") as process:
            assert notify.recv(500).startswith(b"READY=1")
            assert process.stderr is not None
            assert process.stderr.readline().startswith(f"ready at {tmp_path / 'service.sock'}: serving")
            assert notify.recv(500) == b"WATCHDOG=1"
            with connected(file) as client:
                wait_until_fresh(client)
                light_up(client, remote)
                client.show(picture(client))
                process.send_signal(signal.SIGTERM)
                out, err = process.communicate(timeout=10)
            assert process.returncode == 0, err
            assert json.loads(out)["served"]["shown"] > 0
            assert emitted_uw(remote) == 0


def test_a_service_that_is_killed_is_dark_by_the_dead_man_and_can_be_started_again(tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    with hardware(tmp_path) as remote:
        with served(file) as process, connected(file) as client:
            wait_until_fresh(client)
            light_up(client, remote)
            killed = time.monotonic()
            process.kill()
            process.wait()
            until(lambda: emitted_uw(remote) == 0, 1)
            assert max(at for at, _ in remote.light(killed)) < killed + 0.15
        with served(file), connected(file) as client:
            wait_until_fresh(client)
            light_up(client, remote)


def test_a_broken_bundle_ends_the_service_with_one_error(tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    arrays = tmp_path / "bundle" / "lightpath.safetensors"
    data = bytearray(arrays.read_bytes())
    data[-1] ^= 1
    arrays.write_bytes(data)
    with served(file) as process:
        out, err = process.communicate(timeout=20)
        assert (process.returncode, out) == (2, "")
        assert "SHA-256" in err and "Traceback" not in err
