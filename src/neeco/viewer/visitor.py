"""One browser: its panel, what is drawn over its picture, and how its wishes become that picture."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from neeco.capture.model import State
from neeco.errors import NeecoError
from neeco.labels.drawing import to_numpy
from neeco.viewer.drawing import Drawn, draw_run, scored
from neeco.viewer.overlays import Overlays
from neeco.viewer.pace import LEAST_PX, Pace
from neeco.viewer.panel import Actions, Panel
from neeco.viewer.source import Loaded
from neeco.viewer.status import message_html, status_html
from neeco.viewer.steering import Wishes, between, steered_state
from neeco.viewer.studio import Studio
from neeco.viewer.views import Picture, beside, split
from neeco.viewer.window import aspect_of, fitting_view, jump, pose_of, seen_camera, stands_at

if TYPE_CHECKING:
    import viser

JPEG_MOVING, JPEG_SHARP = 80, 92
PLAYED_PER_S = 10.0  # frames, where the recording does not say how many were taken
SLOWEST, FASTEST = 2.0, 30.0
SAYS_EVERY_S = 0.25  # while things move


class Visitor:
    """Made when a browser connects. `draw` and `tick` belong to the artist's thread, the rest to any.

    present: is it still connected?
    """

    def __init__(self, client: viser.ClientHandle, studio: Studio, present: Callable[[], bool]) -> None:
        self.key = client.client_id
        self._client, self._studio, self._present = client, studio, present
        self._pace = Pace()
        self._said_at = 0.0
        self._saving = False
        self._played_at: float | None = None
        self._shape = 0.0  # of a run's part of the window, width by height
        self._stood_at = 0  # the frame whose camera the window was sent to last
        self._followed: int | None = 0  # the frame that the camera went along to
        self._dark(True)
        self._loaded, self.overlays, self._panel = self._furnish(studio.loaded)
        self._go_to(0)
        client.camera.on_update(lambda _: self._ask())

    def draw(self, sharp: bool) -> None:
        """Draw what is wished for now: coarsely, or sharp with its numbers."""
        if not self._present():
            return
        current = self._studio.loaded
        if [run.signature for run in current] != [run.signature for run in self._loaded]:
            self._client.gui.reset()
            self._client.scene.reset()
            self._loaded, self.overlays, self._panel = self._furnish(current)
        self._loaded = current
        began = time.perf_counter()
        self._fit()
        wishes, view = self._wishes(), self._client.camera
        share = self._share
        aspect = aspect_of(view) * share * len(current)
        camera = seen_camera(view, self._studio.unit, self._pace.height(sharp, view.image_height, aspect), share)
        try:
            shows = self._panel.view.value
            drawn = [draw_run(self._studio, k, wishes, camera, self._stood_at, shows) for k in range(len(current))]
        except NeecoError as error:
            self._panel.status.content = message_html(str(error))
            return
        whole = self._together([item.picture for item in drawn])
        seconds = time.perf_counter() - began
        self._pace.took(seconds, sum(item.picture.depth.size for item in drawn))
        if self._present():
            self._send(whole, sharp)
            self._say(drawn, whole, seconds, sharp)

    def tick(self, now: float) -> float | None:
        """Let the recording play on, and show what is newly known of its frames."""
        if not self._present():
            return None
        self._panel.show_timelines(self._studio.timelines)
        if not self._panel.play.value:
            self._played_at = None
            return None
        per_s, frames = frames_per_s(self._loaded[0]), len(self._loaded[0].recorded.states)
        if self._played_at is None:
            self._played_at = now
        ahead = int((now - self._played_at) * per_s)
        if ahead:
            self._played_at += ahead / per_s
            self._panel.frame.value = float((int(self._panel.place) + ahead) % frames)
            self._ask()
        return self._played_at + 1 / per_s

    def _furnish(self, runs: list[Loaded]) -> tuple[list[Loaded], Overlays, Panel]:
        """What the runs hold, and the overlays and panel for it."""
        actions = Actions(self._ask, self._go_to, self._grip, self._keep, self._forget, self._save, self._dark)
        overlays = Overlays(self._client, runs[0], self._studio.unit, self._go_to, self._ask)
        return runs, overlays, Panel(self._client, runs, actions)

    def _ask(self) -> None:
        self._studio.artist.ask(self.key)

    def _go_to(self, frame: int) -> None:
        self._stand_at(frame)
        self._ask()

    def _stand_at(self, frame: int) -> None:
        self._stood_at = frame
        camera = self._loaded[0].recorded.cameras[frame]
        jump(self._client, camera, self._studio.unit, self._studio.distance, self._share)

    @property
    def _share(self) -> float:
        """Of the window's width, that one run's picture takes up."""
        return 1 / len(self._loaded) if self._panel.side_by_side else 1.0

    def _fit(self) -> None:
        """Where the window has changed its shape, have it show all that the recorded camera saw, if it stands there."""
        view, recorded = self._client.camera, self._loaded[0].recorded.cameras[self._stood_at]
        shape = aspect_of(view) * self._share
        if shape == self._shape:
            return
        self._shape = shape
        if stands_at(seen_camera(view, self._studio.unit, LEAST_PX), recorded, self._studio.distance):
            view.fov = fitting_view(recorded, shape)

    def _wishes(self) -> Wishes:
        """What the sliders say; they and the camera are brought along to where the recording is."""
        panel, overlays = self._panel, self.overlays
        wishes = panel.wishes(overlays)
        recorded = between(self._loaded[0].recorded.states, wishes.frame)
        for controls in panel.instruments:
            controls.follow(recorded.instruments[controls.name])
        frame = round(wishes.frame)
        if panel.follows.value and frame != self._followed:
            self._stand_at(frame)
        self._followed = frame if panel.follows.value else None
        alone = not panel.side_by_side
        overlays.show(alone and panel.cameras.value, alone and panel.points.value)
        return wishes

    def _state(self) -> State:
        """What the first run shows now."""
        first = self._loaded[0]
        return steered_state(first.recorded.states, first.shafts, self._panel.wishes(self.overlays))

    def _pose(self) -> np.ndarray:
        """world_from_camera [4, 4] mm of the window."""
        return pose_of(self._client.camera.wxyz, self._client.camera.position, self._studio.unit)

    def _grip(self, name: str, number: int, on: bool) -> None:
        if not on:
            self.overlays.release(name)
            return
        # the gizmo is not there yet, so this is where the sliders have brought the instrument
        pose = to_numpy(self._state().instruments[name].pose)
        self.overlays.grip(name, number, pose)
        self._panel.instruments[number].straighten()

    def _keep(self) -> None:
        keeper, loaded = self._studio.keeper, self._loaded[0]
        self._try(lambda: f"kept: {keeper.keep(loaded, self._state(), self._pose())} in {keeper.states_path}")

    def _forget(self) -> None:
        keeper, loaded = self._studio.keeper, self._loaded[0]
        self._try(lambda: f"kept: {keeper.forget(loaded)} in {keeper.states_path}")

    def _save(self) -> None:
        if self._saving:  # or a page that asks a thousand times would be drawn for long after it has gone
            return
        self._saving = True
        state, pose = self._state(), self._pose()
        self._panel.kept.content = message_html("drawing …")

        def save() -> None:
            try:
                self._try(lambda: f"written: {self._studio.keeper.save(self._loaded[0], state, pose)}")
            finally:
                self._saving = False

        # by the thread that draws: the rasteriser has the cores to itself
        self._studio.artist.do(save)

    def _try(self, task: Callable[[], str]) -> None:
        """Say what became of it."""
        try:
            self._panel.kept.content = message_html(task())
        except NeecoError as error:
            self._panel.kept.content = message_html(f"error: {error}")

    def _dark(self, on: bool) -> None:
        self._client.gui.configure_theme(dark_mode=on, show_logo=False, show_share_button=False)

    def _together(self, pictures: list[Picture]) -> Picture:
        if len(pictures) == 1 or self._panel.side_by_side:
            return beside(pictures)
        return split(pictures[0], pictures[1], self._panel.divide.value / 100)

    def _send(self, whole: Picture, sharp: bool) -> None:
        depth = None
        if self.overlays.shown and not self._panel.side_by_side:
            # 0 is nothing there: far away, not at the eye
            depth = np.where(whole.depth > 0, whole.depth * self._studio.unit, np.inf)
        quality = JPEG_SHARP if sharp else JPEG_MOVING
        self._client.scene.set_background_image(whole.pixels, format="jpeg", jpeg_quality=quality, depth=depth)
        self._client.flush()

    def _say(self, drawn: list[Drawn], whole: Picture, seconds: float, sharp: bool) -> None:
        now = time.perf_counter()
        if not sharp and now - self._said_at < SAYS_EVERY_S:
            return
        self._said_at = now
        said = list(dict.fromkeys(item.said for item in drawn if item.said))
        shown = [item.shown for item in drawn]
        if sharp:  # else things move on before the numbers are read
            try:
                shown = [scored(self._studio, k, item) for k, item in enumerate(drawn)]
            except NeecoError as error:
                said.append(str(error))
        size = whole.pixels.shape[1], whole.pixels.shape[0]
        self._panel.status.content = status_html(shown, seconds, size, "; ".join(said))


def frames_per_s(loaded: Loaded) -> float:
    """How fast to play: as it was recorded, within reason."""
    times = [state.time for state in loaded.recorded.states]
    if loaded.capture is None or not loaded.capture.timed or times[-1] <= times[0]:
        return PLAYED_PER_S
    return min(max((len(times) - 1) / (times[-1] - times[0]), SLOWEST), FASTEST)
