"""`neeco view CAPTURE --annotate`: a small web server with the page on which a person poses frames by hand.

The page asks over its web socket: a JSON object {"ask": what, ...} is answered by another, in order.
"""

from __future__ import annotations

import base64
import json
import threading
from functools import cache
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import require_like
from neeco.viewer.access import HOST, MAX_MESSAGE, PORT, Access, family_of, quiet
from neeco.viewer.posing_session import PosingSession

STATE = {"roll": float, "joints": {str: float}}  # degrees
FIELDS: dict[str, dict[str, Any]] = {  # of what a page may ask
    "overview": {},
    "frame": {"index": int},
    "picture": {"index": int, "small": bool},
    "ghost": {"index": int, **STATE},
    "save": {"index": int, **STATE},
    "undo": {},
}


class PosingServer:
    """A running server; `address` is what to open. Use as a context manager, or call `stop`."""

    def __init__(self, folder: Path, host: str = HOST, port: int = PORT) -> None:
        """folder: a capture, or a run of one. port: or the next that is free. Raises NeecoError."""
        try:
            from websockets.sync.server import serve
        except ImportError:
            raise NeecoError(f"view: needs viser; {install_hint('view')}") from None
        self.session = PosingSession(folder)
        access = Access.at(host, port)
        self.address = access.address
        self._server = serve(
            self._converse,
            access.host,
            access.port,
            family=family_of(access.host),
            process_request=access.controlled(_respond),
            max_size=MAX_MESSAGE,
            logger=quiet,
        )
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> PosingServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._thread.join()

    def _converse(self, connection: Any) -> None:
        """Answer all that one page asks."""
        for message in connection:
            try:
                answer = self._answer(json.loads(message))
            except (NeecoError, ValueError, RecursionError) as error:
                answer = {"error": str(error)}
            connection.send(json.dumps(answer, allow_nan=False))

    def _answer(self, asked: Any) -> dict[str, Any]:
        """Answer one question of a page. Raises NeecoError."""
        session, remedy = self.session, "reload the page"
        ask = require_like(asked, {"ask": str}, "page", remedy)["ask"]
        if ask not in FIELDS:
            raise NeecoError(f"page: ask: {ask!r} is unknown; {remedy}")
        given = require_like(asked, {"ask": str, "instrument": str, **FIELDS[ask]}, "page", remedy)
        instrument = given["instrument"] or session.instruments[0]
        if ask == "overview":
            return session.overview(instrument)
        if ask == "undo":
            return session.undo(instrument)
        if ask == "frame":
            return session.frame(instrument, given["index"])
        if ask == "save":
            return session.save(instrument, given["index"], given["roll"], given["joints"])
        if ask == "picture":
            return _as_uri(session.picture(instrument, given["index"], given["small"]), "jpeg")
        return _as_uri(session.ghost(instrument, given["index"], given["roll"], given["joints"]), "png")


@cache
def page() -> bytes:
    """The page, one file of HTML."""
    folder = files("neeco.viewer") / "posing_page"
    html, style, script = (folder.joinpath(f"page.{kind}").read_text("utf-8") for kind in ("html", "css", "js"))
    return html.replace("{{ style }}", style).replace("{{ script }}", script).encode()


def _respond(connection: Any, request: Any) -> Any:
    """The page, or None for its web socket."""
    if "Upgrade" in request.headers:
        return None
    if request.path != "/":
        return connection.respond(HTTPStatus.NOT_FOUND, "neeco view: no such page\n")
    response = connection.respond(HTTPStatus.OK, page().decode())
    del response.headers["Content-Type"]
    response.headers["Content-Type"] = "text/html; charset=utf-8"
    return response


def _as_uri(image: bytes, kind: str) -> dict[str, str]:
    return {"picture": f"data:image/{kind};base64,{base64.b64encode(image).decode()}"}
