"""The whole service over emulated hardware: real pyusb, real smbus2, real processes and sockets."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.service import protocol
from runtime.service.client import Client, LostFrame, RefusedError
from runtime.service.message_format import HEADER
from runtime.service.protocol import Code, LaserState, PartState, Shown
from tests.campaigns.headset import connected, hardware, picture, served, write_configuration
from tests.runtime.service.light_in_service import (
    emitted_uw,
    light_up,
    show,
    wait_until_fresh,
    within_five_attempts,
)
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("real_time")


class Headset(NamedTuple):
    file: Path
    remote: RemoteHardware


@pytest.fixture(scope="module")
def headset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Headset]:
    file = write_configuration(tmp_path_factory.mktemp("headset"))
    with hardware(file.parent) as remote, served(file):
        connected(file).close()
        yield Headset(file, remote)


@pytest.fixture
def client(headset: Headset) -> Iterator[Client]:
    with connected(headset.file) as client:
        wait_until_fresh(client)
        yield client
        client.dark()


def test_every_frame_is_shown_and_what_the_panel_displays_is_what_was_solved(
    headset: Headset, client: Client
) -> None:
    outcomes = show(client, 20)
    assert [o.frame for o in outcomes] == list(range(1, 21))
    shown = [o for o in outcomes if isinstance(o, Shown)]
    assert shown == outcomes
    # the best of them: how far a solve comes by its deadline is up to what else the machine does
    assert max(o.psnr_db for o in shown) > 10
    made = {o.pattern_crc for o in shown}
    until(lambda: made <= headset.remote.whole(), 15)


def test_light_needs_clear_and_arm_and_a_fresh_picture(headset: Headset, client: Client) -> None:
    show(client, 3)
    assert emitted_uw(headset.remote) == 0 and client.status().lasers in (LaserState.OFF, LaserState.FAULT)
    with pytest.raises(RefusedError, match="Clear first"):
        client.arm()

    def once() -> None:
        light_up(client, headset.remote)
        until(lambda: show(client, 1) and emitted_uw(headset.remote) == pytest.approx(50, rel=0.02), 5)
        until(lambda: emitted_uw(headset.remote) == 0, 3)  # nothing new is shown
        until(lambda: client.status().lasers == LaserState.ARMED, 1)
        # there was no fault, so no program has to clear and arm
        until(lambda: show(client, 2) and emitted_uw(headset.remote) > 0, 3)

    within_five_attempts(once)
    client.dark()
    assert emitted_uw(headset.remote) == 0


def test_the_camera_sees_what_the_lasers_light(headset: Headset, client: Client) -> None:
    dark = client.capture().mean()

    def once() -> None:
        light_up(client, headset.remote)
        until(lambda: show(client, 1) and client.capture().mean() > dark + 20, 5)

    within_five_attempts(once)


def test_an_open_interlock_is_dark_and_latches(headset: Headset, client: Client) -> None:
    light_up(client, headset.remote)
    opened = headset.remote.set_to("interlock", False)
    assert emitted_uw(headset.remote) == 0
    assert all(at < opened + 0.02 for at, power in headset.remote.light(opened) if power)
    until(lambda: client.status().lasers == LaserState.FAULT, 15)
    with pytest.raises(RefusedError, match="interlock"):
        client.clear()
    headset.remote.set_to("interlock", True)
    show(client, 10)
    assert emitted_uw(headset.remote) == 0  # closing it is not enough
    light_up(client, headset.remote)


def test_an_unplugged_panel_is_dark_and_works_again_without_a_restart(
    headset: Headset, client: Client
) -> None:
    light_up(client, headset.remote)
    headset.remote.break_part("panel", "unplug")
    until(lambda: emitted_uw(headset.remote) == 0, 3)
    lost = show(client, 3)
    assert lost and all(isinstance(o, LostFrame) and o.code == Code.PANEL for o in lost)
    until(lambda: client.status().panel == PartState.LOST, 15)
    headset.remote.repair("panel")
    until(lambda: client.status().panel == PartState.FRESH, 15)
    light_up(client, headset.remote)


@pytest.mark.parametrize("name", ["solver", "camera"])
def test_a_killed_process_is_dark_and_is_started_again(headset: Headset, client: Client, name: str) -> None:
    light_up(client, headset.remote)
    os.kill(child(client, name), signal.SIGKILL)
    until(lambda: emitted_uw(headset.remote) == 0, 3)
    until(lambda: getattr(client.status(), name) == PartState.FRESH, 15)
    light_up(client, headset.remote)


def child(client: Client, name: str) -> int:
    """The number of the service's solver or camera process."""
    service = client._link.peer().pid
    for pid in Path(f"/proc/{service}/task/{service}/children").read_text().split():
        if f"{name}_process" in Path(f"/proc/{pid}/cmdline").read_text():
            return int(pid)
    raise AssertionError(f"there is no {name} process")


def test_a_slot_that_is_written_after_end_is_not_shown(client: Client) -> None:
    timing = client.wait()
    client.begin(timing)
    client.slot()[:] = picture(client)
    assert client._ring is not None
    right = protocol.End(timing.frame, 0, 12345)
    client._taken[timing.frame] = 0
    client._ask(right, protocol.Done)
    [outcome] = client.outcomes(5)
    assert isinstance(outcome, LostFrame) and outcome.code == Code.TORN


def test_one_program_has_the_display_and_others_may_ask_for_status_and_dark(
    headset: Headset, client: Client
) -> None:
    light_up(client, headset.remote)
    with connected(headset.file) as other:
        with pytest.raises(RefusedError) as refused:
            other.wait()
        assert refused.value.code == Code.BUSY
        assert other.status().shown > 0
        other.dark()
    assert emitted_uw(headset.remote) == 0


def test_the_display_is_free_when_its_program_disconnects(headset: Headset, client: Client) -> None:
    client.show(picture(client))
    client.close()
    with connected(headset.file) as other:
        assert show(other, 2)
        other.dark()
    object.__setattr__(client, "dark", lambda: None)


def test_frame_calls_out_of_order_are_refused(client: Client) -> None:
    timing = client.wait()
    with pytest.raises(RefusedError) as refused:
        client._ask(protocol.End(timing.frame, 0, 0), protocol.Done)
    assert refused.value.code == Code.ORDER
    with pytest.raises(RefusedError) as refused:
        client._ask(protocol.Begin(77), protocol.Done)
    assert refused.value.code == Code.ORDER
    client.begin(timing)
    with pytest.raises(RefusedError) as refused:
        client._ask(protocol.End(timing.frame, 9, 0), protocol.Done)
    assert refused.value.code == Code.SLOT


def raw(headset: Headset) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(str(headset.file.parent / "service.sock"))
    connection.settimeout(10)
    return connection


def test_an_unknown_version_is_refused_with_the_supported_ones(headset: Headset) -> None:
    with raw(headset) as connection:
        connection.send(protocol.PROTOCOL.pack(protocol.Hello(protocol.MAGIC, 7, 9), 1))
        serial, error = protocol.PROTOCOL.unpack(connection.recv(512))
        assert (serial, error.code) == (1, Code.VERSION) and "1 to 1" in error.text
        assert connection.recv(512) == b""


def test_random_messages_are_answered_by_errors_and_disturb_no_other_program(
    headset: Headset, client: Client
) -> None:
    """Seeded: random bytes, random bytes after a valid header, valid messages in a wrong order."""
    rng = np.random.default_rng(5)
    kinds = protocol.PROTOCOL._bodies
    for k in range(300):
        with raw(headset) as connection:
            for _ in range(rng.integers(1, 5)):
                code = int(rng.integers(0, 20))
                body = rng.bytes(int(rng.integers(0, 64)))
                kind = list(kinds)[int(rng.integers(len(kinds)))]
                fitting = rng.bytes(kinds[kind].size)
                data = [
                    body or b"x",
                    HEADER.pack(code, 8 + len(body), k) + body,
                    HEADER.pack(protocol.PROTOCOL._codes[kind], 8 + len(fitting), k + 1) + fitting,
                    protocol.PROTOCOL.pack(protocol.Hello(protocol.MAGIC, 1, 1), 1),
                ][int(rng.integers(4))]
                try:
                    connection.send(data)
                except OSError:
                    break
    assert len(show(client, 5)) == 5


def test_a_passed_pipe_or_unsealed_memory_is_refused_as_a_ring(client: Client) -> None:
    count, size = client.slots, 2 * int(np.prod(client.shape))
    reading, writing = os.pipe()
    loose = os.memfd_create("loose")
    os.ftruncate(loose, count * size)
    try:
        for fds in ([reading], [loose], []):
            with pytest.raises(RefusedError) as refused:
                client._ask(protocol.Ring(count, size), protocol.Done, fds)
            assert refused.value.code == Code.RING
    finally:
        for fd in (reading, writing, loose):
            os.close(fd)
    assert len(show(client, 2)) == 2


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_program_in_c_shows_a_frame(headset: Headset, tmp_path: Path) -> None:
    """With only the header."""
    source, header = Path(__file__).with_name("client.c"), Path(protocol.__file__).parent
    program = tmp_path / "client"
    command = [
        "cc",
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        f"-I{header}",
        str(source),
        "-o",
        str(program),
    ]
    subprocess.run(command, check=True)
    path = headset.file.parent / "service.sock"
    done = subprocess.run([program, path], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("24 x 32, frame 1 in slot 1, ") and done.stdout.endswith("solver 1\n")


def test_a_black_picture_is_dark_at_once_and_the_next_is_lit_without_arming(
    headset: Headset, client: Client
) -> None:
    """No pattern can show black: the light always goes somewhere."""

    def dark_after_its_outcome() -> bool:
        list(client.outcomes(0.5))
        return emitted_uw(headset.remote) == 0

    def once() -> None:
        light_up(client, headset.remote)
        client.show(np.zeros(client.shape, np.uint16))
        until(dark_after_its_outcome, 0.4)
        assert client.status().lasers == LaserState.ARMED
        until(lambda: show(client, 2) and emitted_uw(headset.remote) > 0, 5)

    within_five_attempts(once)
