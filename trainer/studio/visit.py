"""One browser's visit: what it looks at, its theme, and how it hears of changes of the project."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import ClassVar

import panel as pn
import param
from bokeh.document import Document
from tornado.ioloop import IOLoop

from trainer.studio.colours import figure_theme, line_colours
from trainer.studio.project import Project

_LOG = logging.getLogger(__name__)


class Visit(param.Parameterized):
    """What one browser shows of the project.

    Parameters
    ----------
    project : Project
    document : Document
        Of the browser. Only the thread that made the visit touches it, the server's: what another thread adds while
        the document gathers changes can be lost, and with it all later changes of the same topic.
    """

    capture = param.String(default="", doc="The capture that is compared; empty: none yet.")
    dark = param.Boolean(default=False, doc="Whether the page is dark.")

    def __init__(self, project: Project, document: Document, dark: bool = False) -> None:
        super().__init__(dark=dark)
        self.project, self.document = project, document
        self._hearers: dict[str, list[Callable[[], None]]] = {}
        self._pending: set[str] = set()
        self._loop = IOLoop.current()
        self._is_drawn = False
        self._number = project.watch(self._heard)
        document.theme = figure_theme(dark)
        document.on_session_destroyed(lambda _: project.unwatch(self._number))
        pn.state.onload(self._drawn)

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
        """From any thread: act on a topic soon."""
        self._loop.add_callback(self._plan, topic)

    def _plan(self, topic: str) -> None:
        """Act on a topic once the document is free, once however often it is told until then.

        Not before the browser has drawn the page: Panel drops changes between the sending of the page and that, since
        it takes them for a part of the page.
        """
        if topic in self._pending:
            return
        self._pending.add(topic)
        if self._is_drawn:
            self._schedule(topic)

    def _drawn(self) -> None:
        self._is_drawn = True
        for topic in self._pending:
            self._schedule(topic)

    def _schedule(self, topic: str) -> None:
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
