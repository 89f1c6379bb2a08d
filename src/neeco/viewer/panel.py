"""The control panel of one browser, and its status. Names from a run are shown as text, never as markup."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from neeco.capture.model import Instrument, InstrumentState
from neeco.synthesis.samplers import JointRange, Shaft
from neeco.viewer.runs import VIEWER, FrameScore, LoadedRun, Timeline
from neeco.viewer.views import IMAGE, Controls, InstrumentControls, Overlays, Picture, slider_ranges, views_of

if TYPE_CHECKING:
    import viser


NONE_CHOSEN = "—"


class Panel:
    """Controls of the shown run. The buttons `keep` and `save` are connected elsewhere."""

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: LoadedRun,
        changed: Callable[[], None],
        go_to: Callable[[int], None],
        toggle_gizmo: Callable[[str, int, bool], None],
    ) -> None:
        """changed: called when the user moved something; go_to: with the frame whose camera is wanted; toggle_gizmo:
        with an instrument's name and number, and whether its gizmo appears."""
        gui, scene, recorded = client.gui, loaded.scene, loaded.recorded
        self._gui, self._loaded, self._go_to = gui, loaded, go_to
        self._plot: Any = None
        self._plotted: tuple[Timeline, int] | None = None  # and the number of scored frames in it
        self._plotted_at = 0.0
        gui.main_panel.dock_right()  # otherwise it would hide a part of the picture
        self.status = gui.add_html("")
        with gui.add_folder("Picture"):
            self.view = gui.add_dropdown("show", views_of(scene, bool(loaded.frames)), initial_value=IMAGE)
        with gui.add_folder("Recording"):
            hint = "Between two frames the state is interpolated."
            self.frame = gui.add_slider("frame", 0.0, float(len(recorded.states) - 1), 0.1, 0.0, hint=hint)
            self.play = gui.add_checkbox("play", False)
            poses = [camera.world_from_camera for camera in recorded.cameras]
            moves = any(not pose.equal(poses[0]) for pose in poses)
            hint = "The camera goes along with the frames."
            self.follows = gui.add_checkbox("camera of the frame", moves, hint=hint)
            go = gui.add_button("go to this frame's camera")
            self.cameras = gui.add_checkbox("recorded cameras", False, hint="Click one to stand there.")
            self.points = gui.add_checkbox("sparse points", False, visible=loaded.capture is not None)
        for control in (self.view, self.frame, self.play, self.follows, self.cameras, self.points):
            control.on_update(_by_user(changed))
        go.on_click(lambda _: go_to(round(self.place)))
        ranges = slider_ranges(scene.instruments, recorded.states)
        self.instruments = [
            InstrumentPanel(gui, item, ranges, loaded.shafts[item.name], changed, partial(toggle_gizmo, item.name, k))
            for k, item in enumerate(scene.instruments)
        ]
        self._timeline_folder = gui.add_folder("PSNR of every frame", visible=bool(loaded.frames))
        with self._timeline_folder:
            hint = "Go to that frame, state and camera."
            self.worst = gui.add_dropdown("worst", (NONE_CHOSEN,), initial_value=NONE_CHOSEN, hint=hint)
        self.worst.on_update(_by_user(self._worst_chosen))
        with gui.add_folder("Keep"):
            self.keep = gui.add_button("keep this state", hint="And this camera, for neeco synthesize --states.")
            hint = "As neeco synthesize writes one, from here."
            self.save = gui.add_button("save labelled image", disabled=not scene.label_names, hint=hint)
            self.saved = gui.add_html("")

    def controls(self, overlays: Overlays) -> Controls:
        """Return the values of the sliders."""
        instruments = {item.name: item.controls(overlays.gizmo_pose(item.name)) for item in self.instruments}
        return Controls(self.place, instruments)

    @property
    def place(self) -> float:
        """Return the position in the recording, in frames."""
        frame, last = float(self.frame.value), len(self._loaded.recorded.states) - 1
        # input from a browser is not trusted
        return min(max(frame, 0.0), float(last)) if math.isfinite(frame) else 0.0

    def show_timeline(self, timeline: Timeline) -> None:
        """Plot the PSNR of the frames scored so far, and list the worst."""
        so_far = timeline, timeline.count
        now = time.perf_counter()
        if so_far == self._plotted or (not timeline.done and now - self._plotted_at < VIEWER.plots_every_s):
            return
        self._plotted, self._plotted_at = so_far, now
        names, splits = self._loaded.recorded.names, self._loaded.recorded.splits
        scored, psnr = timeline.known, timeline.psnr
        # the names differ where the run has changed, and this panel not yet
        if timeline.loaded.recorded.names != names or len(scored) < 2:
            return
        data = scored.astype(np.float64), psnr[scored]
        if self._plot is not None:
            self._plot.data = data
        else:
            label = f"{self._loaded.name} (dB)"[: VIEWER.line]
            line = {"label": label, "stroke": "#228be6", "width": 1.5, "points": {"show": False}}
            with self._timeline_folder:
                self._plot = self._gui.add_uplot(
                    data,
                    ({"label": "frame"}, line),
                    scales={"x": {"time": False}, "y": {"auto": True}},
                    axes=({"size": 32}, {"size": 34}),
                    legend={"show": False},
                    height=VIEWER.plot_height,
                    padding=(6, 8, 0, 0),
                )
        if self.worst.value == NONE_CHOSEN:
            worst = timeline.worst()
            options = [f"{frame}: {psnr[frame]:.1f} dB, {splits[frame]}, {names[frame]}" for frame in worst]
            if (NONE_CHOSEN, *options) != tuple(self.worst.options):
                self.worst.options = (NONE_CHOSEN, *options)

    def _worst_chosen(self) -> None:
        if self.worst.value == NONE_CHOSEN:
            return
        frame = int(self.worst.value.partition(":")[0])
        for instrument in self.instruments:
            instrument.reset()
        self.play.value = False
        self.frame.value = float(frame)
        self._go_to(frame)


class InstrumentPanel:
    """Sliders of one instrument. They follow the recording until the user moves one."""

    def __init__(
        self,
        gui: viser.GuiApi,
        instrument: Instrument,
        ranges: Mapping[tuple[str, str], JointRange],
        shaft: Shaft,
        changed: Callable[[], None],
        toggle_gizmo: Callable[[bool], None],
    ) -> None:
        """changed: called when the user moved something; toggle_gizmo: when the gizmo is to appear or to go."""
        self.name = instrument.name
        self._changed, self._toggle_gizmo = changed, toggle_gizmo
        self._joints_as_recorded = True  # until the user moves one
        self._ranges = {joint: ranges[self.name, joint] for joint in instrument.joints if (self.name, joint) in ranges}
        # unit of the sliders of a reading: degrees (revolute) or mm (prismatic)
        self._per_unit = {joint: 1.0 if instrument.slides(joint) else math.degrees(1.0) for joint in instrument.joints}
        with gui.add_folder(f"Instrument {self.name}"):
            self._joints: dict[str, viser.GuiSliderHandle[float]] = {}
            for joint, span in self._ranges.items():  # ends rounded outwards; a reading outside is rendered at its end
                per_unit = self._per_unit[joint]
                lower, upper = per_unit * span.lower, per_unit * span.upper
                digits = max(0, 1 - math.floor(math.log10((upper - lower) / 5)))
                step = 10.0**-digits
                lower = round(math.floor(lower / step) * step, digits)
                upper = round(math.ceil(upper / step) * step, digits)
                unit = "mm" if per_unit == 1 else "°"
                begin = min(max(0.0, lower), upper)
                self._joints[joint] = gui.add_slider(f"{joint} ({unit})", lower, upper, step, begin)
            about = "the learned shaft" if shaft.learned else "the tracked frame's z axis (no shaft is known)"
            end, angle = "About the shaft's end.", VIEWER.yaw_deg
            self._moves = [  # slide in mm; roll, yaw and pitch in degrees
                gui.add_slider(label, -most, most, step, 0.0, hint=hint)
                for label, most, step, hint in (
                    ("along shaft (mm)", VIEWER.slide_mm, 0.5, f"Along {about}."),
                    ("roll (°)", 180.0, 1.0, f"About {about}."),
                    ("yaw (°)", angle, 0.5, end),
                    ("pitch (°)", angle, 0.5, end),
                )
            ]
            hint = "Arrows and rings move and turn the instrument; sliders add to that."
            self.gizmo = gui.add_checkbox("drag it in the scene", False, hint=hint)
            self.back = gui.add_button("back to the recording")
        for slider in self._joints.values():
            slider.on_update(_by_user(self._joint_moved))
        for slider in self._moves:
            slider.on_update(_by_user(changed))
        self.gizmo.on_update(_by_user(self._gizmo_toggled))
        self.back.on_click(lambda _: self.reset())

    def controls(self, pose: np.ndarray | None) -> InstrumentControls:
        """Values of the sliders; pose [4, 4]: of the gizmo, mm, or None without one."""
        joints = {}
        if not self._joints_as_recorded:
            for joint, slider in self._joints.items():
                span = self._ranges[joint]
                # conversion to degrees and back may exceed the limits by rounding
                joints[joint] = min(max(slider.value / self._per_unit[joint], span.lower), span.upper)
        slide, *turns = (float(slider.value) for slider in self._moves)
        roll, yaw, pitch = map(math.radians, turns)
        return InstrumentControls(joints, slide, roll, yaw, pitch, pose if self.gizmo.value else None)

    def follow(self, state: InstrumentState) -> None:
        """Show the recorded readings, unless the user has set others."""
        if self._joints_as_recorded:
            for joint, slider in self._joints.items():
                on_step = round(state.joints[joint] * self._per_unit[joint] / slider.step) * slider.step
                value = min(max(round(on_step, 6), slider.min), slider.max)
                if value != slider.value:
                    slider.value = value

    def straighten(self) -> None:
        """Reset slide and turns to zero: the instrument's present pose becomes their starting point."""
        for slider in self._moves:
            slider.value = 0.0

    def reset(self) -> None:
        """Reset all sliders to the recorded state."""
        self.straighten()
        self._joints_as_recorded = True
        if self.gizmo.value:
            self.gizmo.value = False
            self._toggle_gizmo(False)
        self._changed()

    def _joint_moved(self) -> None:
        self._joints_as_recorded = False
        self._changed()

    def _gizmo_toggled(self) -> None:
        self._toggle_gizmo(bool(self.gizmo.value))
        self._changed()


def _by_user(action: Callable[[], None]) -> Callable[[viser.GuiEvent[Any]], None]:
    """Wrap `action` to run only when a user, not the program, moved a control."""
    return lambda event: None if event.client is None else action()


def status_html(
    loaded: LoadedRun,
    controls: Controls,
    picture: Picture,
    seconds: float,
    notes: Sequence[str] = (),
    score: FrameScore | None = None,
) -> str:
    """Return the HTML of the status: content, quality and speed. seconds: of the rendering; notes: further remarks."""
    scene, recorded = loaded.scene, loaded.recorded
    frame = min(max(round(controls.frame), 0), len(recorded.names) - 1)
    count = "no Gaussians" if scene.num_gaussians is None else f"{scene.num_gaussians:,} Gaussians"
    training = [] if loaded.iteration is None else [f"iteration {loaded.iteration:,}, still training"]
    place = f"{controls.frame:g} ({_text(recorded.names[frame])}, {_text(recorded.splits[frame])})"
    lines = [
        f"<b>{_text(loaded.name)}</b>",
        " · ".join([_text(scene.method), count, *training]),
        f"frame {place}" + (", steered or between frames" if controls.recorded_frame is None else ""),
    ]
    if score is not None:
        overlap = "" if score.iou is None else f" · IoU {score.iou:.3f}"
        lines.append(f"PSNR {score.psnr:.2f} dB{overlap}")
    if recorded.still:
        lines.append("still scope: views far from the recorded one show what no frame saw")
    height, width = picture.depth.shape
    lines.append(f"{seconds * 1e3:.0f} ms at {width} × {height}")
    return _block([*lines, *(_text(note, 3 * VIEWER.line) for note in notes if note)])


def message_html(text: str) -> str:
    """HTML of one message."""
    return _block([_text(text, 4 * VIEWER.line)]) if text else ""


def _text(text: str, most: int = VIEWER.line) -> str:
    """Text on one line, at most `most` characters, escaped."""
    line = " ".join(str(text).split())
    return html.escape(line if len(line) <= most else line[: most - 1] + "…")


def _block(lines: Sequence[str]) -> str:
    return f'<div style="padding:0.2em 1em;font-size:0.8em;overflow-wrap:anywhere">{"<br>".join(lines)}</div>'
