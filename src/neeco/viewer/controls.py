"""Slider values as a state: a position in the recording, and each instrument's departure from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.lines import frame_about
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import to_numpy
from neeco.synthesis.states import JointRange, Shaft, interpolate_state, joint_ranges, turn_about

MARGIN = 0.2  # extension of a slider without stated limits, as a share of the recorded range
STILL = math.radians(1.0)  # half range, in rad, of the slider of a joint that never moved


@dataclass(frozen=True)
class InstrumentControls:
    """Departure of one instrument from the recording; none by default."""

    joints: Mapping[str, float] = field(default_factory=dict)  # rad; others are as recorded
    slide: float = 0.0  # mm along the shaft, towards the jaws
    roll: float = 0.0  # rad about the shaft
    yaw: float = 0.0  # rad about the shaft's end, to the side
    pitch: float = 0.0  # rad, about an axis at right angles to that of yaw
    pose: np.ndarray | None = None  # [4, 4] world_from_instrument, mm, to which slides and rotations are added

    @property
    def departs(self) -> bool:
        """Whether anything differs from the recording."""
        return self.pose is not None or bool(self.joints) or any((self.slide, self.roll, self.yaw, self.pitch))


@dataclass(frozen=True)
class Controls:
    """A position in the recording, and departures from it. frame: 1.5 is half way from the second to the third."""

    frame: float = 0.0
    instruments: Mapping[str, InstrumentControls] = field(default_factory=dict)

    @property
    def recorded_frame(self) -> int | None:
        """Return the frame whose recorded state this is; None between frames and for other states."""
        departs = any(item.departs for item in self.instruments.values())
        return int(self.frame) if self.frame == int(self.frame) and not departs else None


def controlled_state(states: Sequence[State], shafts: Mapping[str, Shaft], controls: Controls) -> State:
    """Return the state set by the controls. states: the recording's, at least one; controls of other instruments are
    ignored. Frames outside the recording are clamped."""
    state = interpolated_state(states, controls.frame)
    moved = {
        name: _moved(recorded, shafts[name], controls.instruments[name]) if name in controls.instruments else recorded
        for name, recorded in state.instruments.items()
    }
    return replace(state, instruments=moved)


def interpolated_state(states: Sequence[State], frame: float) -> State:
    """Interpolate the recording between two frames: positions, joints and time linearly, rotations by slerp."""
    frame = min(max(frame, 0.0), len(states) - 1.0)
    first, share = int(frame), frame - int(frame)
    return interpolate_state(states[first], states[first + 1], share) if share else states[first]


def slider_ranges(instruments: Sequence[Instrument], states: Sequence[State]) -> dict[tuple[str, str], JointRange]:
    """Return the range of the slider of each (instrument, joint), in rad: the capture's limits, else slightly more than
    the recorded range."""
    ranges = {}
    for (name, joint), recorded in joint_ranges(states).items():
        limits = next((item.joints.get(joint) for item in instruments if item.name == name), None)
        if limits is not None and -math.inf < limits[0] < limits[1] < math.inf:
            ranges[name, joint] = JointRange(*limits)
            continue
        if recorded.upper - recorded.lower < 2 * STILL:
            middle = (recorded.upper + recorded.lower) / 2
            recorded = JointRange(middle - STILL, middle + STILL)
        ranges[name, joint] = recorded.widened(MARGIN, None)
    return ranges


def _moved(recorded: InstrumentState, shaft: Shaft, controls: InstrumentControls) -> InstrumentState:
    """Apply roll about the shaft, pitch and yaw about its end, then a slide along its original direction."""
    if not controls.departs:
        return recorded
    side, up, _ = frame_about(shaft.along).T
    turns = (
        Rotation.from_rotvec(controls.yaw * up)
        * Rotation.from_rotvec(controls.pitch * side)
        * Rotation.from_rotvec(controls.roll * shaft.along)
    )
    pose = to_numpy(recorded.pose) if controls.pose is None else controls.pose
    joints = {joint: controls.joints.get(joint, value) for joint, value in recorded.joints.items()}
    with np.errstate(invalid="ignore"):  # a browser may send infinity, which cannot be rendered
        offset = rigid(np.eye(3), controls.slide * shaft.along) @ turn_about(shaft.end, turns.as_rotvec())
        return InstrumentState(torch.from_numpy(pose @ offset), joints)
