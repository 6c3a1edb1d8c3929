"""A picture is refined while the service displays it: real processes, emulated hardware, a hidden defect."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.bundle.bundle_folder import read_bundle, write_bundle
from runtime.service.client import Client, RefusedError
from runtime.service.protocol import Code, LaserState, PartState, Shown
from tests.campaigns.headset import SHAPE, connected, hardware, picture, served, write_configuration

pytestmark = pytest.mark.usefixtures("real_time")

DEFECT = """
[[defect]]
kind = "phase_response"
"""


class Headset(NamedTuple):
    file: Path
    remote: RemoteHardware


@pytest.fixture(scope="module")
def headset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Headset]:
    """A service whose bundle has a network that was never trained, with a registered camera."""
    torch = pytest.importorskip("torch")
    from trainer.networks.approximator import Approximator, Architecture
    from trainer.networks.onnx_files import onnx_files

    torch.manual_seed(0)
    networks = onnx_files(Approximator(Architecture("compact", 4, SHAPE, 1)))
    file = write_configuration(tmp_path_factory.mktemp("refined"))
    bundle = read_bundle(file.parent / "bundle")
    write_bundle(
        file.parent / "bundle", bundle.arrays, bundle.description, {}, networks=networks, replace=True
    )
    bench = file.parent / "bench.toml"
    bench.write_text(bench.read_text() + DEFECT)
    with hardware(file.parent) as remote, served(file):
        yield Headset(file, remote)


@pytest.fixture
def client(headset: Headset) -> Iterator[Client]:
    with connected(headset.file) as client:
        end = time.monotonic() + 15
        while {client.status().panel, client.status().camera} != {PartState.FRESH}:
            assert time.monotonic() < end
        while client.status().lasers != LaserState.EMITTING:
            assert time.monotonic() < end + 15
            keep_lit(client)
            display(client, 3)
        yield client
        client.dark()


def keep_lit(client: Client) -> None:
    """Arm again where something became stale on a busy machine."""
    if client.status().lasers in (LaserState.OFF, LaserState.FAULT):
        with suppress(RefusedError):
            client.clear()
            client.arm()


def display(client: Client, frames: int, seed: int = 0) -> list[Shown]:
    """Show one picture `frames` times."""
    shown: list[Shown] = []
    for _ in range(frames):
        client.show(picture(client, seed))
        shown += [o for o in client.outcomes() if isinstance(o, Shown)]
    while client.in_flight:
        shown += [o for o in client.outcomes(5) if isinstance(o, Shown)]
    return shown


def test_the_picture_on_display_gets_better_and_the_lasers_stay_as_they_are(
    headset: Headset, client: Client
) -> None:
    before = {s.pattern_crc for s in display(client, 3)}
    began = time.monotonic()
    client.refine(12)
    end = time.monotonic() + 60
    displayed: set[int] = set()
    while client.refined is None:
        assert time.monotonic() < end, client.status()
        keep_lit(client)
        displayed |= {s.pattern_crc for s in display(client, 5)}
    result = client.refined
    assert result.captures == 12 and result.text == "all captures are taken"
    assert result.best_psnr_db > result.first_psnr_db + 1
    assert len(displayed - before) >= 6
    # never brighter than what was set; dark where this program paused
    assert all(power == pytest.approx(50, rel=0.02) or power < 50 for _, power in headset.remote.light(began))
    # the best is shown as long as the picture; then the solver shows its own pattern again
    (best,) = {s.pattern_crc for s in display(client, 4)}
    assert best in displayed
    display(client, 2, seed=1)
    assert best not in {s.pattern_crc for s in display(client, 3)}


def test_it_can_be_ended_and_another_program_or_picture_ends_it(headset: Headset, client: Client) -> None:
    client.refine(1000)
    with pytest.raises(RefusedError) as refused:
        client.refine(3)
    assert refused.value.code == Code.BUSY
    display(client, 20)
    display(client, 2, seed=1)
    wait_for_the_end(client)
    assert client.refined is not None and client.refined.text == "its picture is no longer displayed"
    client.refine(1000)
    display(client, 20)
    client.refine(0)
    wait_for_the_end(client)
    with connected(headset.file) as other, pytest.raises(RefusedError) as refused:
        other.refine(3)
    assert refused.value.code == Code.ORDER


def test_it_ends_with_the_solver_and_begins_again(headset: Headset, client: Client) -> None:
    client.refine(1000)
    display(client, 10)
    service = client._link.peer().pid
    for pid in Path(f"/proc/{service}/task/{service}/children").read_text().split():
        if "solver_process" in Path(f"/proc/{pid}/cmdline").read_text():
            os.kill(int(pid), signal.SIGKILL)
    wait_for_the_end(client)
    assert client.refined is not None and "the solver had it" in client.refined.text
    end = time.monotonic() + 15
    while client.status().solver != PartState.FRESH:
        assert time.monotonic() < end
    client.refine(1000)
    display(client, 10)
    client.refine(0)
    wait_for_the_end(client)
    assert client.refined.text == "its picture is no longer displayed"


def test_the_reason_is_given_where_nothing_can_be_refined(tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    with hardware(tmp_path), served(file), connected(file) as client:
        client.show(picture(client))
        refine_once_dark_was_captured(client)
        display(client, 3)
        wait_for_the_end(client)
        assert client.refined is not None and client.refined.captures == 0
        assert "no approximator" in client.refined.text


def refine_once_dark_was_captured(client: Client) -> None:
    """Ask for a refinement until the camera has taken a picture in darkness."""
    end = time.monotonic() + 20
    while True:
        try:
            return client.refine(3)
        except RefusedError as error:
            assert error.code == Code.CAMERA and "darkness" in str(error) and time.monotonic() < end
            time.sleep(0.05)


def wait_for_the_end(client: Client) -> None:
    end = time.monotonic() + 20
    while client.refined is None:
        assert time.monotonic() < end
        list(client.outcomes(0.05))
    assert np.isfinite(client.refined.best_psnr_db)
