"""The controls of one instrument."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from neeco.capture.model import Instrument, InstrumentState
from neeco.synthesis.states import JointRange
from neeco.viewer.steering import Shaft, Steered

if TYPE_CHECKING:
    import viser

SLIDE_MM, YAW_DEG = 30.0, 45.0
MOST_JOINTS = 24  # that get a slider


class InstrumentPanel:
    """Sliders of one instrument. They follow the recording until the user moves one."""

    def __init__(
        self,
        gui: viser.GuiApi,
        instrument: Instrument,
        ranges: Mapping[tuple[str, str], JointRange],
        shaft: Shaft,
        changed: Callable[[], None],
        gripped: Callable[[bool], None],
    ) -> None:
        """changed: called when the user moved something; gripped: when the gizmo is to appear or to go."""
        self.name = instrument.name
        self._changed, self._gripped = changed, gripped
        self._ranges = {joint: ranges[self.name, joint] for joint in instrument.joints if (self.name, joint) in ranges}
        with gui.add_folder(f"Instrument {self.name}"):
            self._joints = {
                joint: _degrees_slider(gui, joint, span) for joint, span in list(self._ranges.items())[:MOST_JOINTS]
            }
            self.as_recorded = gui.add_checkbox(
                "joints as recorded", True, visible=bool(self._joints), hint="Off as soon as a joint is moved."
            )
            about = "the learned shaft" if shaft.learned else "the tracked frame's z axis (no shaft is known)"
            self.slide = gui.add_slider("along shaft (mm)", -SLIDE_MM, SLIDE_MM, 0.5, 0.0, hint=f"Along {about}.")
            self.roll = gui.add_slider("roll (°)", -180.0, 180.0, 1.0, 0.0, hint=f"About {about}.")
            self.yaw = gui.add_slider("yaw (°)", -YAW_DEG, YAW_DEG, 0.5, 0.0, hint="About the shaft's end.")
            self.pitch = gui.add_slider("pitch (°)", -YAW_DEG, YAW_DEG, 0.5, 0.0, hint="About the shaft's end.")
            self.grip = gui.add_checkbox(
                "drag it in the scene",
                False,
                hint="Arrows and rings move and turn the instrument; sliders add to that.",
            )
            self.back = gui.add_button("back to the recording")
        for slider in self._joints.values():
            slider.on_update(self._joint_moved)
        for control in (self.slide, self.roll, self.yaw, self.pitch, self.as_recorded):
            control.on_update(self._moved)
        self.grip.on_update(self._grip_changed)
        self.back.on_click(lambda _: self.reset())

    def steered(self, pose: np.ndarray | None) -> Steered:
        """What the controls say; pose [4, 4]: where the gizmo stands, mm, or None where there is none."""
        joints = {}
        if not self.as_recorded.value:
            for joint, slider in self._joints.items():
                span = self._ranges[joint]
                # a degree and back may lie a hair outside the limits
                joints[joint] = min(max(math.radians(slider.value), span.lower), span.upper)
        return Steered(
            joints,
            float(self.slide.value),
            math.radians(self.roll.value),
            math.radians(self.yaw.value),
            math.radians(self.pitch.value),
            pose if self.grip.value else None,
        )

    def follow(self, state: InstrumentState) -> None:
        """Show the recorded readings, unless the user has set others."""
        if self.as_recorded.value:
            for joint, slider in self._joints.items():
                on_step = round(math.degrees(state.joints[joint]) / slider.step) * slider.step
                shown = min(max(round(on_step, 6), slider.min), slider.max)
                if shown != slider.value:
                    slider.value = shown

    def straighten(self) -> None:
        """Forget slide and turns: the pose they led to has become the one they start from."""
        for slider in (self.slide, self.roll, self.yaw, self.pitch):
            slider.value = 0.0

    def reset(self) -> None:
        """Be as recorded again."""
        self.straighten()
        self.as_recorded.value = True
        if self.grip.value:
            self.grip.value = False
            self._gripped(False)
        self._changed()

    def _joint_moved(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # it followed the recording
            return
        self.as_recorded.value = False
        self._changed()

    def _moved(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self._changed()

    def _grip_changed(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self._gripped(bool(self.grip.value))
            self._changed()


def _degrees_slider(gui: viser.GuiApi, joint: str, span: JointRange) -> viser.GuiSliderHandle[float]:
    """Ends are rounded outwards; what lies outside the range there is drawn at its end."""
    lower, upper = math.degrees(span.lower), math.degrees(span.upper)
    digits = max(0, 1 - math.floor(math.log10((upper - lower) / 5)))
    grain = 10.0**-digits
    lower, upper = round(math.floor(lower / grain) * grain, digits), round(math.ceil(upper / grain) * grain, digits)
    return gui.add_slider(f"{joint} (°)", lower, upper, grain, min(max(0.0, lower), upper))
