"""`neeco view CAPTURE --annotate`: a small web server with the page on which a person poses frames by hand.

Every request passes the same access control as the viewer of runs; the page loads nothing from elsewhere.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import socket
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from neeco.errors import NeecoError
from neeco.files import require_like
from neeco.viewer.access import HOST, PORT, AccessControl, free_port, resolved, url_of
from neeco.viewer.posing_session import PosingSession

MAX_BODY, MAX_REQUEST = 2**16, 2**17  # bytes: of a request's body, and of all of it
MAX_CONNECTIONS = 64  # at once; a browser opens six
WAIT_S = 20.0  # for a whole request, and for a browser to take an answer
STATE = {"roll": float, "joints": {str: float}}  # degrees
ANSWER = {"instrument": str, "frame": int, **STATE}

log = logging.getLogger(__name__)


class PosingServer:
    """A running server; `address` is what to open. Use as a context manager, or call `stop`."""

    def __init__(self, folder: Path, host: str = HOST, port: int = PORT) -> None:
        """folder: a capture, or a run of one. port: or the next that is free. Raises NeecoError."""
        self.session = PosingSession(folder)
        port = free_port(host, port)
        access = AccessControl.at(host, port)
        handler = type("Handler", (_Handler,), {"session": self.session, "access": access})
        self._server = _Server(resolved(host, port), handler)
        self.address = url_of(host, port, access.token)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> PosingServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@cache
def page() -> bytes:
    """The page, one file of HTML."""
    folder = files("neeco.viewer") / "posing_page"
    html, style, script = (folder.joinpath(f"page.{kind}").read_text("utf-8") for kind in ("html", "css", "js"))
    return html.replace("{{ style }}", style).replace("{{ script }}", script).encode()


class _Server(ThreadingHTTPServer):
    """Serves a bounded number of connections, each in a thread; what goes wrong with one is a line in the log."""

    def __init__(
        self, place: tuple[socket.AddressFamily, tuple[Any, ...]], handler: type[BaseHTTPRequestHandler]
    ) -> None:
        self.address_family, address = place
        self._free = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            log.warning("neeco view: more than %d connections at once; one was closed", MAX_CONNECTIONS)
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        error = sys.exc_info()[1]
        went = isinstance(error, ConnectionError | TimeoutError)
        log.warning("neeco view: a browser %s (%s)", "went away" if went else "got no answer", type(error).__name__)
        log.debug("", exc_info=error)


class _RequestBytes(io.RawIOBase):
    """Bytes that a connection sends, bounded in number and time for every request."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self.expect()

    def expect(self) -> None:
        """Begin with another request."""
        self._left, self._until = MAX_REQUEST, time.monotonic() + WAIT_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        wait = self._until - time.monotonic()
        if wait <= 0 or self._left <= 0:
            raise TimeoutError("too long a request")  # the handler ends the connection
        self._connection.settimeout(wait)
        count = self._connection.recv_into(buffer)
        self._left -= count
        return count


class _Handler(BaseHTTPRequestHandler):
    """Answers one browser's requests."""

    session: PosingSession
    access: AccessControl
    timeout = WAIT_S
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "neeco", ""

    def setup(self) -> None:
        super().setup()
        self._requested = _RequestBytes(self.connection)
        self.rfile = io.BufferedReader(self._requested)

    def handle_one_request(self) -> None:
        self._requested.expect()
        super().handle_one_request()

    def do_GET(self) -> None:
        if not self._allowed():
            return
        if self._body_length() != 0:
            self._refuse("a GET has no body", HTTPStatus.BAD_REQUEST)
            return
        address = urlsplit(self.path)
        given = {name: values[-1] for name, values in parse_qs(address.query).items()}
        session = self.session
        instrument = given.get("instrument", session.instruments[0])
        if address.path == "/":
            self._send(page(), "text/html; charset=utf-8")
        elif address.path == "/overview":
            self._answer(lambda: session.overview(instrument))
        elif address.path == "/frame":
            self._answer(lambda: session.frame(instrument, _whole(given.get("index"))))
        elif address.path == "/picture":
            self._show(lambda: session.picture(instrument, _whole(given.get("index")), "small" in given), "image/jpeg")
        elif address.path == "/ghost":
            self._show(lambda: self._ghost(instrument, given), "image/png")
        else:
            self._send(b"neeco view: no such page\n", "text/plain", HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        # a form on another site cannot send JSON without asking first
        if not self._allowed(self.headers.get("Content-Type") == "application/json"):
            return
        length = self._body_length()
        if length is None or length > MAX_BODY:
            self._refuse("not understood", HTTPStatus.BAD_REQUEST)
            return
        body = self.rfile.read(length)
        value = _json(body)
        path = urlsplit(self.path).path
        if path == "/save":
            self._answer(lambda: self._save(value))
        elif path == "/undo":
            self._answer(lambda: self._undo(value))
        else:
            self._send(b"neeco view: no such page\n", "text/plain", HTTPStatus.NOT_FOUND)

    def _ghost(self, instrument: str, given: dict[str, str]) -> bytes:
        state = require_like(_json(given.get("state", "")), STATE, "state", "send it anew")
        return self.session.ghost(instrument, _whole(given.get("index")), state["roll"], state["joints"])

    def _save(self, value: Any) -> dict[str, Any]:
        given = require_like(value, ANSWER, "answer", "send it anew")
        return self.session.save(given["instrument"], given["frame"], given["roll"], given["joints"])

    def _undo(self, value: Any) -> dict[str, Any]:
        return self.session.undo(require_like(value, {"instrument": str}, "undo", "send it anew")["instrument"])

    def _allowed(self, plain: bool = True) -> bool:
        headers = {name.lower(): self.headers.get_all(name, []) for name in self.headers.keys()}  # noqa: SIM118
        reason = self.access.refusal(self.path, headers) if plain else "expected application/json"
        if reason is not None:
            self._refuse(f"refused: {reason}", HTTPStatus.FORBIDDEN)
        return reason is None

    def _body_length(self) -> int | None:
        """Bytes of the request's body; None where it does not say, or says it twice."""
        lengths = self.headers.get_all("Content-Length", ["0"])
        plain = len(lengths) == 1 and lengths[0].isdecimal() and "Transfer-Encoding" not in self.headers
        return int(lengths[0][:9]) if plain else None

    def _refuse(self, reason: str, status: HTTPStatus) -> None:
        """Send a line and end the connection: what follows would be taken for the next request."""
        self.close_connection = True
        self._send(f"neeco view: {reason}\n".encode(), "text/plain", status)
        with contextlib.suppress(OSError):  # a connection closed upon unread bytes takes the answer along
            self.connection.shutdown(socket.SHUT_WR)
            while self.rfile.read1():
                pass

    def _answer(self, ask: Callable[[], dict[str, Any]]) -> None:
        """Send what `ask` returns as JSON, or what is wrong."""
        try:
            value, status = ask(), HTTPStatus.OK
        except NeecoError as error:
            value, status = {"error": str(error)}, HTTPStatus.BAD_REQUEST
        self._send(json.dumps(value, allow_nan=False).encode(), "application/json", status)

    def _show(self, render: Callable[[], bytes], kind: str) -> None:
        """Send the picture that `render` returns, or what is wrong."""
        try:
            pixels = render()
        except NeecoError as error:
            self._send(f"{error}\n".encode(), "text/plain; charset=utf-8", HTTPStatus.NOT_FOUND)
        else:
            self._send(pixels, kind)

    def _send(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.connection.settimeout(WAIT_S)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        if status == HTTPStatus.OK:
            html = body if kind.startswith("text/html") else b""
            for name, value in self.access.page_headers(self.path, html, self.headers["Host"]).items():
                self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        log.debug(format, *args)


def _json(text: str | bytes) -> Any:
    """Value of a JSON text; None for any other text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _whole(text: str | None) -> int:
    """Number of a frame; -1, which no frame has, for any other text."""
    return int(text) if text is not None and text.isdecimal() and len(text) < 10 else -1
