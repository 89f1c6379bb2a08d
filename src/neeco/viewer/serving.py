"""viser's web server, with a guard at its door and no way out: no tunnel, no other host."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import http
import io
import logging
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from neeco.errors import NeecoError
from neeco.viewer.guard import Guard

if TYPE_CHECKING:
    import viser

MISSING = "view: needs viser; install neeco[view]"
MOST_BROWSERS = 32  # at once
LARGEST_MESSAGE = 2**20  # bytes; a browser says what was moved, in some hundred

log = logging.getLogger(__name__)


def require_viser() -> None:
    """Raises NeecoError where viser is not installed, or is too old."""
    try:
        import viser
    except ImportError:
        raise NeecoError(MISSING) from None
    if tuple(int(part) for part in viser.__version__.split(".")[:2]) < (1, 1):
        raise NeecoError(f"view: viser {viser.__version__} is too old; install neeco[view], or viser>=1.1,<2")


def guarded_server(guard: Guard, host: str, port: int) -> viser.ViserServer:
    """A server whose every request the guard has let through. Raises NeecoError."""
    require_viser()
    import viser

    class Server(viser.ViserServer):
        """Never asks for a tunnel, whoever wants one: a browser may send that wish without any button."""

        def request_share_url(self, verbose: bool = True) -> None:
            return None

    # viser's own banner would name an address without the token
    with _at_the_door(guard) as used, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=port, label="neeco", verbose=False)
    if not used:
        stop(server)
        raise NeecoError(
            f"view: viser {viser.__version__} opens its port in a way that is not known; install viser 1.1"
        )
    return server


def stop(server: viser.ViserServer) -> None:
    """Stop it, without its farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _at_the_door(guard: Guard) -> Iterator[list[bool]]:
    """Until the end of the block a web socket server that is opened asks the guard first. viser offers no place for
    that. Yields a list that is empty as long as none was opened."""
    import websockets.asyncio.server as door

    opened: list[bool] = []
    serve = door.serve

    def guarded(handler: Callable[..., Any], *given: Any, process_request: Callable[..., Any], **named: Any) -> Any:
        opened.append(True)

        def asked(connection: Any, request: Any) -> Any:
            headers: dict[str, list[str]] = {}
            for name, value in request.headers.raw_items():
                headers.setdefault(name.lower(), []).append(value)
            reason = guard.why_refused(request.path, headers)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"neeco view: refused: {reason}\n")
            if "upgrade" in headers and len(connection.server.connections) >= MOST_BROWSERS:
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "neeco view: too many browsers\n")
            try:
                response = process_request(connection, request)
            except (LookupError, OSError, ValueError):  # a header given twice, a name that no file can have
                return connection.respond(http.HTTPStatus.BAD_REQUEST, "neeco view: not understood\n")
            if response is not None:
                page = _plain(response.body, response.headers.get("Content-Encoding"))
                for name, value in guard.page_headers(request.path, page, headers["host"][0]).items():
                    response.headers[name] = value
            return response

        return serve(_patient(handler), *given, process_request=asked, **named | {"max_size": LARGEST_MESSAGE})

    door.serve = guarded
    try:
        yield opened
    finally:
        door.serve = serve


def _patient(handler: Callable[..., Any]) -> Callable[..., Any]:
    """viser's handler of a web socket: what it does not understand ends the connection, in a line and no traceback."""

    async def handle(connection: Any) -> None:
        # a message that is understood, but asks for what cannot be, fails in a task of its own
        asyncio.get_running_loop().set_exception_handler(lambda _, context: _note(context.get("exception")))
        try:
            await handler(connection)
        except Exception as error:
            _note(error)
            await connection.close(1002, "not understood")

    return handle


def _note(error: BaseException | None) -> None:
    log.warning("neeco view: a browser's message was not understood (%s)", type(error).__name__)
    log.debug("", exc_info=error)


def _plain(body: bytes, encoding: str | None) -> bytes:
    return gzip.decompress(body) if encoding == "gzip" else body
