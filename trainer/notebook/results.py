"""What the functions of `steps` return: the numbers, a figure, and a page that a notebook shows."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from firmware_iface.errors import InputError, nearest
from trainer.captures.capture_set import CaptureSet
from trainer.captures.problems import Problem
from trainer.diagnosis.comparison import Comparison
from trainer.diagnosis.comparison import compare as compare_model
from trainer.diagnosis.diagnosis import Diagnosis
from trainer.diagnosis.explanation import Explanation
from trainer.formatting import change_of, number
from trainer.model.model import Model
from trainer.notebook.figures import NotebookFigure, comparison_figure, explanation_figure, image_tag
from trainer.report import write_report


@dataclass(frozen=True)
class CheckResult:
    """What is wrong with a capture set.

    Attributes
    ----------
    folder : Path
        The capture set's.
    problems : tuple of Problem
        Each with `severity` ("error" or "warning"), `kind`, `capture` and `message`.
    """

    folder: Path
    problems: tuple[Problem, ...]

    @property
    def sound(self) -> bool:
        """Whether there is no error; warnings are allowed."""
        return all(p.severity != "error" for p in self.problems)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        if not self.problems:
            return f"<p>Nothing is wrong with {escape(self.folder.name)}.</p>"
        rows = [(p.severity, p.kind, p.capture, p.message) for p in self.problems]
        return _table(("severity", "kind", "capture", "message"), rows)


@dataclass(frozen=True)
class ComparisonResult:
    """How far a model is from the captures that no fit saw.

    Attributes
    ----------
    captures : CaptureSet
    comparison : Comparison
        Everything that was found, by capture, field, frequency, brightness and time.
    """

    captures: CaptureSet
    comparison: Comparison

    @property
    def model(self) -> Model:
        """The model as it was compared, with its gains."""
        return self.comparison.model

    @property
    def excess(self) -> float | None:
        """Mean squared error beyond the camera's noise, over the signal's variance; None without contrast."""
        return self._heldout["excess"]

    @property
    def nrmse(self) -> float | None:
        """Root mean squared error over the signal's standard deviation, noise included."""
        return self._heldout["nrmse"]

    @property
    def noise_nrmse(self) -> float | None:
        """What `nrmse` would be if the camera's noise were the only error."""
        return self._heldout["noise_nrmse"]

    def as_json(self) -> dict[str, Any]:
        """What `hololoop-trainer compare --json` prints."""
        return self.comparison.as_json()

    def figure(self) -> NotebookFigure:
        """A held-out capture as measured, as predicted, and the difference."""
        return comparison_figure(self.comparison.pictures)

    def view(self, *names: str) -> Any:
        """The studio's views of it, as a panel object; needs the extra `studio`.

        Parameters
        ----------
        names : str
            "light path", "pictures" (linked pan and zoom) and "failures"; all without any.
        """
        from trainer.studio import result_views as views

        return _viewed(_comparison_views(views, self.comparison), names)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the report, one HTML file."""
        write_report(
            Path(path),
            f"Comparison: {self.captures.folder.name}",
            comparison=self.comparison,
            model=self.model,
        )

    @cached_property
    def _heldout(self) -> dict[str, Any]:
        return dict(self.as_json()["heldout"])

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return _table(("nrmse", "camera noise alone", "excess"), [tuple(self._heldout.values())]) + image_tag(
            self.figure(), "A held-out capture as measured and as predicted, and the difference."
        )


@dataclass(frozen=True)
class DiagnosisResult:
    """What is missing from a model.

    Attributes
    ----------
    diagnosis : Diagnosis
        Everything that was found.
    """

    diagnosis: Diagnosis

    @property
    def model(self) -> Model:
        """The model that was diagnosed, with its gains."""
        return self.diagnosis.model

    @property
    def verdict(self) -> str:
        """The verdict: "complete", "missing" or "outside_catalogue"."""
        return self.diagnosis.verdict

    @property
    def stage(self) -> str | None:
        """The stage that something is missing from: drive, panel, pupil or sensor; None where none stands out."""
        return self.diagnosis.stage

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        return self.diagnosis.sentence

    @cached_property
    def ranking(self) -> list[dict[str, Any]]:
        """The fitted effects, best first: `effect`, `stage`, `excess_removed`, `ci95`, `worth_adding` and more."""
        return list(self.as_json()["ranking"])

    def as_json(self) -> dict[str, Any]:
        """What `hololoop-trainer diagnose --json` prints."""
        return self.diagnosis.as_json()

    def view(self, *names: str) -> Any:
        """The studio's views of it, as a panel object; needs the extra `studio`.

        Parameters
        ----------
        names : str
            "verdict", "light path", "candidates" and "probes"; all without any.
        """
        from trainer.studio import result_views as views

        return _viewed(_diagnosis_views(views, self.diagnosis), names)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        columns = ("effect", "stage", "excess_removed", "excess_after", "worth_adding")
        rows = [tuple(row[c] for c in columns) for row in self.ranking]
        return f"<p>{escape(self.sentence)}</p>" + _table(columns, rows)


@dataclass(frozen=True)
class ExplanationResult:
    """The effects that were found, one after the other, and the verdict on what remains.

    Attributes
    ----------
    captures : CaptureSet
    explanation : Explanation
        Everything that was found, the diagnosis of each step included.
    """

    captures: CaptureSet
    explanation: Explanation

    @property
    def model(self) -> Model:
        """The model with all effects that were found."""
        return self.explanation.model

    @cached_property
    def ladder(self) -> list[dict[str, Any]]:
        """One step after the other: `added`, `nrmse`, `excess`, `indistinguishable_from`, and `removed` where so.

        Errors are of captures that no fit saw. The first step is the model that was started from.
        """
        return list(self._json["steps"])

    @property
    def verdict(self) -> str:
        """The verdict on what remains: "complete", "missing" or "outside_catalogue"."""
        return str(self._json["verdict"])

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        return str(self._json["sentence"])

    @property
    def suggested_captures(self) -> list[str]:
        """Captures that would tell apart what these cannot."""
        return list(self._json["suggested_captures"])

    @cached_property
    def comparison(self) -> ComparisonResult:
        """How far the last model is from the held-out captures; computed when first asked for."""
        return ComparisonResult(self.captures, compare_model(self.captures, self.model))

    def as_json(self) -> dict[str, Any]:
        """What `hololoop-trainer explain --json` prints, without the model file and the effects' sizes."""
        return {key: value for key, value in self._json.items() if key != "model"}

    def figure(self) -> NotebookFigure:
        """The error after each step, and a held-out capture as measured, as predicted, and the difference."""
        return explanation_figure(
            self.ladder, float(self._json["noise_nrmse"]), self.comparison.comparison.pictures
        )

    def view(self, *names: str) -> Any:
        """The studio's views of it, as a panel object; needs the extra `studio`.

        Parameters
        ----------
        names : str
            "verdict", "light path", "ladder", "pictures", "failures", "candidates" and "probes"; all without any.
        """
        from trainer.studio import result_views as views

        found = self.explanation.diagnosis
        diagnosed = _diagnosis_views(views, found)
        compared = _comparison_views(views, self.comparison.comparison)
        noise = float(self._json["noise_nrmse"])
        every = {
            "verdict": diagnosed["verdict"],
            "light path": diagnosed["light path"],
            "ladder": lambda: views.ladder_view(self.ladder, noise),
            "pictures": compared["pictures"],
            "failures": compared["failures"],
            "candidates": diagnosed["candidates"],
            "probes": diagnosed["probes"],
        }
        return _viewed(every, names)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the report, one HTML file."""
        write_report(
            Path(path),
            f"Explanation: {self.captures.folder.name}",
            comparison=self.comparison.comparison,
            diagnosis=self.explanation.diagnosis,
            ladder=self._json,
            model=self.model,
        )

    @cached_property
    def _json(self) -> dict[str, Any]:
        return dict(self.explanation.as_json(Path()))

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        rows = [(change_of(step) or "start", step["nrmse"], step["excess"]) for step in self.ladder]
        return (
            f"<p>{escape(self.sentence)}</p>"
            + _table(("step", "nrmse", "excess"), rows)
            + image_tag(self.figure(), "The error after each step, and a held-out capture.")
        )


def _comparison_views(views: Any, found: Comparison) -> dict[str, Callable[[], Any]]:
    return {
        "light path": lambda: views.light_path_view(found.model, None),
        "pictures": lambda: views.pictures_view(found.pictures),
        "failures": lambda: views.failures_view(found),
    }


def _diagnosis_views(views: Any, found: Diagnosis) -> dict[str, Callable[[], Any]]:
    return {
        "verdict": lambda: views.verdict_view(found),
        "light path": lambda: views.light_path_view(found.model, found),
        "candidates": lambda: views.candidates_view(found),
        "probes": lambda: views.probes_view(found),
    }


def _viewed(every: Mapping[str, Callable[[], Any]], names: Sequence[str]) -> Any:
    """Views by their names, above each other."""
    from trainer.studio.result_views import together

    for name in names:
        if name not in every:
            raise InputError(f"there is no view '{name}': {nearest(name, list(every))}")
    return together(every, names)


def _table(columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    def cell(value: Any) -> str:
        return escape(number(value) if isinstance(value, float) else "" if value is None else str(value))

    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{cell(v)}</td>" for v in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
