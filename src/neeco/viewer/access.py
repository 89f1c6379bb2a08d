"""Addresses and access control of all servers of `neeco view`: every request needs the token in the address.

The token is the first part of the path of the page, its pictures and its web socket. Unlike a cookie, the browser does
not add it to requests by itself: a page of another site, which does not know it, has no access under any name.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import dataclasses
import hashlib
import hmac
import http
import ipaddress
import logging
import re
import secrets
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from neeco.base.errors import NeecoError

HOST, PORT = "127.0.0.1", 8080
TOKEN_BYTES = 24
MAX_MESSAGE = 2**20  # maximum size of a message in bytes; a browser's have some hundred
MAX_PORTS = 100  # maximum number of ports tried, in sequence
INLINE_SCRIPT = re.compile(rb"<script[^>]*>(.*?)</script>", re.DOTALL)
REFUSED = "neeco view: refused: open the whole address that neeco view printed\n"

log = logging.getLogger(__name__)
quiet = log.getChild("connections")  # logger of websockets, which logs a traceback for every browser that disconnects
quiet.setLevel(logging.CRITICAL)

Respond = Callable[[Any, Any], Any]  # (connection, request) -> response, or None: a web socket


@dataclass(frozen=True)
class Access:
    """The address of a server, and its access control."""

    host: str
    port: int
    token: str

    @classmethod
    def at(cls, host: str, port: int) -> Access:
        """Return the access of a server on `host` and `port`, or the next free one, with a new token. Raises
        NeecoError."""
        host = host.strip("[]")
        last = None
        if not 0 < port < 65536:
            raise NeecoError(f"--port must be 1 to 65535 (got {port})")
        for candidate in range(port, min(port + MAX_PORTS, 65536)):
            try:
                socket.create_server((host, candidate), family=family_of(host)).close()
                return cls(host, candidate, secrets.token_urlsafe(TOKEN_BYTES))
            except (socket.gaierror, UnicodeError) as error:
                raise NeecoError(f"--host: {host!r} is unknown ({error}); give a name or address") from None
            except OSError as error:
                last = error
        raise NeecoError(f"--host: {host}: --port {port} and the next ones: {last}; give others")

    @property
    def address(self) -> str:
        """Return the address to open in a browser."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self.token}/"

    def controlled(self, respond: Respond) -> Respond:
        """Return `respond` restricted to requests with the token; it gets the path without it."""

        def answer(connection: Any, request: Any) -> Any:
            token, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
            # a path holds any bytes, as surrogates
            if not hmac.compare_digest(token.encode(errors="replace"), self.token.encode()):
                return connection.respond(http.HTTPStatus.FORBIDDEN, REFUSED)
            try:
                response = respond(connection, dataclasses.replace(request, path=f"/{path}"))
                if response is not None:
                    for name, value in _page_headers(response.body, request.headers["Host"]).items():
                        response.headers[name] = value
            except (LookupError, OSError, ValueError):  # duplicate header, or an invalid file name
                return connection.respond(http.HTTPStatus.BAD_REQUEST, "neeco view: not understood\n")
            return response

        return answer


def family_of(host: str) -> socket.AddressFamily:
    """Return the address family of a host."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def is_loopback(host: str) -> bool:
    """Return whether `--host` is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


@contextlib.contextmanager
def controlled_sockets(access: Access, head: bytes) -> Iterator[list[bool]]:
    """Make a server opened by `websockets` inside the block answer as `access` allows; its pages begin with `head`.
    viser has no setting for that, so `websockets.serve` is replaced. Yields a list that is empty until one is
    opened."""
    import websockets.asyncio.server as websocket_server

    opened: list[bool] = []
    serve = websocket_server.serve

    def serve_controlled(*args: Any, process_request: Respond, **named: Any) -> Any:
        opened.append(True)
        # a message that asks for what cannot be fails in a task of its own
        asyncio.get_running_loop().set_exception_handler(
            lambda _, context: log.warning(
                "neeco view: a browser's message was not understood (%r)", context.get("exception")
            )
        )

        def respond(connection: Any, request: Any) -> Any:
            request.headers.pop("Accept-Encoding", None)  # so that pages can be read
            response = process_request(connection, request)
            if response is not None:
                response.body = response.body.replace(b"<head>", b"<head>" + head, 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            return response

        ours = {"process_request": access.controlled(respond), "max_size": MAX_MESSAGE, "logger": quiet}
        return serve(*args, **named | ours)

    websocket_server.serve = serve_controlled
    try:
        yield opened
    finally:
        websocket_server.serve = serve


def _page_headers(page: bytes, host: str) -> dict[str, str]:
    """Return headers of a page that allow its own scripts and nothing injected; it connects to nothing else, and
    reveals its address to nobody."""
    scripts = [base64.b64encode(hashlib.sha256(text).digest()).decode() for text in INLINE_SCRIPT.findall(page)]
    allowed = " ".join(f"'sha256-{digest}'" for digest in scripts)
    policy = (
        f"default-src 'none'; script-src {allowed} 'strict-dynamic' 'wasm-unsafe-eval' blob:; worker-src blob:; "
        f"style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; "
        f"connect-src 'self' ws://{host} data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
