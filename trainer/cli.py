"""`hololoop-trainer`: learn how a bench differs from its model.

Exit codes: 0 done; 2 the input cannot be used (one line on stderr says what to change); 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from typing import NoReturn

from firmware_iface.errors import DeviceError, InputError, nearest
from trainer.commands import explaining, looping, making, registering, starting, training
from trainer.commands.command import PROGRAM, Command, Interrupted, release
from trainer.commands.screen import Screen, one_line

OWN = ("trainer", "runtime", "firmware_iface")
DONE, BAD_INPUT, INTERRUPTED, NO_READER = 0, 2, 130, 141

ABOUT = """Learn how a holographic display's bench differs from its model, from camera captures.

The usual way:
  hololoop-trainer check captures/                        is the capture set sound?
  hololoop-trainer compare captures/                      how far off is the ideal model, and where?
  hololoop-trainer explain captures/ --out model.toml     what is missing, effect after effect
  hololoop-trainer field captures/ --model model.toml --out learned.toml     stripes, dust: the wave at the panel
  hololoop-trainer train captures/ --model model.toml --out run/     a network for what has no name
  hololoop-trainer export --model model.toml --out bundle/

Without captures at hand, start with: hololoop-trainer demo --quick"""


class _Parser(ArgumentParser):
    """A parser whose errors are InputErrors of one sentence."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{one_line(message)}; see: {self.prog} --help")


def commands() -> list[Command]:
    """All commands, in the order in which they are used."""
    parts = (explaining, training, looping, making, starting, registering)
    return [command for part in parts for command in part.commands()]


def parser_of(known: Sequence[Command]) -> ArgumentParser:
    """The parser of all commands."""
    parser = _Parser(
        prog=PROGRAM, description=ABOUT, formatter_class=RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parts = parser.add_subparsers(metavar="COMMAND", dest="command", title="commands", parser_class=_Parser)
    for command in known:
        text = f"{command.about}\n\nexample:\n  {PROGRAM} {command.example}\n\nnext:\n  {command.after}"
        one = parts.add_parser(
            command.name,
            help=command.about,
            description=text,
            allow_abbrev=False,
            formatter_class=RawDescriptionHelpFormatter,
        )
        one.add_argument(
            "--json", action="store_true", help="print one JSON object on stdout and nothing else there"
        )
        command.options(one)
        one.set_defaults(chosen=command)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs one command and returns its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    try:
        with _no_reader():
            return _main(arguments)
    except _NoReader:
        return NO_READER
    except (DeviceError, InputError) as error:
        return _stopped(str(error), BAD_INPUT)
    except Interrupted as stop:
        return _stopped(str(stop), INTERRUPTED)
    except KeyboardInterrupt:
        return _stopped("interrupted; nothing was written", INTERRUPTED)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _stopped(f"{where}{error.strerror or error}", BAD_INPUT)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in OWN:
            raise
        return _stopped(
            f"{error.name} is not installed; get it with: pip install 'hololoop[trainer]'", BAD_INPUT
        )
    except MemoryError:
        return _stopped("there is not enough memory: use fewer --workers, or smaller captures", BAD_INPUT)


def _main(arguments: Sequence[str]) -> int:
    known = commands()
    words = [a for a in arguments[:1] if not a.startswith("-")]
    names = [c.name for c in known]
    if words and words[0] not in names:
        raise InputError(f"there is no command '{words[0][:60]}': {nearest(words[0], names)}")
    parser = parser_of(known)
    try:
        args, rest = parser.parse_known_args(arguments)
    except SystemExit as stop:  # --help has printed
        sys.stdout.flush()
        return int(stop.code or 0)
    if args.version:
        print(f"{PROGRAM} {release()}")
        return DONE
    if args.command is None:
        parser.print_help()
        sys.stdout.flush()
        return DONE if not arguments else BAD_INPUT
    if rest:
        raise InputError(_unknown(rest, args, parser))
    return run(args.chosen, args)


def run(command: Command, args: Namespace) -> int:
    """Runs a command and prints what it found."""
    screen = Screen()
    with redirect_stdout(sys.stderr):  # what a library prints is not the command's output
        result = command.run(args, screen)
    if args.json:
        screen.json(result)
    else:
        with suppress(AttributeError, ValueError):
            screen.out.reconfigure(errors="replace")  # type: ignore[union-attr]
        command.show(result, args, screen)
    screen.out.flush()
    return DONE


def _unknown(rest: Sequence[str], args: Namespace, parser: ArgumentParser) -> str:
    """What to say of arguments that no option takes."""
    word = rest[0].split("=")[0]
    where = f"see: {PROGRAM} {args.command} --help"
    if not word.startswith("-"):
        return f"'{word[:60]}' is one argument too many for {args.command}; {where}"
    parts = next(a for a in parser._actions if a.dest == "command")
    options = [o for o in parts.choices[args.command]._option_string_actions if o.startswith("--")]  # type: ignore[index]
    return f"{args.command} has no option {word[:60]}: {nearest(word, options)}"


class _NoReader(Exception):
    """Whoever reads stdout has gone."""


@contextmanager
def _no_reader() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        with suppress(OSError, ValueError, AttributeError):  # what is still buffered goes nowhere, quietly
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
        raise _NoReader from None


def _stopped(sentence: str, code: int) -> int:
    with suppress(OSError, ValueError):
        print(f"{PROGRAM}: {one_line(sentence)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
