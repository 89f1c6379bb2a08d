"""From what the user asked for to a sampler of states and one of views."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.random import Generator

from neeco.capture.model import State
from neeco.capture.statefile import read_states
from neeco.errors import NeecoError
from neeco.files import read_bytes
from neeco.labels.drawing import surface_depth, to_numpy
from neeco.raster import rasterize
from neeco.raster.types import Camera
from neeco.synthesis.acceptance import shows_working_end
from neeco.synthesis.settings import PATH_PREFIX, SAMPLERS, Views
from neeco.synthesis.states import AlongPath, Beyond, Grid, Inside, Listed, StateSampler
from neeco.synthesis.views import (
    OrbitViews,
    PerturbedViews,
    RecordedViews,
    ViewSampler,
    moved_camera,
    surface_points,
)

if TYPE_CHECKING:
    from neeco.scene import Scene

AIMS = 50  # views tried before the drawn image decides
SURFACE_VIEWS = 5  # recorded views that decide where the surface's middle is


@dataclass(frozen=True)
class Sampler:
    """Draws (state, camera) of image `index`."""

    scene: Scene
    states: StateSampler
    views: ViewSampler
    cameras: tuple[Camera | None, ...] = (None,)  # given with the states, in turn; None: the view sampler decides

    @property
    def prescribed(self) -> bool:
        """Whether the state of an index is given rather than random."""
        return self.states.prescribed

    def fixed(self, index: int) -> bool:
        """Whether both state and camera of image `index` are given: another draw would be the same."""
        return self.prescribed and self.cameras[index % len(self.cameras)] is not None

    def __call__(self, index: int, rng: Generator) -> tuple[State, Camera]:
        """The next (state, camera) for image `index`.

        Of a moving camera's views most do not show the instrument, and drawing is dear: views are drawn until one has
        the instrument in the image, if one does.
        """
        state = self.states(index, rng)
        given = self.cameras[index % len(self.cameras)]
        if given is not None:
            return state, given
        camera = self.views(state, rng)
        for _ in range(AIMS):
            if shows_working_end(self.scene, state, camera):
                break
            camera = self.views(state, rng)
        return state, camera


def make_sampler(scene: Scene, states: str, margin: float, views: Views, count: int) -> Sampler:
    """The sampler named by `states` (inside, beyond, grid, path:FILE or FILE) and `views`. Raises NeecoError."""
    recorded = RecordedViews(scene.recorded.cameras, scene.recorded.states)
    view_sampler = _view_sampler(scene, views, recorded)
    if states == "inside":
        return Sampler(scene, Inside(scene.recorded.states), view_sampler)
    if states == "beyond":
        return Sampler(scene, Beyond(scene.recorded.states, scene.instruments, margin), view_sampler)
    if states == "grid":
        return Sampler(scene, Grid(scene.recorded.states, instrument_axes(scene)), view_sampler)
    lines = read_states(states_file(states), scene.instruments)
    if states.startswith(PATH_PREFIX):
        return Sampler(scene, AlongPath([line.state for line in lines], count), view_sampler)
    intrinsics = recorded.cameras[0]
    cameras = tuple(
        None if line.world_from_camera is None else moved_camera(intrinsics, line.world_from_camera) for line in lines
    )
    return Sampler(scene, Listed([line.state for line in lines]), view_sampler, cameras)


def states_file(states: str) -> Path:
    """The file that `--states` names; NeecoError when it is meant to be a sampler's name but is none."""
    path = Path(states.removeprefix(PATH_PREFIX))
    if path.is_dir() or (not path.suffix and not path.exists()):
        raise NeecoError(f"--states: {states!r} is neither inside, beyond, grid, path:FILE.jsonl nor a file")
    return path


def states_fingerprint(states: str) -> str | None:
    """sha256 of the file that `--states` names; None when it names a sampler."""
    if states in SAMPLERS:
        return None
    path = states_file(states)
    missing = "no such file; --states takes inside, beyond, grid, path:FILE.jsonl or FILE.jsonl"
    return hashlib.sha256(read_bytes(path, "a file of states", missing)).hexdigest()


@torch.no_grad()
def instrument_axes(scene: Scene) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Axis of each instrument in its own frame: a point [3] mm and a unit direction [3].

    The learned shaft where the scene knows one, else the frame's z axis.
    """
    axes = {instrument.name: (np.zeros(3), np.array([0.0, 0.0, 1.0])) for instrument in scene.instruments}
    state = scene.recorded.states[0]
    for name, points in scene.keypoints(state).items():
        if not {"shaft_far", "shaft_near"} <= set(points):
            continue
        instrument_from_world = np.linalg.inv(to_numpy(scene.registered(state).instruments[name].pose))
        far, near = (
            (instrument_from_world @ np.append(to_numpy(points[end]), 1.0))[:3] for end in ("shaft_far", "shaft_near")
        )
        if (length := float(np.linalg.norm(near - far))) > 1e-6:
            axes[name] = near, (near - far) / length
    return axes


def _view_sampler(scene: Scene, views: Views, recorded: RecordedViews) -> ViewSampler:
    if views == "recorded":
        return recorded
    if views == "perturbed":
        return PerturbedViews(recorded)
    return OrbitViews(recorded, surface_centre(scene))


@torch.no_grad()
def surface_centre(scene: Scene) -> np.ndarray:
    """The median [3] mm of the surface points that recorded cameras see."""
    frames = np.unique(np.linspace(0, len(scene.recorded.cameras) - 1, SURFACE_VIEWS).astype(int))
    points = []
    for k in frames:
        camera = scene.camera(scene.recorded.cameras[k])
        points.append(surface_points(surface_depth(rasterize(scene.at(scene.recorded.states[k]), camera)), camera))
    seen = np.concatenate(points)
    if len(seen) == 0:
        raise NeecoError("--views orbit: the scene shows no surface to orbit about; use --views recorded")
    return np.median(seen, axis=0)
