"""`neeco view CAPTURE`: a recording before training: its images with the instruments' axes, cameras, tracks, points."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.model import Frame
from neeco.labels.drawing import to_numpy
from neeco.viewer.access import HOST, PORT
from neeco.viewer.panel import message_html
from neeco.viewer.runs import VIEWER, median_distance
from neeco.viewer.server import ViserPage
from neeco.viewer.views import Overlays, aspect_of, browser_camera, fitting_view, jump, stands_at, wxyz_of

if TYPE_CHECKING:
    import viser


UNREGISTERED = "instruments are not shown: their poses are not in the cameras' frame"


class RecordingServer(ViserPage):
    """A server that shows a capture."""

    def __init__(self, root: Path, host: str = HOST, port: int = PORT) -> None:
        """Raises NeecoError."""
        self.capture = read_capture(root)
        points, frames = self.capture.points.positions, self.capture.frames
        middle = [np.median(points, 0)] if len(points) else None
        self.distance = median_distance(
            (frame.camera, middle or [to_numpy(item.pose)[:3, 3] for item in frame.state.instruments.values()])
            for frame in frames
        )
        self.unit = VIEWER.distance_units / self.distance
        super().__init__(host, port, [frame.camera for frame in frames], self.distance, self.unit)
        self.sessions: dict[int, RecordingSession] = {}
        self._server.on_client_connect(
            lambda client: self.sessions.update({client.client_id: RecordingSession(client, self)})
        )
        self._server.on_client_disconnect(lambda client: self.sessions.pop(client.client_id, None))


class RecordingSession:
    """One browser's view of a capture. viser draws everything over the image of the frame whose camera it stands at."""

    def __init__(self, client: viser.ClientHandle, server: RecordingServer) -> None:
        capture, unit = server.capture, server.unit
        self._client, self._capture, self._unit, self._distance = client, capture, unit, server.distance
        self._lock, self._shown = threading.RLock(), (-1, 0.0)
        gui, scene, cameras = client.gui, client.scene, [frame.camera for frame in capture.frames]
        overlays = Overlays(client, cameras, capture.points, unit, self.go_to, lambda: None)
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        with gui.add_folder("Recording"):
            self.frame = gui.add_slider("frame", 0, max(1, len(cameras) - 1), 1, 0, disabled=len(cameras) == 1)
            self._follows = gui.add_checkbox("camera of the frame", True)
            back = gui.add_button("go to this frame's camera")
            paths, cones = gui.add_checkbox("tracks", False), gui.add_checkbox("recorded cameras", False)
            points = gui.add_checkbox("sparse points", False, disabled=overlays.points is None)
            self._status = gui.add_html("")
        tracks = scene.add_frame("/tracks", show_axes=False, visible=False)
        self.axes = {}
        for number, name in enumerate(item.name for item in capture.instruments if capture.registered):
            tracked = [frame.state.instruments.get(name) for frame in capture.frames]
            places = [to_numpy(item.pose)[:3, 3] * unit for item in tracked if item is not None]
            path = np.array(places, np.float32).reshape(-1, 3)
            color = VIEWER.track_colors[number % len(VIEWER.track_colors)]
            ends = np.stack([path[:-1], path[1:]], 1)
            if len(ends):
                scene.add_line_segments(f"/tracks/{number}", ends, color, thickness=2, thickness_units="screen")
            self.axes[name] = scene.add_frame(
                f"/axes/{number}", axes_length=VIEWER.axis_units, axes_radius=VIEWER.axis_units / 25
            )
        paths.on_update(lambda _: setattr(tracks, "visible", paths.value))
        for handle in (cones, points):
            handle.on_update(lambda _: overlays.show(cones.value, points.value))
        self.frame.on_update(lambda _: self.show(self._follows.value))
        back.on_click(lambda _: self.show(True))
        client.camera.on_update(lambda _: self._show_image())
        self.show(True)

    def go_to(self, frame: int) -> None:
        """Show a frame, from its camera."""
        self.frame.value = frame
        self.show(True)

    def show(self, jumping: bool) -> None:
        """Show the slider's frame: its axes, its image where the window stands at its camera. jumping: there first."""
        with self._lock:
            frame = self._capture.frames[self._index]
            if jumping:
                jump(self._client, frame.camera, self._unit, self._distance)
            for name, axes in self.axes.items():
                axes.visible = name in frame.state.instruments
                if axes.visible:
                    pose = to_numpy(frame.state.instruments[name].pose)
                    axes.wxyz, axes.position = wxyz_of(pose), pose[:3, 3] * self._unit
            self._show_image()

    @property
    def _index(self) -> int:
        """The slider's frame, whatever a browser said."""
        return int(np.clip(np.nan_to_num(self.frame.value), 0, len(self._capture.frames) - 1))

    def _show_image(self) -> None:
        """Put the frame's image behind the scene where the window stands at its camera; elsewhere, nothing."""
        with self._lock:
            index, window = self._index, self._client.camera
            frame, aspect = self._capture.frames[index], aspect_of(window)
            with contextlib.suppress(ValueError):  # a camera that is none
                if not stands_at(browser_camera(window, self._unit, VIEWER.image_px), frame.camera, self._distance):
                    aspect = 0.0
            if (index, aspect) == self._shown:
                return
            self._shown = index, aspect
            picture, note = None, "" if self._capture.registered else "; " + UNREGISTERED
            try:
                if aspect:
                    picture, window.fov = image_behind(frame, aspect), fitting_view(frame.camera, aspect)
            except NeecoError as error:
                note = f"; {error}"
            self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)
            self._status.content = message_html(f"{frame.name}, {frame.split}, {frame.state.time:.2f} s{note}")


def image_behind(frame: Frame, aspect: float) -> np.ndarray:
    """The image as a window of that width by height shows it, uint8 [H, W, 3]: its principal point in the middle, as
    viser has it. Raises NeecoError."""
    camera = frame.camera
    image = (frame.load_image().numpy() * 255).round().astype(np.uint8)
    focal = VIEWER.image_px / 2 / np.tan(fitting_view(camera, aspect) / 2)
    size = max(1, round(VIEWER.image_px * aspect)), VIEWER.image_px
    across, down = focal / camera.fx, focal / camera.fy
    place = np.array([[across, 0, size[0] / 2 - across * camera.cx], [0, down, size[1] / 2 - down * camera.cy]])
    place[:, 2] += (place[:, :2].sum(1) - 1) / 2  # OpenCV counts from the first pixel's centre
    return cv2.warpAffine(image, place, size, flags=cv2.INTER_LINEAR)
