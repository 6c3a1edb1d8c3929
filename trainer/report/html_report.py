"""The HTML report of a comparison, a diagnosis, a ladder of effects and a model, as one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from runtime.bundle.whole_files import whole_file
from trainer.formatting import listed, number, percent, sentence
from trainer.model.model import Model
from trainer.report.diagnosis_sections import (
    apart,
    headline,
    ladder_section,
    model_table,
    ranking,
    stages,
    stages_html,
    thresholds,
)
from trainer.report.error_sections import facts, pictures, where
from trainer.report.light_path import light_path_html

LOOK = Path(__file__).with_name("look")
METHOD = (
    "Every number comes from captures that no fit has used: excess is the mean squared error beyond the "
    "camera's expected noise, divided by the variance of the measured signal, so that 0 is a perfect model "
    "and 1 one that predicts nothing but the mean.",
    "Error (nrmse) is the root of the whole mean squared error over the same variance, noise included; "
    "saturated pixels are left out of everything, and intervals come from the scatter between tiles of the "
    "pictures.",
)


def write_report(
    path: Path | str,
    title: str,
    comparison: Any = None,
    diagnosis: Any = None,
    ladder: Any = None,
    model: Model | None = None,
) -> None:
    """Write a report; the file appears whole or not at all. Sections without data are left out.

    Parameters
    ----------
    path : path
        The HTML file.
    title : str
        Of the page.
    comparison : trainer.diagnosis.comparison.Comparison or None
        Or another object with its `as_json()` and, if known, `pictures`.
    diagnosis : object or None
        With `as_json()` (the object of `diagnose --json`, with `thresholds`, `ideal_excess` and `sentence` if known)
        `probe_pictures`: (stage, title, array of one or two dimensions, unit), and, if known, `previews`.
    ladder : sequence of mapping, mapping or None
        Steps with the keys `added`, `removed`, `nrmse`, `excess` and `indistinguishable_from`, or the object of
        `explain --json`; None: the model's history.
    model : Model or None
        For a table of its effects; None: the comparison's own.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    compared = comparison.as_json() if comparison is not None else None
    found = diagnosis.as_json() if diagnosis is not None else None
    if model is None:
        model = getattr(comparison, "model", None)
    if ladder is None and model is not None and len(model.history) > 1:
        ladder = model.history
    steps, floor = _steps(ladder)
    if floor is None:
        floor = next((d["heldout"]["noise_nrmse"] for d in (compared, found) if d and d.get("heldout")), None)
    heldout = next((d["heldout"] for d in (compared, found) if d and d.get("heldout")), None)
    probed = stages(found, getattr(diagnosis, "probe_pictures", None) or ())
    context = {
        "title": title,
        "style": report_style(),
        "light_path": light_path_html(model, found) if model is not None else None,
        "headline": headline(compared, found, steps),
        "facts": facts(compared, heldout, found),
        "pictures": pictures(getattr(comparison, "pictures", None) or ()),
        "where": where(compared, model.bench.camera.shape if model else None) if compared else None,
        "ladder": ladder_section(steps, floor),
        "stages": stages_html(probed) if probed else None,
        "ranking": ranking(found, getattr(diagnosis, "previews", ())),
        "apart": apart(found, steps, _more(ladder)),
        "thresholds": thresholds(found),
        "model": model_table(model) if model is not None else None,
        "method": METHOD,
    }
    write_page(path, "trainer.report", "report.html", context)


def write_page(path: Path | str, package: str, template: str, context: Mapping[str, Any]) -> None:
    """Write an HTML page from a template next to a package's files, whole or not at all.

    Parameters
    ----------
    package, template : str
        Where the template is, such as "trainer.report" and "report.html".
    context : mapping
        What its names stand for.

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    html = _template(package, template).render(context)
    with whole_file(path, "w") as stream:
        stream.write(html)


@lru_cache(maxsize=1)
def page_style() -> Markup:
    """The style sheet that reports and the studio share."""
    return Markup((LOOK / "page.css").read_text(encoding="utf-8"))


@lru_cache(maxsize=1)
def report_style() -> Markup:
    """The style sheet of pages that are files: that of the studio, and what only they have."""
    return page_style() + Markup((LOOK / "report.css").read_text(encoding="utf-8"))


def _steps(ladder: Any) -> tuple[Sequence[Mapping[str, Any]], float | None]:
    if ladder is None:
        return (), None
    if isinstance(ladder, Mapping):
        return ladder.get("steps") or (), ladder.get("noise_nrmse")
    return ladder, next((s["noise_nrmse"] for s in ladder if s.get("noise_nrmse") is not None), None)


def _more(ladder: Any) -> Sequence[Any]:
    return ladder.get("suggested_captures") or () if isinstance(ladder, Mapping) else ()


@lru_cache(maxsize=4)
def _template(package: str, name: str) -> Template:
    environment = Environment(
        loader=PackageLoader(package, "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, percent=percent, listed=listed, sentence=sentence)
    return environment.get_template(name)
