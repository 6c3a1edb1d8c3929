"""`hololoop-runtime`: the headset's commands.

Exit codes: 0 done; 2 the input cannot be used (one line on stderr says what to change); 130 interrupted.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from firmware_iface.errors import DeviceError, InputError, nearest
from runtime import doctor, showing, solving
from runtime.benchmark import command as benchmark
from runtime.calibration import command as calibration
from runtime.refinement import command as refinement
from runtime.service import command as service

PROGRAM = "hololoop-runtime"
DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130

ABOUT = """Compute the patterns that look right through a calibrated bench.

The usual way:
  hololoop-runtime solve bundle/ picture.png --out pattern.png
  hololoop-runtime show pattern.png --headset headset.toml --out seen/

A bundle comes from the workstation: hololoop-trainer export --model model.toml --out bundle/"""

# Each command's module says what it is about, declares its arguments, runs, and shows what came out.
COMMANDS: dict[str, tuple[ModuleType, str]] = {
    "solve": (solving, "compute the pattern for each picture"),
    "show": (showing, "show patterns on a headset and save what its camera sees"),
    "serve": (service, "run the headset's service"),
    "calibrate": (calibration, "find what has drifted and put it into the bundle"),
    "refine": (refinement, "make a picture better while a camera looks at it"),
    "devices": (doctor, "say what is attached, what is wrong and what to do"),
    "benchmark": (benchmark, "measure the solver on this machine"),
}


class _Parser(ArgumentParser):
    """A parser whose errors are InputErrors of one sentence."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{' '.join(message.split())}; see: {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        return _main(sys.argv[1:] if argv is None else list(argv))
    except (DeviceError, InputError) as error:
        return _stopped(str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return _stopped("interrupted; what was finished is there, and nothing is half written", INTERRUPTED)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _stopped(f"{where}{error.strerror or error}", BAD_INPUT)
    except MemoryError:
        return _stopped("there is not enough memory for this bundle: use a machine with more", BAD_INPUT)


def _stopped(message: str, code: int) -> int:
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr)
    return code


def _main(argv: list[str]) -> int:
    parser = _parser()
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:
        raise InputError(f"there is no command '{argv[0][:60]}': {nearest(argv[0], COMMANDS)}")
    try:
        args = parser.parse_args(argv)
    except SystemExit as stop:  # --help has printed
        return int(stop.code or 0)
    if args.version:
        from importlib.metadata import version

        print(version("hololoop"))
        return DONE
    if args.command is None:
        parser.print_help()
        return BAD_INPUT if argv else DONE
    command, _ = COMMANDS[args.command]
    result = command.run(args)
    if args.json:
        print(json.dumps(result, allow_nan=False))
    else:
        command.show(result)
    return DONE


def _parser() -> ArgumentParser:
    parser = _Parser(prog=PROGRAM, description=ABOUT, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parts = parser.add_subparsers(metavar="COMMAND", dest="command", title="commands", parser_class=_Parser)
    for name, (command, about) in COMMANDS.items():
        one = parts.add_parser(
            name,
            help=about,
            description=command.ABOUT,
            formatter_class=RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        command.arguments(one)
        one.add_argument(
            "--json", action="store_true", help="print one JSON object on stdout and nothing else"
        )
    return parser


if __name__ == "__main__":
    sys.exit(main())
