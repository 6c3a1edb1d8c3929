"""Who may open the studio: whoever brings the token of the printed address, from this machine, under its own name.

The first visit with the token gets a cookie, so that a reload needs no token in the address.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from html import escape
from typing import Any

from bokeh.server.auth_provider import AuthProvider
from tornado.web import Finish, RequestHandler

REFUSED = (
    "This page needs the token of the address that the studio printed when it started: "
    "open that whole address, or start the studio again."
)
ADMITTED = (  # to the address without the token, telling whether the system is dark
    "<!doctype html><html lang='en'><meta charset='utf-8'><title>hololoop studio</title>"
    "<noscript><meta http-equiv='refresh' content='0;url=/'></noscript>"
    "<script>document.cookie = 'hololoop_system=' + (matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : "
    "'light') + ';path=/'; location.replace('/');</script></html>"
)
FOREIGN = "The studio answers to 127.0.0.1 and localhost alone: open the address that it printed."


class TokenAccess(AuthProvider):
    """Lets a request in that brings the token, as an argument of the address or as the cookie of an earlier visit.

    Parameters
    ----------
    token : str
    port : int
        Of the server; the cookie is named for it, since browsers share cookies among the ports of a machine.
    """

    def __init__(self, token: str, port: int) -> None:
        self._token, self._port = token, port
        super().__init__()

    @property
    def cookie(self) -> str:
        """Name of the cookie."""
        return f"hololoop_studio_{self._port}"

    @property
    def get_user(self) -> Callable[[Any], Any]:
        """The function that Bokeh asks before it answers a page or a websocket."""
        return self._admitted

    @property
    def get_user_async(self) -> None:
        """None: `get_user` decides at once."""
        return None

    @property
    def login_url(self) -> str:
        """Never used: a request without the token is answered here."""
        return "/refused"

    @property
    def get_login_url(self) -> None:
        """None: there is no page to log in."""
        return None

    @property
    def login_handler(self) -> None:
        """None: there is no page to log in."""
        return None

    @property
    def logout_url(self) -> None:
        """None: closing the program ends every visit."""
        return None

    @property
    def logout_handler(self) -> None:
        """None: closing the program ends every visit."""
        return None

    def _admitted(self, handler: RequestHandler) -> str:
        """The visitor's name.

        Raises
        ------
        Finish
            After another answer than the page was sent: a refusal, or the way to the address without the token.
        """
        if handler.request.host not in {f"127.0.0.1:{self._port}", f"localhost:{self._port}"}:
            _refuse(handler, FOREIGN)
        given = handler.get_query_argument("token", "")
        if given and self._same(given):
            handler.set_cookie(self.cookie, self._token, httponly=True, samesite="Lax", path="/")
            if handler.request.method == "GET" and "Upgrade" not in handler.request.headers:
                handler.set_header("Content-Type", "text/html; charset=utf-8")
                handler.finish(ADMITTED)
                raise Finish
            return "visitor"
        if not given and self._same(handler.get_cookie(self.cookie) or ""):
            return "visitor"
        _refuse(handler, REFUSED)
        raise Finish

    def _same(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())


def _refuse(handler: RequestHandler, sentence: str) -> None:
    handler.set_status(403)
    if handler.request.headers.get("Upgrade", "").lower() != "websocket":
        handler.set_header("Content-Type", "text/html; charset=utf-8")
        handler.finish(
            "<!doctype html><html lang='en'><meta charset='utf-8'><title>hololoop studio: refused</title>"
            f"<body style='font:16px/1.5 system-ui,sans-serif;max-width:36em;margin:4em auto;padding:0 1em'>"
            f"<h1>Refused</h1><p>{escape(sentence)}</p></body></html>"
        )
    else:
        handler.finish()
    raise Finish
