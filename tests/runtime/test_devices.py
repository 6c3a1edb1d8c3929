"""`hololoop-runtime devices`: what it finds, and that every trouble comes with what to do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.virtual.remote_hardware import RemoteHardware
from runtime.cli import main
from tests.campaigns.headset import connected, hardware, served, write_configuration

pytestmark = pytest.mark.usefixtures("real_time")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_configuration(tmp_path_factory.mktemp("doctor"))


@pytest.fixture(scope="module")
def remote(file: Path) -> Iterator[RemoteHardware]:
    with hardware(file.parent) as remote:
        yield remote


def asked(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    code = main(["devices", *map(str, words), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert code == (1 if result["problems"] else 0)
    return result


def part(result: dict[str, Any], name: str) -> dict[str, Any]:
    return next(found for found in result["devices"] if found["part"] == name)


def test_a_whole_headset_is_ready_and_dark(
    capsys: pytest.CaptureFixture[str], file: Path, remote: RemoteHardware
) -> None:
    result = asked(capsys, file)
    assert result["ready"] and result["problems"] == 0
    assert [found["part"] for found in result["devices"]] == ["bundle", "panel", "lasers", "camera"]
    assert part(result, "lasers")["status"]["state"] == "off"
    assert remote.light()[-1][1] == 0


def test_every_open_condition_is_named_with_what_to_do(
    capsys: pytest.CaptureFixture[str], file: Path, remote: RemoteHardware
) -> None:
    remote.set_to("interlock", False)
    remote.set_to("key", False)
    try:
        result = asked(capsys, file)
    finally:
        remote.set_to("interlock", True)
        remote.set_to("key", True)
    problems = part(result, "lasers")["problems"]
    assert problems == ["the key is off: turn it on", "the interlock is open: close it"]
    assert not result["ready"]


@pytest.mark.parametrize("name", ["panel", "lasers", "camera"])
def test_a_device_that_is_unplugged_is_told_from_one_that_answers(
    capsys: pytest.CaptureFixture[str], file: Path, remote: RemoteHardware, name: str
) -> None:
    remote.break_part(name, "unplug")
    try:
        result = asked(capsys, file)
    finally:
        remote.repair(name)
    for found in result["devices"]:
        assert found["answers"] == (found["part"] != name)
        assert bool(found["problems"]) == (found["part"] == name)


def test_a_broken_bundle_is_found(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = write_configuration(tmp_path)
    (tmp_path / "bundle" / "bundle.json").write_text("{}")
    result = asked(capsys, file)
    assert not part(result, "bundle")["answers"] and not part(result, "panel")["attached"]


def test_a_service_that_runs_is_asked_and_not_disturbed(
    capsys: pytest.CaptureFixture[str], file: Path, remote: RemoteHardware
) -> None:
    with served(file), connected(file):
        result = asked(capsys, file)
        assert [found["part"] for found in result["devices"]] == ["service"]
        assert part(result, "service")["status"]["solver"] == "fresh"


def test_the_host_alone_is_looked_at_without_a_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    result = asked(capsys)
    assert {found["part"] for found in result["devices"]} == {"usb", "i2c", "camera"}
    assert all(found["answers"] or found["problems"] or not found["attached"] for found in result["devices"])


def test_people_get_a_line_a_device(
    capsys: pytest.CaptureFixture[str], file: Path, remote: RemoteHardware
) -> None:
    assert main(["devices", str(file)]) == 0
    out = capsys.readouterr().out
    assert out.count("ok  ") == 4 and "everything is well" in out
