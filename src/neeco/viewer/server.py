"""`neeco view`: a web server that shows a run and lets it be steered, to every browser that connects.

viser serves the page. Every request passes our access control first, and no tunnel or other host is ever asked for.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import http
import io
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch

from neeco.errors import NeecoError, install_hint
from neeco.geometry.camera import Camera
from neeco.labels.drawing import to_numpy
from neeco.synthesis.settings import RECORDED_SIZE, SizeSettings
from neeco.viewer.access import HOST, PORT, AccessControl, free_port, url_of
from neeco.viewer.runs import ViewedRun
from neeco.viewer.saving import SavedStates
from neeco.viewer.session import ClientSession, RenderThread
from neeco.viewer.viser_scene import field_of_view, upward

if TYPE_CHECKING:
    import viser

MISSING = f"view: needs viser; {install_hint('view')}"
MAX_BROWSERS = 32  # at once
# Keys on a focused slider are the slider's own. viser turns the camera by arrows that are pressed anywhere but in a
# form; it listens on the document, the slider within.
SLIDER_KEYS = b"""<script>
document.documentElement.addEventListener("keydown", event => {
  if (event.target.closest("[role=slider]")) event.stopPropagation();
});
</script>"""
MAX_MESSAGE = 2**20  # bytes; a browser's messages have some hundred
MAX_CONNECTIONS = 256  # at once, those that only load the page included

log = logging.getLogger(__name__)


class ViserPage:
    """viser's running server; `address` is what to open. Use as a context manager, or call `stop`."""

    def __init__(self, host: str, port: int, cameras: Sequence[Camera], distance: float, unit: float) -> None:
        """The up direction is that of the recorded `cameras`; a browser begins at the first, `distance` mm before what
        it looks at. unit: viser's per mm. Raises NeecoError."""
        require_viser()
        port = free_port(host, port)
        access = AccessControl.at(host, port)
        self.token = access.token
        self._server = _start_server(access, host.strip("[]"), port)
        self.address = url_of(host, self._server.get_port(), self.token)
        pose = to_numpy(cameras[0].world_from_camera)
        scene, initial = self._server.scene, self._server.initial_camera
        scene.set_up_direction(tuple(upward(cameras)))
        scene.world_axes.visible = False
        initial.position = tuple(pose[:3, 3] * unit)
        initial.look_at = tuple((pose[:3, 3] + distance * pose[:3, 2]) * unit)
        initial.up = tuple(-pose[:3, 1])
        initial.fov = field_of_view(cameras[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server."""
        _stop_server(self._server)


class ViewerServer(ViserPage):
    """A server that shows a run."""

    def __init__(
        self,
        run: Path,
        host: str = HOST,
        port: int = PORT,
        device: torch.device | None = None,
        size: SizeSettings = RECORDED_SIZE,
    ) -> None:
        """port: or the next that is free. size: of saved images, and sharp pictures are as high. Raises NeecoError."""
        require_viser()
        self.run = ViewedRun(run, device)
        cameras = self.run.loaded.recorded.cameras
        height = size.of(cameras[0].width, cameras[0].height)[1]
        self._sharp_px = None if size == RECORDED_SIZE else height
        self.saved = SavedStates(run, size)
        self.render_thread = RenderThread(self.run.advance_timeline)
        super().__init__(host, port, cameras, self.run.distance, self.run.unit)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(lambda client: self.render_thread.remove(client.client_id))
        self.render_thread.start()
        self.run.watch(self.render_thread.request)

    def stop(self) -> None:
        """End the rendering, then the server."""
        self.run.end_watch()
        self.render_thread.stop()
        super().stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        def connected() -> bool:
            return client.client_id in self._server.get_clients()

        session = ClientSession(client, self.run, self.saved, self.render_thread, connected, self._sharp_px)
        self.render_thread.add(session)


def require_viser() -> None:
    """Raises NeecoError where viser is not installed, or is too old."""
    try:
        import viser
    except ImportError:
        raise NeecoError(MISSING) from None
    if tuple(int(part) for part in viser.__version__.split(".")[:2]) < (1, 1):
        raise NeecoError(
            f"view: viser {viser.__version__} is too old; {install_hint('view')}, or install viser>=1.1,<2"
        )


def _start_server(access: AccessControl, host: str, port: int) -> viser.ViserServer:
    """viser's server, whose every request `access` has allowed. Raises NeecoError."""
    import viser

    class Server(viser.ViserServer):
        """Never asks for a tunnel: a browser may request one without any button."""

        def request_share_url(self, verbose: bool = True) -> None:
            return None

    # viser's own banner would name an address without the token
    with _controlled_sockets(access) as opened, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=host, port=port, label="neeco", verbose=False)
    if not opened:
        _stop_server(server)
        raise NeecoError(
            f"view: viser {viser.__version__} opens its port in a way that is not known; install viser 1.1"
        )
    return server


def _stop_server(server: viser.ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):  # without viser's farewell
        server.stop()


@contextlib.contextmanager
def _controlled_sockets(access: AccessControl) -> Iterator[list[bool]]:
    """Inside the block, a web socket server that is opened asks `access` about every request. viser has no setting for
    that, so `websockets.serve` is replaced. Yields a list that is empty as long as none was opened."""
    import websockets.asyncio.server as websocket_server

    opened: list[bool] = []
    serve = websocket_server.serve

    def serve_controlled(
        handler: Callable[..., Any], *given: Any, process_request: Callable[..., Any], **named: Any
    ) -> Any:
        opened.append(True)

        def answer(connection: Any, request: Any) -> Any:
            headers: dict[str, list[str]] = {}
            for name, value in request.headers.raw_items():
                headers.setdefault(name.lower(), []).append(value)
            reason = access.refusal(request.path, headers)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"neeco view: refused: {reason}\n")
            if "upgrade" in headers and len(connection.server.connections) >= MAX_BROWSERS:
                return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "neeco view: too many browsers\n")
            try:
                response = process_request(connection, request)
            except (LookupError, OSError, ValueError):  # a header given twice, a name that no file can have
                return connection.respond(http.HTTPStatus.BAD_REQUEST, "neeco view: not understood\n")
            if response is not None:
                packed = response.headers.get("Content-Encoding") == "gzip"
                page = gzip.decompress(response.body) if packed else response.body
                if b"<head>" in page:
                    page = page.replace(b"<head>", b"<head>" + SLIDER_KEYS, 1)
                    response.body = gzip.compress(page) if packed else page
                    del response.headers["Content-Length"]
                    response.headers["Content-Length"] = str(len(response.body))
                for name, value in access.page_headers(request.path, page, headers["host"][0]).items():
                    response.headers[name] = value
            return response

        class Connection(websocket_server.ServerConnection):
            """One of a bounded number."""

            refused = False

            def connection_made(self, transport: Any) -> None:
                self.refused = len(self.server.handlers) >= MAX_CONNECTIONS
                if self.refused:
                    transport.abort()
                else:
                    super().connection_made(transport)

            def connection_lost(self, error: Exception | None) -> None:
                if not self.refused:
                    super().connection_lost(error)

        ours = {"max_size": MAX_MESSAGE, "create_connection": Connection, "logger": _connection_log()}
        return serve(_closing_on_error(handler), *given, process_request=answer, **named | ours)

    websocket_server.serve = serve_controlled
    try:
        yield opened
    finally:
        websocket_server.serve = serve


def _connection_log() -> logging.Logger:
    """The log of connections, without tracebacks: a line for a browser that goes away or is not understood."""
    connections = log.getChild("connections")

    def shorten(record: logging.LogRecord) -> bool:
        if record.exc_info and (error := record.exc_info[1]) is not None:
            record.msg, record.args = "neeco view: a browser's connection ended (%s)", (type(error).__name__,)
            record.exc_info = None
            return not isinstance(error.__cause__, EOFError)  # opened, and left without a request
        return True

    if not connections.filters:
        connections.addFilter(shorten)
    return connections


def _closing_on_error(handler: Callable[..., Any]) -> Callable[..., Any]:
    """viser's handler of a web socket: what it does not understand ends the connection, in a line and no traceback."""

    async def handle(connection: Any) -> None:
        # a message that is understood, but asks for what cannot be, fails in a task of its own
        asyncio.get_running_loop().set_exception_handler(
            lambda _, context: _log_misunderstood(context.get("exception"))
        )
        try:
            await handler(connection)
        except Exception as error:
            _log_misunderstood(error)
            await connection.close(1002, "not understood")

    return handle


def _log_misunderstood(error: BaseException | None) -> None:
    log.warning("neeco view: a browser's message was not understood (%s)", type(error).__name__)
    log.debug("", exc_info=error)
