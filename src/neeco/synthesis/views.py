"""Samplers of views: recorded cameras, cameras near them, cameras round the tissue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from neeco.capture.model import RecordedStates, State
from neeco.errors import NeecoError
from neeco.labels.drawing import to_numpy
from neeco.raster.types import Camera
from neeco.synthesis.states import rigid, turn_about

SIMILAR = 10  # recorded frames whose cameras may see a drawn state


class ViewSampler(Protocol):
    """Draws a camera for a state; intrinsics and image size are always those of a recorded camera."""

    def __call__(self, state: State, rng: Generator) -> Camera: ...


class LikeMoments:
    """Picks one of `count` recorded moments (its index): of the SIMILAR whose instruments stood most like the drawn
    ones, or any where nothing tells them apart. states: the moments'; empty: nothing does."""

    def __init__(self, states: Sequence[State], count: int, joints: bool) -> None:
        common = set.intersection(*(set(state.instruments) for state in states)) if states else set()
        known = RecordedStates(states, sorted(common), joints) if common else None
        self._known = None if known is None or known.still else known
        self._count = count

    def any(self, rng: Generator) -> int:
        """Any moment."""
        return int(rng.integers(self._count))

    def like(self, state: State, rng: Generator) -> int:
        """A moment like `state`."""
        if self._known is None or not set(self._known.instruments) <= set(state.instruments):
            return self.any(rng)
        nearest = np.argsort(self._known.distances(state), kind="stable")[:SIMILAR]
        return int(nearest[rng.integers(len(nearest))])


class RecordedViews:
    """The camera of a recorded frame, one of the SIMILAR whose instruments stood most like the drawn ones.

    A camera that follows its instrument saw it there: drawn so, instruments stand in the image as recorded ones do,
    which is what a detector learns from (docs/benchmarks.md). states: the recorded frames'; empty: any camera.
    """

    def __init__(self, cameras: Sequence[Camera], states: Sequence[State] = ()) -> None:
        if not cameras:
            raise NeecoError("views: the scene remembers no recorded camera; train it again with this version")
        self.cameras = cameras
        self._moments = LikeMoments(states, len(cameras), joints=False)

    def __call__(self, state: State, rng: Generator) -> Camera:
        return self.cameras[self._moments.like(state, rng)]


@dataclass(frozen=True)
class PerturbedViews:
    """A recorded camera, turned about its centre and shifted, both normally distributed about nothing.

    `degrees` and `mm` are standard deviations of the angle about each axis and of the shift along each.
    """

    recorded: RecordedViews
    degrees: float = 3.0
    mm: float = 3.0

    def __call__(self, state: State, rng: Generator) -> Camera:
        camera = self.recorded(state, rng)
        turn = Rotation.from_rotvec(np.deg2rad(self.degrees) * rng.standard_normal(3)).as_matrix()
        offset = rigid(turn, self.mm * rng.standard_normal(3))
        return moved_camera(camera, to_numpy(camera.world_from_camera) @ offset)


@dataclass(frozen=True)
class OrbitViews:
    """A recorded camera carried round `centre` (world mm), which stays at its place in the image.

    The turn is uniform in direction and uniform in angle up to `degrees`.
    """

    recorded: RecordedViews
    centre: np.ndarray  # [3] mm
    degrees: float = 20.0

    def __call__(self, state: State, rng: Generator) -> Camera:
        camera = self.recorded(state, rng)
        world_from_camera = to_numpy(camera.world_from_camera)
        direction = 2 * np.pi * rng.random()
        # the axis lies in the image plane: the camera moves sideways, it does not roll
        axis = world_from_camera[:3, :3] @ np.array([np.cos(direction), np.sin(direction), 0.0])
        turn = turn_about(self.centre, np.deg2rad(self.degrees) * rng.random() * axis)
        return moved_camera(camera, turn @ world_from_camera)


def moved_camera(camera: Camera, world_from_camera: np.ndarray) -> Camera:
    """The same camera elsewhere; world_from_camera [4, 4] with OpenCV axes."""
    return replace(camera, world_from_camera=torch.from_numpy(world_from_camera).to(camera.world_from_camera))


def surface_points(depth: np.ndarray, camera: Camera, step: int = 4) -> np.ndarray:
    """World points [P, 3] mm under every `step`-th pixel of a depth image [H, W] mm; pixels of depth 0 give none."""
    rows, columns = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    z = depth[rows, columns]
    points = np.stack(
        [(columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z, z, np.ones_like(z)], -1
    )[z > 0]
    return (points @ to_numpy(camera.world_from_camera).T)[:, :3]
