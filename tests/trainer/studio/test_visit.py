"""What a browser hears of changes that other threads tell."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

import pytest

pytest.importorskip("panel", reason="the studio needs the extra 'studio'")
from bokeh.document import Document
from bokeh.server.session import ServerSession
from tornado.ioloop import IOLoop

from trainer.studio.jobs import WorkerProcess
from trainer.studio.project import Project
from trainer.studio.visit import Visit


def test_a_change_told_by_another_thread_is_acted_on_by_the_thread_of_the_document(tmp_path: Path) -> None:
    """A document that gathers changes may lose what another thread adds to it, as Bokeh's `unhold` does."""
    project = Project(tmp_path, (), WorkerProcess("never started"))
    acted: list[threading.Thread] = []

    async def serve() -> None:
        document = Document()
        visit = Visit(project, document)
        visit.on("set", lambda: acted.append(threading.current_thread()), now=False)
        session = ServerSession("one", document, IOLoop.current())
        document.hold("combine")
        for _ in range(3):
            teller = threading.Thread(target=project.tell, args=("set", "model"))
            teller.start()
            teller.join()
        assert not document.session_callbacks
        document.unhold()
        for _ in range(10):
            await asyncio.sleep(0.01)
        session.destroy()

    asyncio.run(serve())
    project.close()
    assert acted == [threading.current_thread()]
