"""What check, compare, diagnose, add and explain found, for a person: the verdict first, then what to type
next.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trainer.commands.command import Result, command_line
from trainer.commands.screen import Screen
from trainer.formatting import listed, parameters

MOST_ROWS = 12


def show_check(result: Result, args: Namespace, screen: Screen) -> None:
    """Problems, errors first."""
    problems = sorted(result["problems"], key=lambda p: p["severity"] != "error")
    errors = sum(p["severity"] == "error" for p in problems)
    count = result["captures"]
    if not problems:
        screen.say(f"{count} captures, and nothing is wrong with them.", style="green")
    else:
        screen.say(
            f"{count} captures, {_plural(errors, 'error')} and {_plural(len(problems) - errors, 'warning')}.",
            style="red" if errors else "yellow",
        )
        screen.table(
            ("", "kind", "capture", "what to change"),
            [(p["severity"], p["kind"], p["capture"], p["message"]) for p in problems],
        )
    if errors:
        screen.next(command_line("check", args.captures), "Mend the errors, and check again")
    else:
        screen.next(command_line("compare", args.captures))


def show_comparison(result: Result, args: Namespace, screen: Screen) -> None:
    """The error in one sentence, then by channel and by capture."""
    held = result["heldout"]
    screen.say(
        f"On captures that no fit saw, the model's error is {_percent(held['nrmse'])} of the signal's "
        f"contrast; the camera's noise alone would be {_percent(held['noise_nrmse'])}; "
        f"the excess is {_small(held['excess'])}.",
        style="bold",
    )
    if result.get("psnr_db") is not None:
        screen.say(f"Peak signal to noise: {result['psnr_db']:.1f} dB (peak: full scale; no free scale).")
    if result.get("budget"):
        _budget(result["budget"], screen)
    _numbers("channel", result.get("by_channel"), screen)
    rows = result.get("by_capture") or []
    rows = sorted(rows, key=lambda r: -(r.get("excess") or 0))
    shown = rows[:MOST_ROWS]
    title = (
        "worst captures first" if len(rows) <= MOST_ROWS else f"the worst {MOST_ROWS} of {len(rows)} captures"
    )
    keys = ("capture", "channel", "plane_mm", "nrmse", "noise_nrmse", "excess", "gain")
    screen.table(keys, [[r.get(k) for k in keys] for r in shown], title)
    if args.report:
        screen.say(f"\nThe report, with maps of where the error is, is {args.report}.")
    screen.next(command_line("diagnose", args.captures, args=args, model=args.model))


def _budget(budget: Mapping[str, float], screen: Screen) -> None:
    """The ideal model's error, and what becomes of each part of it."""
    words = {
        "named_physics": "named physics explains",
        "network": "what was learned explains beyond that",
        "noise": "the camera's noise",
        "unexplained": "unexplained",
    }
    total = sum(budget.values())
    rows = [
        (words[name], value, f"{100 * value / total:.3g} %")
        for name, value in budget.items()
        if name != "network" or value  # nothing was learned: nothing to say
    ]
    screen.table(("the ideal model's error", "share of the signal's variance", "of the error"), rows)


def show_diagnosis(result: Result, args: Namespace, screen: Screen) -> None:
    """The verdict, the stages, the ranking, and the command that does something about it."""
    _verdict(result["verdict"], str(result.get("sentence", "")), screen)
    stages = sorted(result.get("stages") or [], key=lambda s: -s["excess_removed"])
    screen.table(
        ("stage", "excess its free-form probe removes"), [(s["stage"], s["excess_removed"]) for s in stages]
    )
    ranking = result.get("ranking") or []
    screen.table(
        ("effect", "stage", "excess removed", "95 % interval", "excess after", "size"),
        [
            (
                r["effect"],
                r["stage"],
                r["excess_removed"],
                "{:.2g} to {:.2g}".format(*r["ci95"]),
                r["excess_after"],
                _sizes(r["parameters"], 3),
            )
            for r in ranking[:MOST_ROWS]
        ],
    )
    _suggested(result, screen)
    _thresholds(result, screen)
    if args.report:
        screen.say(f"\nThe report, with pictures of what each stage lacks, is {args.report}.")
    if result["verdict"] == "missing" and ranking:
        name = ranking[0]["effect"]
        out = f"with_{name}.toml"
        screen.next(command_line("add", name, args.captures, "--out", out, args=args, model=args.model))
    elif result["verdict"] == "complete":
        _export(args.model, args, screen)
    else:
        _write_your_own_or_learn(result.get("stage"), args.model, args, screen)


def show_addition(result: Result, args: Namespace, screen: Screen) -> None:
    """What was gained, and the effect's size."""
    before, after = result["before"], result["after"]
    size = _sizes(result["parameters"])
    worse = (
        after["excess"] is not None and before["excess"] is not None and after["excess"] >= before["excess"]
    )
    gained = "which is no gain: leave it out" if worse else f"from {_small(before['excess'])}"
    screen.say(
        f"With {args.effect} ({size}), "
        f"the excess on held-out captures is {_small(after['excess'])}, {gained}.",
        style="yellow" if worse else "bold",
    )
    screen.table(
        ("", "nrmse", "noise_nrmse", "excess"),
        [
            (when, e["nrmse"], e["noise_nrmse"], e["excess"])
            for when, e in (("before", before), ("after", after))
        ],
    )
    screen.say(f"\nThe model is {args.out}.")
    screen.next(command_line("diagnose", args.captures, args=args, model=args.model if worse else args.out))


def _sizes(found: Result, most: int | None = None) -> str:
    return "; ".join(f"{p.name} {p.text}" for p in parameters(found)[:most])


def show_explanation(result: Result, args: Namespace, screen: Screen) -> None:
    """The ladder of effects, the verdict, and what comes next."""
    _verdict(result["verdict"], _explained(result), screen)
    rows = []
    first = args.model.name if args.model else "ideal model"
    for step in result["steps"]:
        what = step["added"] or (f"without {step['removed']}" if step.get("removed") else first)
        also = ", ".join(step["indistinguishable_from"]) or ""
        rows.append((what, step["nrmse"], step["excess"], also))
    screen.table(("added", "nrmse", "excess", "not told apart from"), rows)
    screen.say(f"\nThe camera's noise alone: nrmse {result['noise_nrmse']:.4g}.")
    _suggested(result, screen)
    screen.say(f"\nThe model is {args.out}." + (f" The report is {args.report}." if args.report else ""))
    if result["verdict"] == "complete":
        _export(args.out, args, screen)
    elif result["verdict"] == "outside_catalogue":
        _write_your_own_or_learn(result.get("stage"), args.out, args, screen)
    else:
        screen.next(command_line("diagnose", args.captures, args=args, model=args.out))


def _explained(result: Result) -> str:
    steps = result["steps"]
    added = [s["added"] for s in steps if s["added"]]
    gone = [s["removed"] for s in steps if s.get("removed")]
    sizes = {e["effect"]: f" ({e['size']})" for e in result.get("effects") or []}
    kept = [name + sizes.get(name, "") for name in added if name not in gone]
    first, last = _small(steps[0]["excess"]), _small(steps[-1]["excess"])
    told = f"{listed(kept)} took the excess from {first} to {last}. " if kept else ""
    return told + str(result.get("sentence", ""))


def _verdict(verdict: str, sentence: str, screen: Screen) -> None:
    styles = {"complete": "bold green", "missing": "bold yellow", "outside_catalogue": "bold magenta"}
    screen.say(sentence or f"The verdict is {verdict}.", style=styles.get(verdict, "bold"))


def _suggested(result: Result, screen: Screen) -> None:
    suggestions = list(dict.fromkeys(result.get("suggested_captures") or []))
    if suggestions:
        screen.say("\nCaptures that would tell more:")
        for line in suggestions:
            screen.say(
                f"  - {line if isinstance(line, str) else ', '.join(f'{k} {v}' for k, v in line.items())}"
            )


def _thresholds(result: Result, screen: Screen) -> None:
    used = result.get("thresholds")
    if isinstance(used, Mapping):
        ideal = result.get("ideal_excess")
        screen.say(
            "\nThresholds: "
            + ", ".join(f"{name} {value:g}" for name, value in used.items())
            + (f"; the ideal model's excess is {_small(ideal)}." if ideal is not None else "."),
            style="dim",
        )


def _export(model: Path | None, args: Namespace, screen: Screen) -> None:
    if model is None:
        screen.say("\nThe bench's ideal model is enough; there is nothing to put in.")
    else:
        screen.next(
            command_line("export", "--out", "bundle", args=args, model=model), "Give the model to the headset"
        )


def _write_your_own_or_learn(stage: Any, model: Path | None, args: Namespace, screen: Screen) -> None:
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


def _numbers(label: str, table: Any, screen: Screen) -> None:
    """A table from {name: {key: number}}."""
    if not isinstance(table, Mapping) or len(table) < 2:
        return
    keys = list(dict.fromkeys(k for row in table.values() if isinstance(row, Mapping) for k in row))
    screen.table((label, *keys), [(name, *(row.get(k) for k in keys)) for name, row in table.items()])


def _percent(share: float | None) -> str:
    return "not known" if share is None else f"{100 * share:.3g} %"


def _small(value: float | None) -> str:
    return "not known" if value is None else f"{value:.2g}"


def _plural(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
