"""`neeco view CAPTURE`: a recording before training: its images with the instruments' axes, cameras, tracks, points."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from neeco.capture import read_capture
from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.labels.drawing import to_numpy
from neeco.viewer.access import HOST, PORT
from neeco.viewer.panel import message_html
from neeco.viewer.runs import ASSUMED_MM, DISTANCE_UNITS
from neeco.viewer.server import ViserPage
from neeco.viewer.viser_scene import Overlays, aspect_of, browser_camera, fitting_view, jump, stands_at, wxyz_of

if TYPE_CHECKING:
    import viser

IMAGE_PX = 720  # high at most, of the image behind the scene
AXIS_UNITS = 0.1 * DISTANCE_UNITS
TRACK_COLORS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167))


class RecordingServer(ViserPage):
    """A server that shows a capture."""

    def __init__(self, root: Path, host: str = HOST, port: int = PORT) -> None:
        """Raises NeecoError."""
        self.capture = read_capture(root)
        self.distance = _distance(self.capture)
        self.unit = DISTANCE_UNITS / self.distance
        super().__init__(host, port, [frame.camera for frame in self.capture.frames], self.distance, self.unit)
        self.sessions: dict[int, RecordingSession] = {}
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(lambda client: self.sessions.pop(client.client_id, None))

    def _connect(self, client: viser.ClientHandle) -> None:
        self.sessions[client.client_id] = RecordingSession(client, self.capture, self.unit, self.distance)


class RecordingSession:
    """One browser's view of a capture. viser draws everything over the image of the frame whose camera it stands at."""

    def __init__(self, client: viser.ClientHandle, capture: Capture, unit: float, distance: float) -> None:
        self._client, self._capture, self._unit, self._distance = client, capture, unit, distance
        self._lock = threading.RLock()
        self._shown: tuple[object, ...] = ()
        cameras = [frame.camera for frame in capture.frames]
        self.overlays = Overlays(client, cameras, capture.points, unit, self.go_to, lambda: None)
        client.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        with client.gui.add_folder("Recording"):
            last = max(1, len(cameras) - 1)
            self.frame = client.gui.add_slider("frame", 0, last, 1, 0, disabled=len(cameras) == 1)
            self.follows = client.gui.add_checkbox("camera of the frame", True)
            back = client.gui.add_button("go to this frame's camera")
            shown = {name: client.gui.add_checkbox(name, on) for name, on in (("axes", True), ("tracks", False))}
            cones = client.gui.add_checkbox("recorded cameras", False)
            points = client.gui.add_checkbox("sparse points", False, disabled=self.overlays.points is None)
            self.status = client.gui.add_html("")
        names = [item.name for item in capture.instruments] if capture.registered else []
        scene, width = client.scene, AXIS_UNITS / 25
        tracks = scene.add_frame("/tracks", show_axes=False, visible=False)
        self._axes = [
            scene.add_frame(f"/axes/{k}", axes_length=AXIS_UNITS, axes_radius=width) for k in range(len(names))
        ]
        for number, name in enumerate(names):
            self._add_track(number, name)
        self._names, self._axes_shown = names, shown["axes"]
        for handle in (self.frame, shown["axes"]):
            handle.on_update(lambda _: self.show())
        shown["tracks"].on_update(lambda _: setattr(tracks, "visible", shown["tracks"].value))
        for handle in (cones, points):
            handle.on_update(lambda _: self.overlays.show(cones.value, points.value))
        back.on_click(lambda _: self.go_to(int(self.frame.value)))
        client.camera.on_update(lambda _: self._show_image())
        self.show()

    def go_to(self, frame: int) -> None:
        """Stand at a frame's camera, and show that frame."""
        self.frame.value = frame
        jump(self._client, self._capture.frames[frame].camera, self._unit, self._distance)
        self.show()

    def show(self) -> None:
        """Show the frame of the slider: its axes, its image, what it is."""
        with self._lock:
            index = int(np.clip(self.frame.value, 0, len(self._capture.frames) - 1))
            frame = self._capture.frames[index]
            if self.follows.value:
                jump(self._client, frame.camera, self._unit, self._distance)
            for name, axes in zip(self._names, self._axes, strict=True):
                item = frame.state.instruments.get(name)
                axes.visible = item is not None and self._axes_shown.value
                if item is not None:
                    pose = to_numpy(item.pose)
                    axes.wxyz, axes.position = wxyz_of(pose), pose[:3, 3] * self._unit
            self._show_image()

    def _show_image(self) -> None:
        """Put the frame's image behind the scene where the window stands at its camera; elsewhere, nothing."""
        with self._lock:
            index = int(np.clip(self.frame.value, 0, len(self._capture.frames) - 1))
            frame, window = self._capture.frames[index], self._client.camera
            aspect = aspect_of(window)
            there = stands_at(browser_camera(window, self._unit, IMAGE_PX), frame.camera, self._distance)
            wanted = (index, aspect) if there else (index, None)
            if wanted == self._shown:
                return
            self._shown = wanted
            note = (
                ""
                if self._capture.registered
                else "; instruments are not shown: their poses are not in the cameras' frame"
            )
            try:
                picture = image_behind(frame, aspect) if there else None
                if there:
                    window.fov = fitting_view(frame.camera, aspect)
            except NeecoError as error:
                picture, note = None, f"; {error}"
            self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)
            self.status.content = message_html(f"{frame.name}, {frame.split}, {frame.state.time:.2f} s{note}")

    def _add_track(self, number: int, name: str) -> None:
        """The path of an instrument's origin."""
        states = [frame.state.instruments.get(name) for frame in self._capture.frames]
        path = np.array([to_numpy(item.pose)[:3, 3] * self._unit for item in states if item is not None])
        if len(path) > 1:
            ends, color = np.stack([path[:-1], path[1:]], 1), TRACK_COLORS[number % len(TRACK_COLORS)]
            self._client.scene.add_line_segments(
                f"/tracks/{number}", ends.astype(np.float32), color, thickness=2, thickness_units="screen"
            )


def image_behind(frame: Frame, aspect: float) -> np.ndarray:
    """The image as a window of that width by height shows it, uint8 [H, W, 3]: its principal point in the middle, as
    viser has it. Raises NeecoError."""
    camera = frame.camera
    image = (frame.load_image().numpy() * 255).round().astype(np.uint8)
    focal = IMAGE_PX / 2 / np.tan(fitting_view(camera, aspect) / 2)
    size = max(1, round(IMAGE_PX * aspect)), IMAGE_PX
    across, down = focal / camera.fx, focal / camera.fy
    place = np.array([[across, 0, size[0] / 2 - across * camera.cx], [0, down, size[1] / 2 - down * camera.cy]])
    place[:, 2] += (place[:, :2].sum(1) - 1) / 2  # OpenCV counts from the first pixel's centre
    return cv2.warpAffine(image, place, size, flags=cv2.INTER_LINEAR)


def _distance(capture: Capture) -> float:
    """Median distance in mm from the cameras, along what they look at, of the points, or else of the instruments."""
    middle = np.median(capture.points.positions, 0) if len(capture.points.positions) else None
    depths = []
    for frame in capture.frames:
        pose = to_numpy(frame.camera.world_from_camera)
        origins = [to_numpy(item.pose)[:3, 3] for item in frame.state.instruments.values()]
        depths += [float((place - pose[:3, 3]) @ pose[:3, 2]) for place in (origins if middle is None else [middle])]
    ahead = [depth for depth in depths if depth > 0]
    return float(np.median(ahead)) if ahead else ASSUMED_MM
