"""`neeco view`: a web server that shows a run and lets it be steered, to every browser that connects.

The render thread; one browser's session, from sliders and camera to its picture; the server.

viser serves the page; `access` decides who gets it, and no tunnel or other host is ever asked for.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch

from neeco.base.errors import NeecoError, install_hint
from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.labels.drawing import to_numpy
from neeco.synthesis.settings import RECORDED_SIZE, SizeSettings
from neeco.viewer.access import HOST, PORT, Access, controlled_sockets
from neeco.viewer.panel import Panel, message_html, status_html
from neeco.viewer.runs import VIEWER, LoadedRun, SavedStates, ViewedRun, score_frame
from neeco.viewer.views import (
    Overlays,
    aspect_of,
    browser_camera,
    controlled_state,
    field_of_view,
    fitting_view,
    interpolated_state,
    jump,
    pose_of,
    render_run,
    stands_at,
)

if TYPE_CHECKING:
    import viser


T = TypeVar("T")
log = logging.getLogger(__name__)


class AdaptiveResolution:
    """Selects heights of renderings that meet the time limits, from the latest timings. sharp_px: fixed height of sharp
    ones; None: as in `VIEWER`."""

    def __init__(self, sharp_px: int | None = None) -> None:
        self._sharp_px = sharp_px
        self._per_pixel: deque[float] = deque(maxlen=VIEWER.remembered)  # s

    def height(self, sharp: bool, window: int, aspect: float) -> int:
        """Height in px to render: at most `VIEWER`'s and the window's, less where that would take too long.
        aspect: width of all that is rendered by its height."""
        if sharp and self._sharp_px is not None:
            return max(VIEWER.min_px, min(self._sharp_px, window))
        most, seconds = (VIEWER.sharp_px, VIEWER.sharp_s) if sharp else (VIEWER.moving_px, VIEWER.moving_s)
        most = max(VIEWER.min_px, min(most, window))
        if not self._per_pixel:
            return min(most, VIEWER.moving_px)
        in_time = math.sqrt(seconds / statistics.median_low(self._per_pixel) / aspect)
        return max(VIEWER.min_px, min(most, int(in_time)))

    def record(self, seconds: float, pixels: int) -> None:
        """Record how long a rendering of that many pixels took."""
        self._per_pixel.append(seconds / pixels)


class RenderThread:
    """Renders for all sessions in turn: first moving pictures, then sharp static ones, then background tasks.

    During a rendering, further requests of one session replace each other. Any thread may request; `when_idle` is
    called when there is nothing to render, and returns whether it did something.
    """

    def __init__(self, when_idle: Callable[[], bool] = lambda: False) -> None:
        self._when_idle = when_idle
        self._lock, self._wake = threading.Lock(), threading.Event()
        self._sessions: dict[int, ClientSession] = {}
        self._due: dict[int, tuple[bool, float]] = {}  # sharp or coarse, and from when on, of wanted pictures
        self._jobs: list[Callable[[], None]] = []
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="neeco-render", daemon=True)

    @property
    def sessions(self) -> tuple[ClientSession, ...]:
        """Return the connected sessions."""
        with self._lock:
            return tuple(self._sessions.values())

    def start(self) -> None:
        """Start rendering."""
        self._thread.start()

    def stop(self) -> None:
        """Stop after the current rendering."""
        self._stopped = True
        self._wake.set()
        self._thread.join(timeout=10)

    def add(self, session: ClientSession) -> None:
        """Add a browser that has connected."""
        with self._lock:
            self._sessions[session.key] = session
        self.request(session.key)

    def remove(self, key: int) -> None:
        """Remove a browser that has gone."""
        with self._lock:
            self._sessions.pop(key, None)
            self._due.pop(key, None)

    def request(self, key: int | None = None) -> None:
        """Request another picture for a session, or for every one."""
        with self._lock:
            for which in list(self._sessions) if key is None else [key]:
                if which in self._sessions and self._due.get(which, (True, 0.0))[0]:
                    self._due[which] = False, time.perf_counter()
        self._wake.set()

    def run_job(self, job: Callable[[], None]) -> None:
        """Run a job between two pictures, in the thread that renders."""
        with self._lock:
            self._jobs.append(job)
        self._wake.set()

    def _run(self) -> None:
        while not self._stopped:
            self._wake.clear()
            now, moments = time.perf_counter(), []
            for session in self.sessions:
                try:
                    if (moment := session.tick(now)) is not None:
                        moments.append(moment)
                except Exception:
                    log.exception("a session failed")
                    self.remove(session.key)
            now = time.perf_counter()
            with self._lock:  # the most urgent: a job, or a picture
                job = self._jobs.pop(0) if self._jobs else None
                due = [(sharp, when, key) for key, (sharp, when) in self._due.items() if when <= now]
                if job is None and due:
                    sharp, _, key = min(due)
                    job = partial(self._sessions[key].render, sharp)
                    del self._due[key]
                    if not sharp:
                        self._due[key] = True, now + VIEWER.settled_s
            if job is not None:
                _attempted(job, None)
                continue
            if _attempted(self._when_idle, False):
                continue
            with self._lock:
                moments += [when for _, when in self._due.values()]
            now = time.perf_counter()
            self._wake.wait(max(0.0, min([VIEWER.idle_s, *(moment - now for moment in moments)])))


def _attempted(work: Callable[[], T], otherwise: T) -> T:
    """Run something and log its failure: an error of one browser must not affect the others."""
    try:
        return work()
    except Exception:
        log.exception("rendering failed")
        return otherwise


class ClientSession:
    """One browser: its panel, its picture and the overlays.

    Made when the browser connects. `render` and `tick` belong to the render thread, the rest to any.
    """

    def __init__(self, client: viser.ClientHandle, server: ViewerServer) -> None:
        self.key = client.client_id
        self.status_at = 0.0  # time.perf_counter() of the last status; 0: no picture was sent yet
        self._client, self._server, self._run = client, server, server.run
        self._resolution = AdaptiveResolution(server.sharp_px)
        self._saving = False
        self._request = partial(server.render_thread.request, self.key)
        self._played_at: float | None = None
        self._shape = 0.0  # of the window, width by height
        self._camera_frame = 0  # whose camera the window was sent to last
        self._followed: int | None = 0  # the frame that the camera went along to
        client.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._loaded = self._run.loaded
        self._build(self._loaded)
        self._go_to(0)
        client.camera.on_update(lambda _: self._request())

    def render(self, sharp: bool) -> None:
        """Render the requested picture: coarse, or sharp with its scores."""
        if not self._server.has(self.key):
            return
        began, current = time.perf_counter(), self._run.loaded
        if current.signature != self._loaded.signature:
            self._client.gui.reset()
            self._client.scene.reset()
            self._build(current)
        self._loaded = current
        window = self._client.camera
        unit = self._run.unit
        if (shape := aspect_of(window)) != self._shape:  # fit the whole recorded image, where it stands at its camera
            self._shape = shape
            recorded = current.recorded.cameras[self._camera_frame]
            if stands_at(browser_camera(window, unit, VIEWER.min_px), recorded, self._run.distance):
                window.fov = fitting_view(recorded, shape)
        controls = self._panel.controls(self.overlays)
        panel = self._panel  # of before sliders follow the recording
        state = interpolated_state(current.recorded.states, controls.frame)
        for instrument in panel.instruments:
            instrument.follow(state.instruments[instrument.name])
        frame = round(controls.frame)
        if panel.follows.value and frame != self._followed:
            self._jump_to(frame)
        self._followed = frame if panel.follows.value else None
        self.overlays.show(panel.cameras.value, panel.points.value)
        height = self._resolution.height(sharp, window.image_height, aspect_of(window))
        camera = browser_camera(window, unit, height)
        try:
            picture, as_recorded = render_run(current, controls, camera, self._panel.view.value)
        except NeecoError as error:
            self._panel.status.content = message_html(str(error))
            return
        seconds = time.perf_counter() - began
        self._resolution.record(seconds, picture.depth.size)
        if not self._server.has(self.key):
            return
        depth = None
        if self.overlays.shown:  # 0 means empty: far away, not at the eye
            depth = np.where(picture.depth > 0, picture.depth * unit, np.inf)
        quality = VIEWER.jpeg_sharp if sharp else VIEWER.jpeg_moving
        self._client.scene.set_background_image(picture.pixels, format="jpeg", jpeg_quality=quality, depth=depth)
        self._client.flush()
        now = time.perf_counter()
        if not sharp and now - self.status_at < VIEWER.status_every_s:
            return
        self.status_at = now
        notes = [self._run.trouble or current.trouble, picture.note]
        score = None
        if sharp and as_recorded and current.frames:  # else things move on before it is read
            try:
                with current.scene.torch_threads():
                    score = score_frame(current, int(controls.frame))
            except NeecoError as error:
                notes.append(str(error))
        self._panel.status.content = status_html(current, controls, picture, seconds, notes, score)

    def tick(self, now: float) -> float | None:
        """Advance playback, and show new scores of frames. now: of time.perf_counter(); return when to call again, or
        None: nothing moves by itself."""
        if not self._server.has(self.key):
            return None
        self._panel.show_timeline(self._run.timeline)
        if not self._panel.play.value:
            self._played_at = None
            return None
        frames = len(self._loaded.recorded.states)
        if self._played_at is None:
            self._played_at = now
        ahead = int((now - self._played_at) * VIEWER.played_per_s)
        if ahead:
            self._played_at += ahead / VIEWER.played_per_s
            self._panel.frame.value = float((int(self._panel.place) + ahead) % frames)
            self._request()
        return self._played_at + 1 / VIEWER.played_per_s

    def _build(self, loaded: LoadedRun) -> None:
        """Create overlays and panel for a run."""
        points = None if loaded.capture is None else loaded.capture.points
        cameras, unit = loaded.recorded.cameras, self._run.unit
        self.overlays = Overlays(self._client, cameras, points, unit, self._go_to, self._request)
        self._loaded = loaded
        self._panel: Panel = Panel(self._client, loaded, self._request, self._go_to, self._toggle_gizmo)

        def keep() -> str:
            count = self._server.saved.add(self._loaded, self._state(), self._pose())
            return f"kept: {count} in {self._server.saved.states_path}"

        self._panel.keep.on_click(lambda _: self._report(keep))
        self._panel.save.on_click(lambda _: self._save_image())

    def _go_to(self, frame: int) -> None:
        self._jump_to(frame)
        self._request()

    def _jump_to(self, frame: int) -> None:
        self._camera_frame = frame
        camera = self._loaded.recorded.cameras[frame]
        jump(self._client, camera, self._run.unit, self._run.distance)

    def _state(self) -> State:
        """Return the displayed state."""
        loaded = self._loaded
        return controlled_state(loaded.recorded.states, loaded.shafts, self._panel.controls(self.overlays))

    def _pose(self) -> np.ndarray:
        """Return world_from_camera [4, 4] mm of the window."""
        return pose_of(self._client.camera.wxyz, self._client.camera.position, self._run.unit)

    def _toggle_gizmo(self, name: str, number: int, on: bool) -> None:
        if not on:
            self.overlays.remove_gizmo(name)
            return
        # there is no gizmo yet, so this is the pose set by sliders
        pose = to_numpy(self._state().instruments[name].pose)
        self.overlays.add_gizmo(name, number, pose)
        self._panel.instruments[number].straighten()

    def _save_image(self) -> None:
        if self._saving:  # or a page that asks a thousand times would be served long after it has gone
            return
        self._saving = True
        state, pose = self._state(), self._pose()
        self._panel.saved.content = message_html("rendering …")

        def save() -> None:
            try:
                self._report(lambda: f"written: {self._server.saved.save_image(self._loaded, state, pose)}")
            finally:
                self._saving = False

        # in the render thread: the rasteriser uses all cores
        self._server.render_thread.run_job(save)

    def _report(self, task: Callable[[], str]) -> None:
        """Run something, and report its result."""
        try:
            self._panel.saved.content = message_html(task())
        except NeecoError as error:
            self._panel.saved.content = message_html(f"error: {error}")


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
        up = -np.mean([to_numpy(camera.world_from_camera)[:3, 1] for camera in cameras], axis=0)  # of most images
        length = float(np.linalg.norm(up))
        scene.set_up_direction(tuple(up / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])))
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
        self.sharp_px = None if size == RECORDED_SIZE else height  # of sharp pictures, where a user asked for it
        self.saved = SavedStates(run, size)
        self.render_thread = RenderThread(lambda: self.run.timeline.advance())
        super().__init__(host, port, cameras, self.run.distance, self.run.unit)
        self._server.on_client_connect(lambda client: self.render_thread.add(ClientSession(client, self)))
        self._server.on_client_disconnect(lambda client: self.render_thread.remove(client.client_id))
        self.render_thread.start()
        self.run.watch(self.render_thread.request)

    def stop(self) -> None:
        """End the rendering, then the server."""
        self.run.ended.set()
        self.render_thread.stop()
        super().stop()

    def has(self, key: int) -> bool:
        """Return whether a browser is connected."""
        return key in self._server.get_clients()
