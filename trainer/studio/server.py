"""The studio's server: one page on 127.0.0.1, behind a token, until Ctrl-C."""

from __future__ import annotations

import logging
import secrets
import socket
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_iface.errors import InputError
from trainer.studio.jobs import picture_worker

if TYPE_CHECKING:
    from trainer.studio.project import Project

ADDRESS = "127.0.0.1"
TOKEN_BYTES = 24
FIRST_PORT, PORTS = 5006, 50
UNUSED_MS = 30_000  # a page that nobody looks at is forgotten after this; the project stays


@dataclass(frozen=True)
class Served:
    """What was served.

    Attributes
    ----------
    address : str
    captures, model : str or None
        The last that were open.
    """

    address: str
    captures: str | None
    model: str | None


def serve(
    captures: Path | None,
    model: Path | None,
    effects: tuple[Path, ...],
    port: int | None = None,
    token: str | None = None,
    browser: bool = True,
    ready: Callable[[str], None] | None = None,
) -> Served:
    """Serve the page until Ctrl-C.

    Parameters
    ----------
    captures, model : Path, optional
        What is open at first.
    effects : tuple of Path
        Files of the user's own effects.
    port : int, optional
        A free one by default.
    token : str, optional
        A new one by default.
    browser : bool
        Whether to open one.
    ready : callable, optional
        Called with the address when it can be opened.

    Raises
    ------
    InputError
        Where the port is in use, the token cannot stand in an address, or the captures are not a folder.
    """
    token = _checked_token(token)
    asked, port = port, _free_port(port)
    worker = picture_worker()  # imports what it needs while this process does, too
    try:
        from trainer.studio.page import prepare
        from trainer.studio.project import Project

        prepare()
        project = Project(Path.cwd(), effects, worker)
    except BaseException:
        worker.close()
        raise
    try:
        if captures is not None:
            project.open_set(captures, model)
        elif model is not None:
            raise InputError(f"--model {model} needs the captures that it explains: give their folder first")
        server = None
        while server is None:
            try:
                server = make_server(project, port, token)
            except OSError:  # another program took it in the meantime
                port = _free_port(asked)
        address = f"http://{ADDRESS}:{port}/?token={token}"
        server.start()
        if ready is not None:
            server.io_loop.add_callback(ready, address)
        if browser:
            server.io_loop.add_callback(webbrowser.open, address)
        try:
            server.io_loop.start()
        except KeyboardInterrupt:
            pass
        finally:
            server.stop()
    finally:
        project.close()
    path = project.set.model_path
    written = str(path) if path is not None and path.is_file() else None
    return Served(address, None if project.set.folder is None else str(project.set.folder), written)


def make_server(project: Project, port: int, token: str) -> Any:
    """A server of the page, not started."""
    from panel.io.server import get_server

    from trainer.studio.access import TokenAccess
    from trainer.studio.page import STYLE_FOLDERS, studio_page

    logging.getLogger("bokeh.server.views.ws").setLevel(logging.CRITICAL)  # it logs each refused origin
    logging.getLogger("tornado.access").setLevel(logging.ERROR)
    own = [f"{ADDRESS}:{port}", f"localhost:{port}"]
    return get_server(
        {"/": lambda: studio_page(project)},
        port=port,
        address=ADDRESS,
        websocket_origin=own,
        auth_provider=TokenAccess(token, port),
        title={"/": "hololoop studio"},
        location=False,
        static_dirs={name: str(folder) for name, folder in STYLE_FOLDERS.items()},
        check_unused_sessions_milliseconds=10_000,
        unused_session_lifetime_milliseconds=UNUSED_MS,
        websocket_max_message_size=64 * 2**20,
    )


def _checked_token(token: str | None) -> str:
    if token is None:
        return secrets.token_urlsafe(TOKEN_BYTES)
    if len(token) < 8 or not all(c.isascii() and (c.isalnum() or c in "-_.~") for c in token):
        raise InputError(
            "--token: give at least 8 letters, digits or any of - _ . ~, or leave it out for a new one"
        )
    return token


def _free_port(port: int | None) -> int:
    """The port that was asked for, or the first free one.

    Raises
    ------
    InputError
        Where it is in use.
    """
    tried = [port] if port else list(range(FIRST_PORT, FIRST_PORT + PORTS))
    for one in tried:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((ADDRESS, one))
                return one
            except OSError as error:
                reason = error.strerror
    what = (
        f"--port {port} cannot be used ({reason}): give another one"
        if port
        else "no port is free: give --port"
    )
    raise InputError(what)
