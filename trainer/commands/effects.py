"""`hololoop-trainer effects`: the effects that can be found."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from runtime.program.command import Command, Result
from runtime.program.plain_values import plain
from runtime.program.screen import Screen
from trainer.commands.command_line import command_line
from trainer.commands.inputs import effects_option

if TYPE_CHECKING:
    from trainer.effects.definition import Effect

COLOURS = {
    "alike": "On a bench of several colours, one value serves all.",
    "apart": "On a bench of several colours, each has its own values.",
    "either": "On a bench of several colours, one value serves all, or each has its own where captures say so.",
}


def options(parser: ArgumentParser) -> None:
    """The options of `effects`."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="one effect: show its parameters")
    effects_option(parser)


def run(args: Namespace, screen: Screen) -> Result:
    """The catalogue, or one effect of it."""
    from trainer.effects.effect_catalogue import catalogue, find_effect

    known = catalogue(args.effects)
    chosen = [find_effect(known, args.name)] if args.name else list(known.values())
    return {"effects": [_described(e) for e in chosen]}


def _described(effect: Effect) -> Result:
    from trainer.effects.effect_catalogue import BUILT_IN

    return {
        "name": effect.name,
        "stage": effect.stage,
        "acts_on": effect.acts_on,
        "about": effect.about,
        "description": effect.description,
        "formula": effect.formula,
        "references": list(effect.references),
        "orders": list(effect.orders),
        "colours": "apart" if all(p.per_channel for p in effect.parameters) else effect.colours,
        "source": "built in" if effect in BUILT_IN else effect.source,
        "parameters": [
            {
                "name": p.name,
                "key": p.key,
                "unit": p.unit,
                "low": p.low,
                "high": p.high,
                "about": p.about,
                "per_channel": p.per_channel,
                "terms": [p.count(o) if callable(p.count) else p.count for o in effect.orders],
            }
            for p in effect.parameters
        ],
    }


def show(result: Result, args: Namespace, screen: Screen) -> None:
    """A table of all, or everything about one."""
    if not args.name:
        screen.table(
            ("effect", "stage", "acts on", "what it is"),
            [(e["name"], e["stage"], e["acts_on"], e["about"]) for e in result["effects"]],
        )
        screen.next(command_line("effects", "zero_order"), "More on one of them")
        return
    one = result["effects"][0]
    screen.say(f"{one['name']}: {one['about']}", style="bold")
    screen.say(f"Stage {one['stage']}, acts on the {one['acts_on']}, {one['source']}.")
    screen.say(COLOURS[one["colours"]])
    for text in (one["description"], one["formula"], *one["references"]):
        if text:
            screen.say(text)
    rows = []
    for p in one["parameters"]:
        low, high = plain(p["low"]), plain(p["high"])
        count = " or ".join(str(t) for t in dict.fromkeys(p["terms"])) if any(p["terms"]) else "1"
        count += " a channel" if p["per_channel"] or one["colours"] == "apart" else ""
        rows.append((p["name"], p["unit"], low, high, count, p["about"]))
    screen.table(("parameter", "unit", "lowest", "highest", "numbers", "what it is"), rows)
    screen.next(command_line("add", one["name"], "captures/", "--out", f"with_{one['name']}.toml", args=args))


COMMAND = Command(
    name="effects",
    about="List the effects that can be found, or show one.",
    options=options,
    run=run,
    show=show,
    examples=("effects zero_order",),
    after="Look for them in captures: diagnose captures/",
)
