"""`neeco view`: a web server that shows runs and lets them be steered, to every browser that comes."""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from neeco.errors import NeecoError
from neeco.labels.drawing import to_numpy
from neeco.viewer.guard import Guard, address_of, free_port, is_loopback
from neeco.viewer.serving import guarded_server, require_viser, stop
from neeco.viewer.studio import Studio
from neeco.viewer.visitor import Visitor
from neeco.viewer.window import field_of_view, upward

if TYPE_CHECKING:
    import viser

HOST, PORT = "127.0.0.1", 8080
MOST_RUNS = 2
TOKEN_BYTES = 24
HEARS_EVERY_S = 0.5


class Viewer:
    """A running server; `address` is what to open. Use as a context manager, or call `stop`."""

    def __init__(
        self, runs: Sequence[Path], host: str = HOST, port: int = PORT, device: torch.device | None = None
    ) -> None:
        """One run, or two to compare. port: or the next that is free. Raises NeecoError."""
        if not 1 <= len(runs) <= MOST_RUNS:
            raise NeecoError(f"view: {len(runs)} runs given; give one, or two to compare")
        require_viser()
        self.studio = Studio(runs, device)
        port = free_port(host, port)
        self.token = None if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES)
        self._server = guarded_server(Guard(self.token, f"neeco_{port}"), host, port)
        self.address = address_of(host, self._server.get_port(), self.token)
        self._prepare_scene()
        self._server.on_client_connect(self._come)
        self._server.on_client_disconnect(lambda client: self.studio.artist.leave(client.client_id))
        self.studio.start()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End the drawing, then the server."""
        self.studio.stop()
        stop(self._server)

    def wait(self) -> None:
        """Until Ctrl-C."""
        while True:  # in short waits: a signal that comes just before one begins is heard after it
            time.sleep(HEARS_EVERY_S)

    def _prepare_scene(self) -> None:
        """What all browsers share: which way is up, where a new one and the home button stand."""
        first, unit = self.studio.loaded[0], self.studio.unit
        camera = first.recorded.cameras[0]
        pose = to_numpy(camera.world_from_camera)
        scene, initial = self._server.scene, self._server.initial_camera
        scene.set_up_direction(tuple(upward(first)))
        scene.world_axes.visible = False
        initial.position = tuple(pose[:3, 3] * unit)
        initial.look_at = tuple((pose[:3, 3] + self.studio.distance * pose[:3, 2]) * unit)
        initial.up = tuple(-pose[:3, 1])
        initial.fov = field_of_view(camera)

    def _come(self, client: viser.ClientHandle) -> None:
        self.studio.artist.seat(Visitor(client, self.studio, lambda: client.client_id in self._server.get_clients()))
