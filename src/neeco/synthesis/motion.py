"""How instruments and camera go on moving while the shutter is open: as at a recorded moment that is much alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from neeco.capture.model import InstrumentState, State
from neeco.labels.annotation import place_in_image
from neeco.labels.drawing import LayeredDrawing, to_numpy
from neeco.raster.types import Camera
from neeco.synthesis.acceptance import working_ends
from neeco.synthesis.states import rigid
from neeco.synthesis.views import LikeMoments, moved_camera, surface_points

if TYPE_CHECKING:
    from neeco.scene import Recorded, Scene

MOST_DRAWINGS = 64
PIXELS_APART = 1.0  # at most, between two drawings of an exposure
LOOKED_AT = 40  # px: every so many, the tissue's places are followed
LONGEST_GAP = 0.5  # s between recorded frames, over which a speed means nothing


@dataclass(frozen=True)
class Motion:
    """Speeds at a moment: twists [6] (rad/s, then mm/s, each in its own body's frame) and joint rates per s."""

    instruments: Mapping[str, np.ndarray]
    joints: Mapping[str, Mapping[str, float]]
    camera: np.ndarray

    def after(self, state: State, camera: Camera, seconds: float) -> tuple[State, Camera]:
        """State and camera so much later (or earlier), at these speeds."""
        moved = {
            name: InstrumentState(
                torch.from_numpy(to_numpy(given.pose) @ _moved(self.instruments[name], seconds)).to(given.pose),
                {joint: value + seconds * self.joints[name][joint] for joint, value in given.joints.items()},
            )
            for name, given in state.instruments.items()
        }
        pose = to_numpy(camera.world_from_camera) @ _moved(self.camera, seconds)
        return replace(state, instruments=moved, time=state.time + seconds), moved_camera(camera, pose)


class RecordedMotion:
    """Draws motions: those of one of the recorded moments whose instruments stood most like the drawn ones."""

    def __init__(self, recorded: Recorded) -> None:
        order = sorted(range(len(recorded.states)), key=lambda k: recorded.states[k].time)
        self._motions, states = [], []
        for first, second in pairwise(order):
            a, b = recorded.states[first], recorded.states[second]
            if 0 < b.time - a.time <= LONGEST_GAP and set(a.instruments) == set(b.instruments):
                self._motions.append(motion_between(a, recorded.cameras[first], b, recorded.cameras[second]))
                states.append(a)
        self._moments = LikeMoments(states, len(states), joints=True)

    @property
    def known(self) -> bool:
        """Whether the recording says how anything moved."""
        return bool(self._motions)

    def any(self, rng: Generator) -> Motion:
        """That of any moment."""
        return self._motions[self._moments.any(rng)]

    def __call__(self, state: State, rng: Generator) -> Motion:
        """How `state` goes on."""
        return self._motions[self._moments.like(state, rng)]


class MixedMotion:
    """Draws motions of instruments and a camera that were not recorded together: each as at some moment of its own."""

    def __init__(self, tissue: Recorded, casts: Sequence[Recorded]) -> None:
        self._tissue, self._casts = RecordedMotion(tissue), [RecordedMotion(cast) for cast in casts]

    @property
    def known(self) -> bool:
        """Whether every recording says how anything moved."""
        return self._tissue.known and all(cast.known for cast in self._casts)

    def __call__(self, state: State, rng: Generator) -> Motion:
        """How `state` goes on."""
        moments = [cast.any(rng) for cast in self._casts]
        return Motion(
            {name: twist for moment in moments for name, twist in moment.instruments.items()},
            {name: rates for moment in moments for name, rates in moment.joints.items()},
            self._tissue.any(rng).camera,
        )


def exposure(scene: Scene, drawing: LayeredDrawing, motion: Motion, shutter_s: float) -> list[tuple[State, Camera]]:
    """States and cameras spread evenly over an exposure of which `drawing` is the middle: so many that nothing moves
    by more than PIXELS_APART from one to the next (MOST_DRAWINGS at most), and an odd number, so that the middle is
    one of them."""
    ends = [motion.after(drawing.state, drawing.camera, side * shutter_s / 2) for side in (-1, 1)]
    apart = _pixels_between(scene, drawing, *ends)
    count = 2 * int(np.clip(np.ceil(apart / PIXELS_APART / 2), 0, MOST_DRAWINGS // 2 - 1)) + 1
    times = ((np.arange(count) + 0.5) / count - 0.5) * shutter_s
    return [motion.after(drawing.state, drawing.camera, float(time)) for time in times]


def _pixels_between(
    scene: Scene, drawing: LayeredDrawing, start: tuple[State, Camera], end: tuple[State, Camera]
) -> float:
    """The furthest that a working end or a place on the tissue moves in the image."""
    places = []
    for state, camera in (start, end):
        points = [point for ends in working_ends(scene, state).values() for point in ends]
        points += list(surface_points(drawing.tissue_depth, drawing.camera, LOOKED_AT))
        places.append([place_in_image(point, camera) for point in points])
    moved = [np.hypot(a[0] - b[0], a[1] - b[1]) for a, b in zip(*places, strict=True) if a and b]
    return float(max(moved, default=0.0))


def motion_between(a: State, camera_a: Camera, b: State, camera_b: Camera) -> Motion:
    """How everything moved from one recorded moment to a later one, at even speed."""
    seconds = b.time - a.time
    twists = {
        name: _twist(to_numpy(given.pose), to_numpy(b.instruments[name].pose), seconds)
        for name, given in a.instruments.items()
    }
    joints = {
        name: {joint: (b.instruments[name].joints[joint] - value) / seconds for joint, value in given.joints.items()}
        for name, given in a.instruments.items()
    }
    camera = _twist(to_numpy(camera_a.world_from_camera), to_numpy(camera_b.world_from_camera), seconds)
    return Motion(twists, joints, camera)


def _twist(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Speed [6] that takes pose `start` [4, 4] to `end`, turning and shifting evenly in its own frame."""
    between = np.linalg.inv(start) @ end
    turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
    return np.concatenate([turn, between[:3, 3]]) / seconds


def _moved(twist: np.ndarray, seconds: float) -> np.ndarray:
    return rigid(Rotation.from_rotvec(seconds * twist[:3]).as_matrix(), seconds * twist[3:])
