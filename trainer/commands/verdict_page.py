"""What diagnose and explain both show: the verdict, captures that would tell more, and what to do next."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import Any

from runtime.program.command import Result
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import ONE_PATTERN

STYLES = {"complete": "bold green", "missing": "bold yellow", "outside_catalogue": "bold magenta"}


def say_verdict(result: Result, sentence: str, screen: Screen) -> None:
    """The verdict's sentence, in its colour, and where nothing was held out, that."""
    verdict = result["verdict"]
    screen.say(sentence or f"The verdict is {verdict}.", style=STYLES.get(verdict, "bold"))
    if not result.get("held_out", True):
        screen.say(ONE_PATTERN, style="yellow")


def say_suggested(result: Result, screen: Screen) -> None:
    """Captures that would tell more."""
    suggestions = list(dict.fromkeys(result.get("suggested_captures") or []))
    if suggestions:
        screen.say("\nCaptures that would tell more:")
        for line in suggestions:
            screen.say(
                f"  - {line if isinstance(line, str) else ', '.join(f'{k} {v}' for k, v in line.items())}"
            )


def then_export(model: Path | None, args: Namespace, screen: Screen) -> None:
    """The command that gives the model to the headset."""
    if model is None:
        screen.say("\nThe bench's ideal model is enough; there is nothing to put in.")
    else:
        screen.next(
            command_line("export", "--out", "bundle", args=args, model=model), "Give the model to the headset"
        )


def then_propose(model: Path | None, args: Namespace, screen: Screen) -> None:
    """The command that writes effect files for what is in no catalogue."""
    line = command_line("propose", args.captures, "--out", "proposals", args=args, model=model)
    screen.next(line, "Have effect files written for what the probes show")


def then_write_or_learn(stage: Any, model: Path | None, args: Namespace, screen: Screen) -> None:
    """The commands for what is in no catalogue: an effect of one's own, a learned field, a network."""
    stage = stage if stage in ("drive", "panel", "pupil", "sensor") else "panel"
    screen.next(
        command_line("new-effect", "my_effect", "--stage", stage),
        f"Look at the picture of the {stage}'s probe (--report), and write the effect that it shows",
    )
    if stage == "panel":
        line = command_line("field", args.captures, "--out", "learned.toml", args=args, model=model)
        screen.next(line, "Or let the wave at the panel be learned, without a name")
    else:
        line = command_line("train", args.captures, "--out", "run", args=args, model=model)
        screen.next(line, "Or let a network learn what it can of it, without a name")
