"""check, compare, diagnose, add, explain: from a capture set to what the bench does."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from trainer.commands.command import (
    Command,
    Interrupted,
    Result,
    captures_argument,
    command_line,
    ctrl_c_waits,
    inputs_of,
    model_options,
    origin,
    out_option,
    refuse_folder,
    report_option,
    threshold_options,
    thresholds_of,
    use_every_core,
    worker_options,
    workers_of,
)
from trainer.commands.screen import Screen
from trainer.commands.showing import (
    show_addition,
    show_check,
    show_comparison,
    show_diagnosis,
    show_explanation,
)

if TYPE_CHECKING:
    from trainer.model.model import Model


def run_check(args: Namespace, screen: Screen) -> Result:
    """Everything that is wrong with a capture set."""
    from trainer.captures.bench_file import read_bench
    from trainer.captures.capture_table import scan_rows
    from trainer.captures.check_set import check_captures
    from trainer.model.model_stages import ideal_irradiance

    folder: Path = args.captures
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: name a capture set, with bench.toml and captures.csv")
    use_every_core()
    with screen.progress("checking the captures") as told:
        problems = check_captures(folder, ideal_irradiance, lambda done, count: told(done / max(1, count)))
    try:
        rows, _ = scan_rows(folder, read_bench(folder / "bench.toml"))
    except InputError:
        rows = []
    return {"captures": len(rows), "problems": [dict(vars(p)) for p in problems]}


def run_compare(args: Namespace, screen: Screen) -> Result:
    """How far a model is from the captures."""
    refuse_folder(args.report, "--report")
    captures, _, model = inputs_of(args)
    from dataclasses import replace

    from trainer.diagnosis.compare import compare
    from trainer.diagnosis.error_budget import error_budget
    from trainer.networks.approximator import read_approximator

    network = read_approximator(args.network)[0] if args.network else None
    use_every_core()
    with screen.progress("comparing") as told:
        found = compare(captures, model, lambda done: told(0.6 * done))
        if found.as_json()["heldout"]["excess"] is not None:
            budget = error_budget(captures, found.model, network, lambda done: told(0.6 + 0.4 * done))
            found = replace(found, budget=budget)
    if args.report:
        from trainer.report import write_report

        write_report(args.report, f"Comparison: {captures.folder.name}", comparison=found, model=found.model)
    return found.as_json()


def run_diagnose(args: Namespace, screen: Screen) -> Result:
    """What is missing from a model."""
    refuse_folder(args.report, "--report")
    thresholds = thresholds_of(args)
    captures, known, model = inputs_of(args)
    refuse_misread(args.captures, screen)
    from trainer.diagnosis.diagnose import diagnose
    from trainer.fitting.pool import open_pool

    with screen.progress("diagnosing") as told, open_pool(workers_of(args), args.cluster) as pool:
        found = diagnose(captures, model, known, pool, thresholds, told)
    if args.report:
        from trainer.diagnosis.compare import compare
        from trainer.report import write_report

        write_report(
            args.report,
            f"Diagnosis: {captures.folder.name}",
            comparison=compare(captures, found.model),
            diagnosis=found,
        )
    return found.as_json()


def run_add(args: Namespace, screen: Screen) -> Result:
    """One effect more."""
    refuse_folder(args.out, "--out")
    from trainer.effects.effect_catalogue import catalogue, find_effect

    effect = find_effect(catalogue(args.effects), args.effect)
    captures, known, model = inputs_of(args)
    from trainer.diagnosis.explain import add
    from trainer.model.model_file import write_model

    use_every_core()
    with screen.progress(f"adding {effect.name}") as told:
        found = add(captures, model, effect, known, told)
    write_model(args.out, found.model, origin(captures))
    return found.as_json()


def run_explain(args: Namespace, screen: Screen) -> Result:
    """Effect after effect until nothing more is worth adding."""
    refuse_folder(args.out, "--out")
    refuse_folder(args.report, "--report")
    thresholds = thresholds_of(args)
    captures, known, model = inputs_of(args)
    refuse_misread(args.captures, screen)
    from trainer.diagnosis.explain import explain
    from trainer.fitting.pool import open_pool
    from trainer.model.model_file import write_model

    source = origin(captures)
    saved: list[tuple[str, ...]] = []

    def save(better: Model) -> None:
        with ctrl_c_waits():
            write_model(args.out, better, source)
            saved.append(better.names)

    try:
        with screen.progress("explaining") as told, open_pool(workers_of(args), args.cluster) as pool:
            found = explain(captures, model, known, pool, thresholds, save, told)
        save(found.model)
        if args.report:
            from trainer.diagnosis.compare import compare
            from trainer.report import write_report

            write_report(
                args.report,
                f"Explanation: {captures.folder.name}",
                comparison=compare(captures, found.model),
                diagnosis=found.diagnosis,
                ladder=found.as_json(args.out),
                model=found.model,
            )
    except KeyboardInterrupt:
        raise Interrupted(_interrupted(saved, model.names, args.out)) from None
    return {**found.as_json(args.out), "effects": _sizes(found.model)}


def _sizes(model: Model) -> list[Result]:
    """The effects of a model, each with its size in words and its parameters."""
    from trainer.model.parameters import describe, json_values

    return [
        {
            "effect": p.effect.name,
            "stage": p.effect.stage,
            "size": describe(p, model.bench),
            "parameters": json_values(p, model.bench),
        }
        for p in model.present
    ]


def _interrupted(saved: list[tuple[str, ...]], before: tuple[str, ...], out: Path) -> str:
    added = [name for name in saved[-1] if name not in before] if saved else []
    if added:
        return f"interrupted after adding {', '.join(added)}; the model so far is in {out}"
    if saved:
        return f"interrupted before anything was added; the model as it was is in {out}"
    return "interrupted before anything was added; nothing was written"


def refuse_misread(folder: Path, screen: Screen) -> None:
    """Raises InputError where the captures are not what bench.toml says, so that every number would be wrong; a
    line on stderr for other errors of the set, which may be what is to be explained.
    """
    from trainer.captures.check_set import check_captures
    from trainer.captures.problems import MISREAD
    from trainer.model.model_stages import ideal_irradiance

    errors = [p for p in check_captures(folder, ideal_irradiance) if p.severity == "error"]
    for problem in errors:
        if problem.kind in MISREAD:
            raise InputError(problem.message)
    if errors:
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        screen.note(f"warning: {errors[0].message}{more}; see: {command_line('check', folder)}")


def _check_options(parser: ArgumentParser) -> None:
    captures_argument(parser)


def _compare_options(parser: ArgumentParser) -> None:
    captures_argument(parser)
    model_options(parser)
    parser.add_argument(
        "--network",
        metavar="FILE",
        type=Path,
        help="a network trained beyond the model: its part of the error too",
    )
    report_option(parser)


def _diagnose_options(parser: ArgumentParser) -> None:
    captures_argument(parser)
    model_options(parser)
    report_option(parser)
    worker_options(parser)
    threshold_options(parser)


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "effect", metavar="EFFECT", help="name of an effect; 'hololoop-trainer effects' lists them"
    )
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "NEW.toml", "where the new model goes")


def _explain_options(parser: ArgumentParser) -> None:
    captures_argument(parser)
    model_options(parser)
    out_option(parser, "NEW.toml", "where the model goes; it is written after every effect that is added")
    report_option(parser)
    worker_options(parser)
    threshold_options(parser)


def commands() -> list[Command]:
    """The commands of this file."""
    show: Any = show_check
    return [
        Command(
            "check",
            "Look for everything that is wrong with a capture set.",
            "check captures/",
            "Mend what it names, then see how far the ideal model is off: compare captures/",
            _check_options,
            run_check,
            show,
        ),
        Command(
            "compare",
            "Say how far a model is from the captures, and where.",
            "compare captures/ --model model.toml --report compare.html",
            "Ask what is missing: diagnose captures/ --model model.toml",
            _compare_options,
            run_compare,
            show_comparison,
        ),
        Command(
            "diagnose",
            "Say what is missing from a model: which stage, which effect, how large.",
            "diagnose captures/ --model model.toml --report diagnosis.html",
            "Put in what is missing: add zero_order captures/ --out better.toml; or let explain do it.",
            _diagnose_options,
            run_diagnose,
            show_diagnosis,
        ),
        Command(
            "add",
            "Add one effect to a model, fit it, and say what is gained on captures the fit did not see.",
            "add zero_order captures/ --out better.toml",
            "See what is still missing: diagnose captures/ --model better.toml",
            _add_options,
            run_add,
            show_addition,
        ),
        Command(
            "explain",
            "Diagnose and add, again and again, until nothing more is worth adding.",
            "explain captures/ --out model.toml --report explanation.html",
            "Give the model to the headset: export --model model.toml --out bundle/",
            _explain_options,
            run_explain,
            show_explanation,
        ),
    ]
