"""`neeco view`: a web server that shows a run and lets it be steered, to every browser that connects.

viser serves the page; `access` decides who gets it, and no tunnel or other host is ever asked for.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from neeco.base.errors import NeecoError, install_hint
from neeco.geometry.camera import Camera
from neeco.labels.drawing import to_numpy
from neeco.synthesis.settings import RECORDED_SIZE, SizeSettings
from neeco.viewer.access import HOST, PORT, Access, controlled_sockets
from neeco.viewer.runs import ViewedRun
from neeco.viewer.saving import SavedStates
from neeco.viewer.session import ClientSession, RenderThread
from neeco.viewer.viser_scene import field_of_view, upward

if TYPE_CHECKING:
    import viser

# Keys on a focused slider are the slider's own. viser turns the camera by arrows that are pressed anywhere but in a
# form; it listens on the document, the slider within.
SLIDER_KEYS = b"""<script>
document.documentElement.addEventListener("keydown", event => {
  if (event.target.closest("[role=slider]")) event.stopPropagation();
});
</script>"""


class ViserPage(contextlib.AbstractContextManager["ViserPage"]):
    """viser's running server; `address` is what to open. Use as a context manager, or call `stop`."""

    def __init__(self, host: str, port: int, cameras: Sequence[Camera], distance: float, unit: float) -> None:
        """The up direction is that of the recorded `cameras`; a browser begins at the first, `distance` mm before what
        it looks at. unit: viser's per mm. Raises NeecoError."""
        access = Access.at(host, port)
        self.address = access.address
        try:
            import viser
        except ImportError:
            raise NeecoError(f"view: needs viser 1.1; {install_hint('view')}") from None

        class Server(viser.ViserServer):
            """Never asks for a tunnel: a browser may request one without any button."""

            def request_share_url(self, verbose: bool = True) -> None:
                return None

        # viser's own banner would name an address without the token
        with controlled_sockets(access, SLIDER_KEYS) as opened, contextlib.redirect_stdout(io.StringIO()):
            self._server = Server(host=access.host, port=access.port, label="neeco", verbose=False)
        if not opened:
            ViserPage.stop(self)
            raise NeecoError(f"view: viser {viser.__version__} is too old or too new; {install_hint('view')}")
        pose = to_numpy(cameras[0].world_from_camera)
        scene, initial = self._server.scene, self._server.initial_camera
        scene.set_up_direction(tuple(upward(cameras)))
        scene.world_axes.visible = False
        initial.position = tuple(pose[:3, 3] * unit)
        initial.look_at = tuple((pose[:3, 3] + distance * pose[:3, 2]) * unit)
        initial.up = tuple(-pose[:3, 1])
        initial.fov = field_of_view(cameras[0])

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the server."""
        with contextlib.redirect_stdout(io.StringIO()):  # without viser's farewell
            self._server.stop()


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
        self.run = ViewedRun(run, device)
        cameras = self.run.loaded.recorded.cameras
        height = size.of(cameras[0].width, cameras[0].height)[1]
        self._sharp_px = None if size == RECORDED_SIZE else height
        self.saved = SavedStates(run, size)
        self.render_thread = RenderThread(lambda: self.run.timeline.advance())
        super().__init__(host, port, cameras, self.run.distance, self.run.unit)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(lambda client: self.render_thread.remove(client.client_id))
        self.render_thread.start()
        self.run.watch(self.render_thread.request)

    def stop(self) -> None:
        """End the rendering, then the server."""
        self.run.ended.set()
        self.render_thread.stop()
        super().stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        def connected() -> bool:
            return client.client_id in self._server.get_clients()

        session = ClientSession(client, self.run, self.saved, self.render_thread, connected, self._sharp_px)
        self.render_thread.add(session)
