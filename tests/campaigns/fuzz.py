"""Coverage-guided fuzzing of every parser of bytes in the project: no crash, no hang, no read beyond the message.

    python -m tests.campaigns.fuzz [--seconds N] [--json] [TARGET ...]

Each target takes any bytes and may refuse them with the errors it documents; anything else, a run of
more than five seconds, or two gigabytes is a finding: the run ends with exit code 1 and the input lies in the folder
given by --findings. Needs the extra `fuzz` (atheris).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

Target = Callable[[bytes], None]

LONGEST_S, MOST_MB = 5, 2048
_SCRATCH = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)


def panel_replies() -> Target:
    """Replies of the panel board, as they are and with a right CRC."""
    from firmware_iface.panel.panel_board_messages import (
        parse_fields,
        parse_identity,
        parse_status,
        parse_timing,
        parse_versions,
    )

    def one(data: bytes) -> None:
        for parse in (parse_identity, parse_status, parse_timing, parse_versions, parse_fields):
            for reply in (data, data + zlib.crc32(data).to_bytes(4, "little")):
                with suppress(ValueError):
                    parse(reply)

    return one


def panel_board() -> Target:
    """The board's model: any requests and frames; what it displays is whole and was committed."""
    from firmware_iface.virtual.usb import BoardModel
    from firmware_iface.virtual.usb.usb_model import Nak, Stall

    def one(data: bytes) -> None:
        now = [0.0]
        board = BoardModel((2, 3), clock=lambda: now[0])
        board.control(0, 9, 1, 0, b"", lambda: True)
        while len(data) >= 2:
            what, size, data = data[0], data[1], data[2:]
            part, data = data[:size], data[size:]
            now[0] += 0.01
            with suppress(Stall, Nak):
                if what < 128:
                    board.write(1, part, lambda: True)
                else:
                    board.control(0x40, what & 7, size, 0, part, lambda: True)
        now[0] += 1
        board.control(0x40, 2, 1, 0, b"", lambda: True)
        pixels = board.gray.tobytes()
        assert zlib.crc32(pixels) == board.shown[-1][1] if board.shown else not any(pixels)

    return one


def modulator_answers() -> Target:
    """Answers of the DLPC900."""
    from firmware_iface.panel.dlpc900_commands import parse_answer

    def one(data: bytes) -> None:
        with suppress(ValueError):
            _, _, answer = parse_answer(data)
            assert answer == data[4 : 4 + len(answer)]

    return one


def modulator_model() -> Target:
    """The DLPC900's model: any packets, any compressed images."""
    import numpy as np

    from firmware_iface.panel import run_length_encoding
    from firmware_iface.virtual.usb import Dlpc900Model
    from firmware_iface.virtual.usb.run_length_decoding import CommandError, decode_image

    header = run_length_encoding.encode(np.zeros((2, 3), np.uint32))[: run_length_encoding.HEADER_BYTES]

    def one(data: bytes) -> None:
        with suppress(CommandError):
            assert decode_image(header + data, 2, 3).shape == (2, 3)
        model = Dlpc900Model((4, 6))
        model.control(0, 9, 1, 0, b"", lambda: True)
        for at in range(0, len(data), 64):
            model.write(1, data[at : at + 64], lambda: True)
        assert model.gray.shape == (2, 3)

    return one


def camera_messages() -> Target:
    """What the camera's process sends, cut anywhere, and the pictures in it."""
    from firmware_iface.camera.pixel_unpacking import unpack
    from firmware_iface.camera.process_messages import Frame, Messages

    def one(data: bytes) -> None:
        parser = Messages()
        step = 1 + (data[0] if data else 0)
        with suppress(ValueError):
            for at in range(0, len(data), step):
                for message in parser.feed(data[at : at + step]):
                    if isinstance(message, Frame):
                        f = message
                        unpack(f.data, "raw10", f.height, f.width, f.stride)

    return one


def camera_pixels() -> Target:
    """Packed pixels under any geometry."""
    from firmware_iface.camera.pixel_unpacking import unpack

    def one(data: bytes) -> None:
        if len(data) < 4:
            return
        encoding = "raw10" if data[0] & 1 else "gray8"
        with suppress(ValueError):
            counts = unpack(data[4:], encoding, data[1], data[2], data[3])
            assert counts.shape == (data[1], data[2]) and counts.max() < 1024

    return one


def camera_link() -> Target:
    """libnop values, as the emulated camera reads them from the host."""
    from firmware_iface.virtual.oak import libnop

    def one(data: bytes) -> None:
        with suppress(ValueError):
            libnop.decode(data)

    return one


def laser_dac() -> Target:
    """The DAC's read-out."""
    from firmware_iface.errors import DeviceError
    from firmware_iface.lasers.mcp4728 import decode

    def one(data: bytes) -> None:
        with suppress(DeviceError):
            now, later = decode(data)
            assert len(now) == len(later) == 4

    return one


def laser_board() -> Target:
    """The laser board's parts: any messages on the bus; without key and interlock there is never light."""
    from firmware_iface.virtual.i2c import LaserBoard, Message

    addresses = (0x00, 0x20, 0x36, 0x48, 0x49, 0x60)

    def one(data: bytes) -> None:
        board = LaserBoard(clock=lambda: 0.0)
        while len(data) >= 2:
            what, size, data = data[0], data[1] % 33, data[2:]
            part, data = data[:size], data[size:]
            read = what & 0x80 > 0
            message = Message(addresses[what % len(addresses)], None if read else part, size)
            with suppress(OSError):
                board.bus.transfer([message])
        assert not any(board.emitted_uw.values())

    return one


def service_messages() -> Target:
    """Messages of clients and of the service's own processes."""
    from runtime.service.message_format import ProtocolError
    from runtime.service.process_messages import CAMERA, SOLVER
    from runtime.service.protocol import PROTOCOL

    def one(data: bytes) -> None:
        for vocabulary in (PROTOCOL, SOLVER, CAMERA):
            with suppress(ProtocolError):
                serial, message = vocabulary.unpack(data)
                assert len(vocabulary.pack(message, serial)) == len(data)

    return one


def bundles() -> Target:
    """A bundle's manifest and its arrays, also where the hashes are right."""
    from firmware_iface.errors import InputError
    from runtime.bundle import bundle_folder as bundle

    folder = Path(_SCRATCH.name)

    def manifest(data: bytes) -> bytes:
        body = {
            "format": bundle.FORMAT,
            "version": bundle.VERSION,
            "files": {bundle.ARRAYS: hashlib.sha256(data).hexdigest()},
            "description": {},
            "provenance": {},
        }
        body["sha256"] = bundle._manifest_hash(body)
        return json.dumps(body).encode()

    def one(data: bytes) -> None:
        (folder / bundle.ARRAYS).write_bytes(data)
        for text in (data, manifest(data)):
            (folder / bundle.MANIFEST).write_bytes(text)
            with suppress(InputError):
                bundle.read_bundle(folder)

    return one


def capture_sets() -> Target:
    """bench.toml and captures.csv: the bytes are one, then the other."""
    from firmware_iface.errors import InputError
    from trainer.captures.capture_set import read_captures

    folder = Path(_SCRATCH.name)

    def one(data: bytes) -> None:
        bench, _, table = data.partition(b"\n\0\n")
        (folder / "bench.toml").write_bytes(bench)
        (folder / "captures.csv").write_bytes(table)
        with suppress(InputError):
            read_captures(folder)

    return one


TARGETS = {
    target.__name__: target
    for target in (
        panel_replies,
        panel_board,
        modulator_answers,
        modulator_model,
        camera_messages,
        camera_pixels,
        camera_link,
        laser_dac,
        laser_board,
        service_messages,
        bundles,
        capture_sets,
    )
}


def fuzz(name: str, options: list[str]) -> None:
    """Fuzz one target in this process until libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=["firmware_iface", "runtime", "trainer"]):
        target = TARGETS[name]()
    atheris.Setup([sys.argv[0], *options], target)
    atheris.Fuzz()


def run(name: str, seconds: int, findings: Path) -> dict[str, object]:
    """Fuzz one target in a process of its own; how many inputs it took, and what was found."""
    options = [
        f"-max_total_time={seconds}",
        f"-timeout={LONGEST_S}",
        f"-rss_limit_mb={MOST_MB}",
        "-max_len=1024",
        f"-artifact_prefix={findings}/{name}-",
        "-print_final_stats=1",
    ]
    command = [sys.executable, "-m", "tests.campaigns.fuzz", "--one", name, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, errors="replace")
    inputs = [line.split()[-1] for line in done.stderr.splitlines() if "number_of_executed_units" in line]
    found = "" if done.returncode == 0 else done.stdout[-2000:] + done.stderr[-2000:]
    return {"target": name, "inputs": int(inputs[0]) if inputs else 0, "finding": found}


def main() -> int:
    """Fuzz the targets named, or all of them."""
    if sys.argv[1:2] == ["--one"]:
        fuzz(sys.argv[2], sys.argv[3:])
        return 0
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.fuzz", description=__doc__.split("\n")[0]
    )
    parser.add_argument("targets", metavar="TARGET", nargs="*", help=", ".join(TARGETS))
    parser.add_argument("--seconds", type=int, default=20, help="for each target (default 20)")
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"), help="folder for inputs")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    args = parser.parse_args()
    if unknown := [name for name in args.targets if name not in TARGETS]:
        parser.error(f"there is no target '{unknown[0]}'; known are {', '.join(TARGETS)}")
    try:
        import atheris  # noqa: F401
    except ImportError:
        parser.error("atheris is not installed; install hololoop with the extra 'fuzz'")
    args.findings.mkdir(exist_ok=True)
    results = []
    for name in args.targets or TARGETS:
        results.append(run(name, args.seconds, args.findings))
        if not args.json:
            last = results[-1]
            print(f"{name:20} {last['inputs']:>9} inputs  {'FOUND' if last['finding'] else 'nothing found'}")
            print(last["finding"], end="")
    if not any(args.findings.iterdir()):
        shutil.rmtree(args.findings)
    found = sum(bool(result["finding"]) for result in results)
    if args.json:
        print(json.dumps({"seconds": args.seconds, "targets": results, "findings": found}))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
