"""A report's sections on the diagnosis: verdict, ladder of errors, stages, ranking, what the captures cannot decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from trainer.diagnosis.previews import CandidatePreview
from trainer.diagnosis.verdict import Thresholds
from trainer.formatting import listed, number, parameters, percent, plain
from trainer.model.model import Model
from trainer.model.parameters import json_values
from trainer.report.candidates import MOST, candidate_html, least_worth_adding, preview_html, ranking_html
from trainer.report.charts import curve_chart, is_worth, stage_bars
from trainer.report.heat_maps import HeatMap, from_zero, heat_map, place, symmetric
from trainer.report.ladder import ladder_html, ladder_rows
from trainer.report.palettes import DIFFERENCE, IRRADIANCE

PROBE = 320  # largest side of a probe's picture, pixels
PROBES = Markup('<h3>Fitted probe of the {} stage{}</h3><div class="probes">{}</div>')
CURVE = Markup("<figure><b>{}</b>{}</figure>")

VERDICTS = {
    "complete": ("good", "Complete"),
    "missing": ("warn", "Something is missing"),
    "outside_catalogue": ("bad", "Something outside the catalogue is missing"),
}


def headline(compared: Any, found: Any, steps: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """The verdict in one sentence: tone (good, warn, bad or plain), label, sentence."""
    if found and found.get("verdict"):
        tone, label = VERDICTS.get(found["verdict"], ("plain", plain(found["verdict"])))
        return {"tone": tone, "label": label, "sentence": found.get("sentence") or _diagnosed(found)}
    if compared:
        heldout, count = compared["heldout"], len(compared.get("by_capture") or [])
        excess, nrmse, noise = heldout["excess"], heldout["nrmse"], heldout["noise_nrmse"]
        on = f"On {count} held-out capture{'s' if count != 1 else ''}"
        if not compared.get("held_out", True):
            on = "Nothing is held out (one pattern): on the capture that was fitted"
        if excess is None:
            text = f"{on} there is no contrast to compare with."
            return {"tone": "bad", "label": "No contrast", "sentence": text}
        if excess < Thresholds().complete_excess:
            text = f"{on} the model agrees with the bench to the camera's noise: error {percent(nrmse)} of "
            text += f"the signal's spread, noise alone {percent(noise)}."
            return {"tone": "good", "label": "Agrees", "sentence": text}
        text = f"{on} the model is off by {percent(nrmse)} of the signal's spread"
        times = f", {number(nrmse / noise, 2)} times the camera's noise" if noise else ""
        return {"tone": "warn", "label": "Off", "sentence": f"{text}{times} (excess {number(excess)})."}
    if steps:
        first, last = steps[0], steps[-1]
        text = f"The held-out error went from {percent(first['nrmse'])} to {percent(last['nrmse'])}"
        names = [s["added"] for s in steps if s.get("added")]
        text += f" with {listed(names)}." if names else "; nothing was added."
        return {"tone": "plain", "label": "", "sentence": text}
    return {"tone": "plain", "label": "", "sentence": ""}


def _diagnosed(found: Mapping[str, Any]) -> str:
    excess, stage = found["heldout"]["excess"], found.get("stage")
    if found["verdict"] == "complete":
        return f"Nothing is missing: what remains (excess {number(excess)}) is too little to explain."
    ranking = found.get("ranking") or []
    if found["verdict"] == "missing" and ranking:
        best = ranking[0]
        others = best.get("indistinguishable_from") or []
        also = f"; the data cannot tell it from {listed(others)}" if others else ""
        removal = f"removes {number(best['excess_removed'])} of the excess {number(excess)}"
        return f"Adding {best['effect']} ({best['stage']}) {removal}{also}."
    where = f", most likely in the {stage} stage" if stage else ""
    return f"Excess {number(excess)} is left that no effect of the catalogue explains{where}."


def ladder_section(steps: Sequence[Mapping[str, Any]], noise: float | None) -> dict[str, Any] | None:
    """The ladder and the table of errors after each step; None where nothing was added."""
    rows = ladder_rows(steps)
    if len(rows) < 2:
        return None
    return {
        "html": ladder_html(rows, noise),
        "rows": rows,
        "undecided": any(r["others"] for r in rows),
        "noise": noise,
    }


def stages(found: Any, probes: Sequence[tuple[str, str, np.ndarray, str]]) -> dict[str, Any] | None:
    """The bars of the stages, and the fitted probes as pictures or curves."""
    rows = (found or {}).get("stages") or []
    if not rows and not probes:
        return None
    total = found["heldout"]["excess"] if found and found.get("heldout") else None
    removed = {str(r["stage"]): float(r["excess_removed"]) for r in rows}
    order = sorted(dict.fromkeys(str(p[0]) for p in probes), key=lambda stage: -removed.get(stage, 0.0))
    groups = []
    for stage in order:
        note = ""
        if stage in removed:
            share = f" ({percent(removed[stage] / total, 2)})" if total and total > 0 else ""
            note = (
                f"removes excess {number(removed[stage])}{share}" if removed[stage] > 0 else "removes nothing"
            )
        fitted = [_probe(*p) for p in probes if p[0] == stage and np.asarray(p[2]).size]
        groups.append({"stage": stage, "note": note, "probes": fitted})
    return {
        "chart": stage_bars(rows, total, found.get("stage")) if rows else None,
        "groups": groups,
    }


def stages_html(section: Mapping[str, Any]) -> Markup:
    """The section of `stages`: its bars, and each stage's probes."""
    parts = [section["chart"] or Markup("")]
    for group in section["groups"]:
        note = Markup(' <span class="quiet">– {}</span>').format(group["note"]) if group["note"] else ""
        shown = Markup("").join(
            one["picture"].html() if one["picture"] is not None else CURVE.format(one["title"], one["chart"])
            for one in group["probes"]
        )
        parts.append(PROBES.format(group["stage"], note, shown))
    return Markup("").join(parts)


def _probe(stage: str, title: str, values: Any, unit: str) -> dict[str, Any]:
    array = np.squeeze(np.asarray(values))
    if np.iscomplexobj(array):
        array = np.abs(array)
    array = np.atleast_1d(array.astype(np.float64))
    if array.ndim == 1:
        return {"title": title, "chart": curve_chart(array, title, unit), "picture": None}
    if array.ndim > 2:
        array = array.reshape(-1, *array.shape[-2:])[0]
    return {"title": title, "chart": None, "picture": _probe_map(stage, title, array, unit)}


def _probe_map(stage: str, title: str, array: np.ndarray, unit: str) -> HeatMap:
    low, high = float(np.nanmin(array)), float(np.nanmax(array))
    if low < 0 < high:
        scale, colours = symmetric([array]), DIFFERENCE
    elif low > 0.5 * high:  # a gain map: its own range, else it shows nothing
        finite = array[np.isfinite(array)]
        low_end, high_end = (float(np.percentile(finite, share)) for share in (0.2, 99.8))
        scale, colours = (low_end, high_end), IRRADIANCE
    else:
        scale, colours = from_zero([array]), IRRADIANCE
    i, j = np.unravel_index(int(np.nanargmax(np.abs(array - np.nanmedian(array)))), array.shape)
    spot = place(i / array.shape[0], j / array.shape[1])
    tail = "" if unit == "1" else f" {unit}"
    alt = (
        f"Fitted probe of the {stage} stage, {title}: from {number(low)} to {number(high)}{tail}, furthest "
        f"from its median in the {spot}."
    )
    return heat_map(title, array, alt, "" if unit == "1" else unit, scale, colours, largest=PROBE)


def ranking(found: Any, previews: Sequence[CandidatePreview] = ()) -> dict[str, Any] | None:
    """The ranking, the best candidates with their pictures, and the table of all."""
    rows = (found or {}).get("ranking") or []
    if not rows:
        return None
    least = least_worth_adding(found)
    drawn = {p.effect: p for p in previews}
    table = []
    for r in rows:
        interval = r.get("ci95")
        table.append(
            {
                "effect": r["effect"],
                "stage": r["stage"],
                "removed": r["excess_removed"],
                "interval": interval,
                "after": r.get("excess_after"),
                "worth": is_worth(r, least),
                "parameters": parameters(r.get("parameters")),
                "others": r.get("indistinguishable_from") or [],
            }
        )
    undecided = any(r["others"] for r in table)
    return {
        "html": ranking_html(rows, least),
        "best": [(candidate_html(r, least), preview_html(drawn.get(r["effect"]))) for r in rows[:MOST]],
        "rows": table,
        "undecided": undecided,
    }


def apart(found: Any, steps: Sequence[Mapping[str, Any]], more: Sequence[Any]) -> dict[str, Any] | None:
    """Groups of effects that the data cannot separate, and captures that would (`more`: further ones)."""
    groups: list[list[str]] = []
    known: set[frozenset[str]] = set()
    named = [(r["effect"], r) for r in (found or {}).get("ranking") or []]
    for name, row in [*named, *((s.get("added"), s) for s in steps)]:
        others = row.get("indistinguishable_from") or []
        group = frozenset([str(name), *map(str, others)])
        if name and others and group not in known:
            known.add(group)
            groups.append([str(name), *[str(o) for o in others if o != name]])
    wanted = [*((found or {}).get("suggested_captures") or []), *more]
    suggestions = list(dict.fromkeys(_suggestion(s) for s in wanted))
    return {"groups": groups, "suggestions": suggestions} if groups or suggestions else None


def _suggestion(one: Any) -> str:
    if not isinstance(one, Mapping):
        return str(one)
    for key in ("message", "text", "what", "about", "captures"):
        if isinstance(one.get(key), str):
            why = one.get("why") or one.get("decides") or one.get("separates")
            reason = listed(why) if isinstance(why, list | tuple) else str(why)
            return f"{one[key]} ({reason})" if why else str(one[key])
    return "; ".join(f"{plain(k)}: {listed(v) if isinstance(v, list | tuple) else v}" for k, v in one.items())


def thresholds(found: Any) -> list[tuple[str, str]]:
    """The rules of the verdict, with the numbers that follow from them for these captures."""
    limits = (found or {}).get("thresholds")
    if not limits:
        return []
    ideal = found.get("ideal_excess")
    share, least = limits["share"], limits["excess"]
    rows = [("excess of the ideal model", number(ideal))] if ideal is not None else []
    worth = f"more than {100 * share:g} % of the ideal model's excess and more than {least:g}"
    complete, bound = limits["complete_share"], limits["complete_excess"]
    done = f"below {100 * complete:g} % of the ideal model's excess, or below {bound:g} if that is larger"
    if ideal is not None:
        worth += f"; here more than {number(max(share * ideal, least))}"
        done += f"; here below {number(max(complete * ideal, bound))}"
    known = {
        "floor": "repeated pictures leave in doubt, and nothing below it counts",
        "pixel_noise": "the noise in each pixel's own values makes, and nothing can explain",
    }
    rows += [(f"excess that {what}", number(limits[key])) for key, what in known.items() if limits.get(key)]
    return [
        *rows,
        ("an effect is worth adding when it removes", worth),
        (
            "and its interval lies above zero",
            f"two-sided, at a level of {100 * limits['level']:g} % shared among all candidates",
        ),
        ("a model is complete when the excess that remains is", done),
    ]


def model_table(model: Model) -> dict[str, Any]:
    """The effects that are present, with their parameters, and the gains."""
    rows = []
    for one in model.present:
        rows.append({"effect": one.effect, "parameters": parameters(json_values(one, model.bench))})
    return {"rows": rows, "gain": [(c, number(g)) for c, g in model.gain.items()], "bench": model.bench.name}
