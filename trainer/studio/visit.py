"""One browser's visit: what it looks at, its theme, and how it hears of changes of the project."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import ClassVar

import panel as pn
import param
from bokeh.document import Document

from trainer.studio.colours import figure_theme, line_colours
from trainer.studio.project import Project

_LOG = logging.getLogger(__name__)


class Visit(param.Parameterized):
    """What one browser shows of the project.

    Parameters
    ----------
    project : Project
    document : Document
        Of the browser.
    """

    capture = param.String(default="", doc="The capture that is compared; empty: none yet.")
    dark = param.Boolean(default=False, doc="Whether the page is dark.")

    def __init__(self, project: Project, document: Document, dark: bool = False) -> None:
        super().__init__(dark=dark)
        self.project, self.document = project, document
        self._hearers: dict[str, list[Callable[[], None]]] = {}
        self._pending: set[str] = set()
        self._number = project.watch(self._heard)
        document.theme = figure_theme(dark)
        document.on_session_destroyed(lambda _: project.unwatch(self._number))

    @property
    def colours(self) -> dict[str, str]:
        """Colours of curves."""
        return line_colours(self.dark)

    def on(self, topics: str, function: Callable[[], None], now: bool = True) -> None:
        """Call a function at each change of some topics, named in one string, and at once."""
        for topic in topics.split():
            self._hearers.setdefault(topic, []).append(function)
        if now:
            function()

    def _heard(self, topic: str) -> None:
        """From any thread: act on a topic once the document is free, once however often it is told until then."""
        if topic in self._pending:
            return
        self._pending.add(topic)
        self.document.add_next_tick_callback(lambda: self._act(topic))

    def _act(self, topic: str) -> None:
        self._pending.discard(topic)
        for function in list(self._hearers.get(topic, ())):
            try:
                function()
            except Exception:
                _LOG.exception("a view could not show a change of %s", topic)


class LiveText(pn.reactive.ReactiveHTML):
    """A sentence in a live region: a screen reader says it when it changes."""

    text = param.String(default="")
    tone = param.String(default="plain")

    _template = '<div id="region" role="status" aria-live="polite" class="live ${tone}">${text}</div>'
    _child_config: ClassVar[dict[str, str]] = {"text": "literal"}
