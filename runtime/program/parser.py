"""The parser of a program's arguments: a bad one is an InputError of one sentence, with the nearest known name."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Sequence
from typing import Any, NoReturn

from firmware_iface.errors import InputError, nearest
from runtime.program.command import Command
from runtime.program.outputs import overwrite_option
from runtime.program.screen import one_line
from runtime.program.screen_options import option_names, screen_options

HELP = "help"  # as a command word


class SentenceParser(ArgumentParser):
    """An argument parser whose errors are InputErrors of one sentence."""

    def error(self, message: str) -> NoReturn:
        """Raise the InputError."""
        raise InputError(f"{one_line(message)}; see: {self.prog} --help")

    def print_help(self, file: Any = None) -> None:
        """Print the help; unlike argparse's own, a closed stdout is not passed over in silence."""
        print(self.format_help(), end="", file=file)


class ProgramParser:
    """The parser of a program and of each of its commands.

    Parameters
    ----------
    program : str
        Name of the program.
    about : str
        What its help says first.
    commands : sequence of Command
        In the order in which they are listed.
    """

    def __init__(self, program: str, about: str, commands: Sequence[Command]) -> None:
        layout = RawDescriptionHelpFormatter
        self.program = program
        self.whole = SentenceParser(
            prog=program, description=about, formatter_class=layout, allow_abbrev=False
        )
        self.whole.add_argument("--version", action="store_true", help="print the version and stop")
        parts = self.whole.add_subparsers(
            metavar="COMMAND", dest="command", title="commands", parser_class=SentenceParser
        )
        self.commands: dict[str, SentenceParser] = {}
        for command in commands:
            one = parts.add_parser(
                command.name,
                help=command.about,
                description=command.help_text(program),
                formatter_class=layout,
                allow_abbrev=False,
            )
            command.options(one)
            overwrite_option(one)
            screen_options(one)
            one.set_defaults(chosen=command)
            self.commands[command.name] = one

    def parse(self, arguments: Sequence[str]) -> Namespace:
        """Read a command line.

        Returns
        -------
        Namespace
            With `version`, `command` (None where there is none) and `chosen`, its Command.

        Raises
        ------
        InputError
            For a command, an option or an argument that is not known, and for a value that cannot be used.
        SystemExit
            After the help has been printed.
        """
        words = help_as_option(arguments)
        if words and not words[0].startswith("-") and words[0] not in self.commands:
            names = [*self.commands, HELP]
            raise InputError(f"there is no command '{words[0][:60]}': {nearest(words[0], names)}")
        try:
            args, rest = self.whole.parse_known_args(words)
        except InputError:
            if words and words[0] in self.commands and (unknown := self._unknown_option(words)):
                raise InputError(
                    unknown
                ) from None  # more often the reason than what the parser misses for it
            raise
        if rest:
            raise InputError(self._unknown(rest[0], args.command))
        return args

    def _unknown_option(self, words: Sequence[str]) -> str:
        """What to say of the first option of a command's line that the command does not have; else nothing."""
        options = option_names(self.commands[words[0]])
        before_end = words[1 : words.index("--")] if "--" in words else words[1:]
        names = [word.split("=")[0] for word in before_end if word.startswith("--")]
        unknown = [name for name in names if name not in options]
        return self._unknown(unknown[0], words[0]) if unknown else ""

    def _unknown(self, word: str, command: str | None) -> str:
        """What to say of an argument that nothing takes."""
        if not word.startswith("-"):
            line = f"{self.program} {command} --help"
            return f"'{word[:60]}' is one argument too many for {command}; see: {line}"
        name = word.split("=")[0]
        parser = self.commands[command] if command else self.whole
        return f"{command or self.program} has no option {name[:60]}: {nearest(name, option_names(parser))}"


def help_as_option(arguments: Sequence[str]) -> list[str]:
    """`help` as --help, and `help COMMAND` as COMMAND --help."""
    if arguments and arguments[0] == HELP:
        return [*arguments[1:2], "--help"]
    return list(arguments)
