"""The control panel of one browser. What comes from a run is shown as text, never as markup."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from neeco.viewer.instrument_panel import InstrumentPanel
from neeco.viewer.source import Loaded
from neeco.viewer.status import LINE, message_html
from neeco.viewer.steering import Wishes, slider_ranges
from neeco.viewer.timeline import Timeline
from neeco.viewer.views import IMAGE, views_of

if TYPE_CHECKING:
    import viser

    from neeco.viewer.overlays import Overlays

MOST_INSTRUMENTS = 8  # that get controls
SPLIT, BESIDE = "split picture", "side by side"
NONE_CHOSEN = "—"
PLOTS_EVERY_S = 0.5  # while more becomes known
PLOT_HEIGHT = 140  # px
PLOT_COLORS = ("#228be6", "#f76707")


@dataclass(frozen=True)
class Actions:
    """What the panel asks for when the user does something."""

    changed: Callable[[], None]
    go_to: Callable[[int], None]  # the camera of a frame
    gripped: Callable[[str, int, bool], None]  # an instrument's name and number, and whether its gizmo appears
    keep: Callable[[], None]
    forget: Callable[[], None]
    save: Callable[[], None]
    dark: Callable[[bool], None]


class Panel:
    """Made of the first run that is looked at; `runs` are all."""

    def __init__(self, client: viser.ClientHandle, runs: Sequence[Loaded], actions: Actions) -> None:
        self._gui, self._runs, self._actions = client.gui, tuple(runs), actions
        self._worst: list[int] = []
        self._plotted: tuple[tuple[int, int], ...] = ()  # what is known of the frames, as it was shown last
        self._plotted_at = 0.0
        self._gui.main_panel.dock_right()  # or it would hide a part of the picture
        self.status = self._gui.add_html("")
        self._add_picture()
        self._add_recording()
        self.instruments = self._add_instruments()
        self._add_timeline()
        self._add_keeping()

    def wishes(self, overlays: Overlays) -> Wishes:
        """What the sliders say."""
        steered = {item.name: item.steered(overlays.pose(item.name)) for item in self.instruments}
        return Wishes(self.place, steered)

    @property
    def place(self) -> float:
        """Where in the recording, in frames."""
        frame, last = float(self.frame.value), len(self._runs[0].recorded.states) - 1
        # a browser may say anything
        return min(max(frame, 0.0), float(last)) if math.isfinite(frame) else 0.0

    @property
    def side_by_side(self) -> bool:
        """Does each run get its own part of the window?"""
        return len(self._runs) > 1 and self.layout.value == BESIDE

    def show_timelines(self, timelines: Sequence[Timeline]) -> None:
        """Draw what is known of the frames' PSNR, and list the worst."""
        so_far = tuple((timeline.loaded.serial, timeline.count) for timeline in timelines)
        now = time.perf_counter()
        grows = any(not timeline.done for timeline in timelines)
        if so_far == self._plotted or (grows and now - self._plotted_at < PLOTS_EVERY_S):
            return
        self._plotted, self._plotted_at = so_far, now
        first = self._runs[0]
        known = [timeline.known() for timeline in timelines]
        same = [timeline.loaded.recorded.names == first.recorded.names for timeline in timelines]
        frames = [
            shown[0]
            for shown, of_same in zip(known, same, strict=True)
            if of_same  # of another recording there is no frame in common
        ]
        common = frames[0]
        for others in frames[1:]:
            common = np.intersect1d(common, others)
        if len(common) < 2:
            return
        values = [psnr[np.isin(at, common)] for (at, psnr), ok in zip(known, same, strict=True) if ok]
        self._draw_plot((common.astype(np.float64), *values))
        worst = timelines[0].worst()
        names, splits = first.recorded.names, first.recorded.splits
        options = [f"{frame}: {psnr:.1f} dB, {splits[frame]}, {names[frame]}" for frame, psnr in worst]
        if self.worst.value == NONE_CHOSEN and (NONE_CHOSEN, *options) != tuple(self.worst.options):
            self._worst = [frame for frame, _ in worst]
            self.worst.options = (NONE_CHOSEN, *options)

    def _add_picture(self) -> None:
        gui, views = self._gui, views_of(self._runs[0].scene, bool(self._runs[0].frames))
        with gui.add_folder("Picture"):
            self.view = gui.add_dropdown("show", views, initial_value=IMAGE)
            self.layout = gui.add_dropdown(
                "two runs",
                (SPLIT, BESIDE),
                initial_value=BESIDE,
                visible=len(self._runs) > 1,
                hint="Side by side, cameras, points and arrows are not drawn: they would stand between the two.",
            )
            self.divide = gui.add_slider("divide at (%)", 0, 100, 1, 50, visible=False)
        self.view.on_update(self._moved)
        self.divide.on_update(self._moved)
        self.layout.on_update(self._layout_changed)

    def _add_recording(self) -> None:
        gui, first = self._gui, self._runs[0]
        last = len(first.recorded.states) - 1
        with gui.add_folder("Recording"):
            hint = "Between two frames the state is interpolated."
            if any(len(run.recorded.states) != last + 1 for run in self._runs):
                hint += " A run with another number of frames is at the same share of its recording."
            self.frame = gui.add_slider("frame", 0.0, float(last), 0.1, 0.0, hint=hint)
            self.play = gui.add_checkbox("play", False)
            self.follows = gui.add_checkbox(
                "camera of the frame", _cameras_move(first), hint="The camera goes along with the frames."
            )
            self.go = gui.add_button("go to this frame's camera")
            self.cameras = gui.add_checkbox("recorded cameras", False, hint="Click one to stand there.")
            self.points = gui.add_checkbox("sparse points", False, visible=first.capture is not None)
        self.frame.on_update(self._moved)
        self.play.on_update(self._moved)
        self.follows.on_update(self._moved)
        for control in (self.cameras, self.points):
            control.on_update(self._moved)
        self.go.on_click(lambda _: self._actions.go_to(round(self.place)))

    def _add_instruments(self) -> list[InstrumentPanel]:
        first = self._runs[0]
        if (more := len(first.scene.instruments) - MOST_INSTRUMENTS) > 0:
            self._gui.add_html(message_html(f"{more} more instruments stay as recorded: no room for their sliders"))
        ranges = slider_ranges(first.scene.instruments, first.recorded.states)
        return [
            InstrumentPanel(
                self._gui,
                instrument,
                ranges,
                first.shafts[instrument.name],
                self._actions.changed,
                partial(self._actions.gripped, instrument.name, number),
            )
            for number, instrument in enumerate(first.scene.instruments[:MOST_INSTRUMENTS])
        ]

    def _add_timeline(self) -> None:
        self._plot: Any = None
        self._timeline_folder = self._gui.add_folder("PSNR of every frame", visible=bool(self._runs[0].frames))
        with self._timeline_folder:
            self.worst = self._gui.add_dropdown(
                "worst", (NONE_CHOSEN,), initial_value=NONE_CHOSEN, hint="Go to that frame, state and camera."
            )
        self.worst.on_update(self._worst_chosen)

    def _add_keeping(self) -> None:
        gui = self._gui
        labelled = bool(self._runs[0].scene.label_names)
        with gui.add_folder("Keep"):
            self.keep = gui.add_button("keep this state", hint="And this camera, for neeco synthesize --states.")
            self.forget = gui.add_button("forget the last kept")
            self.save = gui.add_button(
                "save labelled image", disabled=not labelled, hint="As neeco synthesize writes one, from here."
            )
            self.kept = gui.add_html("")
        dark = gui.add_checkbox("dark", True)
        self.keep.on_click(lambda _: self._actions.keep())
        self.forget.on_click(lambda _: self._actions.forget())
        self.save.on_click(lambda _: self._actions.save())
        dark.on_update(lambda _: self._actions.dark(bool(dark.value)))

    def _draw_plot(self, data: tuple[np.ndarray, ...]) -> None:
        if self._plot is not None:
            self._plot.data = data
            return
        series: list[dict[str, Any]] = [{"label": "frame"}]
        for color, run in zip(PLOT_COLORS, self._runs, strict=False):
            series.append(
                {"label": f"{run.name} (dB)"[:LINE], "stroke": color, "width": 1.5, "points": {"show": False}}
            )
        with self._timeline_folder:
            self._plot = self._gui.add_uplot(
                data,
                tuple(series[: len(data)]),
                scales={"x": {"time": False}, "y": {"auto": True}},
                axes=({"size": 32}, {"size": 34}),
                legend={"show": len(data) > 2},
                height=PLOT_HEIGHT + (30 if len(data) > 2 else 0),
                padding=(6, 8, 0, 0),
            )

    def _moved(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self._actions.changed()

    def _layout_changed(self, event: viser.GuiEvent[Any]) -> None:
        self.divide.visible = not self.side_by_side
        self.cameras.visible = self.points.visible = not self.side_by_side
        self._moved(event)

    def _worst_chosen(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None or self.worst.value == NONE_CHOSEN:
            return
        frame = self._worst[list(self.worst.options).index(self.worst.value) - 1]
        for instrument in self.instruments:
            instrument.reset()
        self.play.value = False
        self.frame.value = float(frame)
        self._actions.go_to(frame)


def _cameras_move(loaded: Loaded) -> bool:
    first = loaded.recorded.cameras[0].world_from_camera
    return any(not camera.world_from_camera.equal(first) for camera in loaded.recorded.cameras)
