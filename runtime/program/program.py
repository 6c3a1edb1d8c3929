"""A program with commands: runs one, prints its result, and turns what goes wrong into one line and an exit code.

Exit codes: 0 done; 1 what was examined has faults (check, devices); 2 the input cannot be used (one line on stderr
says what to change); 130 interrupted; 141 whoever read stdout has closed it.
"""

from __future__ import annotations

import io
import os
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass

from firmware_iface.errors import DeviceError, InputError
from runtime.program.command import Command, Result
from runtime.program.completion import complete
from runtime.program.csv_tables import write_tables
from runtime.program.interrupt import Interrupted
from runtime.program.large_blocks import keep_large_blocks
from runtime.program.log_file import Log, open_log
from runtime.program.outputs import check_outputs, files_written
from runtime.program.parser import ProgramParser
from runtime.program.screen import Screen, one_line
from runtime.program.threads import share_cores
from runtime.program.version import installed_version

DONE, PROBLEMS, BAD_INPUT, INTERRUPTED, NO_READER = 0, 1, 2, 130, 141
OWN_PACKAGES = ("trainer", "runtime", "firmware_iface")


@dataclass(frozen=True)
class Program:
    """A program with commands.

    Attributes
    ----------
    name : str
        What a person types.
    about : str
        What its help says first.
    commands : tuple of Command
        In the order in which they are used.
    package : str
        What pip installs so that every command works.
    """

    name: str
    about: str
    commands: tuple[Command, ...]
    package: str

    def parser(self) -> ProgramParser:
        """The parser of all commands."""
        return ProgramParser(self.name, self.about, self.commands)

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run one command.

        Parameters
        ----------
        arguments : sequence of str
            The command line without the program; by default the process's own.

        Returns
        -------
        int
            The exit code.
        """
        share_cores()
        keep_large_blocks()
        try:
            return self._main(list(sys.argv[1:] if arguments is None else arguments))
        except _NoReader:
            return NO_READER
        except (DeviceError, InputError) as error:
            return self._stopped(str(error), BAD_INPUT)
        except Interrupted as stop:
            return self._stopped(str(stop), INTERRUPTED)
        except KeyboardInterrupt:
            return self._stopped(
                "interrupted; what was finished is kept, and nothing is half written", INTERRUPTED
            )
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            return self._stopped(f"{where}{error.strerror or error}", BAD_INPUT)
        except ModuleNotFoundError as error:
            if error.name is None or error.name.split(".")[0] in OWN_PACKAGES:
                raise
            line = f"pip install '{self.package}'"
            return self._stopped(f"{error.name} is not installed; get it with: {line}", BAD_INPUT)
        except MemoryError:
            return self._stopped(
                "there is not enough memory: give it less to do at a time, or use a machine with more",
                BAD_INPUT,
            )

    def _main(self, arguments: list[str]) -> int:
        parser = self.parser()
        complete(parser)
        with _output():
            try:
                args = parser.parse(arguments)
            except SystemExit as stop:  # the help has been printed
                return int(stop.code or 0)
            if args.version:
                print(f"{self.name} {installed_version()}")
                return DONE
            if args.command is None:
                parser.whole.print_help()
                return BAD_INPUT if arguments else DONE
        return run(args.chosen, args)

    def _stopped(self, sentence: str, code: int) -> int:
        # Where Ctrl-C fell into code that is made from text, as a dataclass's is, `python -m` ends by the signal
        # instead of this exit code, whatever was done about it. The next such code takes that back.
        exec("")
        with suppress(OSError, ValueError):
            print(f"{self.name}: {one_line(sentence)}", file=sys.stderr)
        return code


def run(command: Command, args: Namespace) -> int:
    """Check a command's outputs, run it and print its result; returns the exit code."""
    check_outputs([*command.outputs(args), *files_written(csv=args.csv)], args)
    with open_log(args.log_file) as log:
        log(f"{command.name}: begins")
        try:
            code = _run(command, args, log)
        except BaseException as error:
            log(f"{command.name}: stopped by {type(error).__name__}: {error}")
            raise
        log(f"{command.name}: ends with exit code {code}")
    return code


def _run(command: Command, args: Namespace, log: Log) -> int:
    screen = Screen(log=log, quiet=args.quiet, verbose=args.verbose)
    with redirect_stdout(sys.stderr):  # what a library prints is not the command's output
        result = command.run(args, screen)
    with _output():
        if args.json:
            screen.json(result)
        else:
            command.show(result, args, screen)
        screen.out.flush()
    if args.csv is not None:
        _write_csv(command, result, args, screen)
    return PROBLEMS if command.problems(result) else DONE


def _write_csv(command: Command, result: Result, args: Namespace, screen: Screen) -> None:
    """Write the tables that were printed, or that would have been without --json."""
    printed = screen
    if args.json:
        printed = Screen(out=io.StringIO(), err=io.StringIO())
        command.show(result, args, printed)
    if printed.tables:
        write_tables(args.csv, printed.tables)
    else:
        screen.note(f"{command.name} printed no table: {args.csv} was not written")


class _NoReader(Exception):
    """Nobody reads stdout any more."""


@contextmanager
def _output() -> Iterator[None]:
    """A block that writes to stdout: what stdout's encoding lacks is replaced, and all is written at its end.

    Raises
    ------
    _NoReader
        Where whoever read stdout has closed it.
    """
    with suppress(AttributeError, ValueError):
        sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        with suppress(
            OSError, ValueError, AttributeError
        ):  # what is still buffered goes nowhere, without a message
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
        raise _NoReader from None
