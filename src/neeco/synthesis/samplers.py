"""Samplers of instrument states, of views, and of the state and camera of image `index`; the cameras that render them.

A sampler turns (index, random generator) into a state. The generator is seeded by (seed, index) alone, so any image of
a data set can be rendered without the others, in any order, with the same result. Views: recorded cameras, cameras near
them, cameras in orbit around the tissue.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, InstrumentState, RecordedStates, State, evenly_spaced
from neeco.capture.readers import read_states
from neeco.geometry.camera import Camera
from neeco.geometry.distortion import rays_of_pixels
from neeco.geometry.lens import Lens
from neeco.geometry.rotations import rigid
from neeco.labels.annotation import any_in_image, working_ends_or_origins
from neeco.labels.drawing import surface_depth, to_numpy
from neeco.raster import rasterize
from neeco.scene import DrawableScene, GaussianScene, Recorded
from neeco.scene.gaussian_scene import is_gaussian
from neeco.synthesis.settings import PATH_PREFIX, RECORDED_SIZE, ImageSettings, SizeSettings, Views

ZERO_SHARE = 0.05  # share of a joint's range: values beyond 0 by less are sensor noise
JITTER_SHARE = 0.02  # share of the recorded spread: jitter off the exact line between two recorded states


@dataclass(frozen=True)
class JointRange:
    """The range of a joint, rad."""

    lower: float
    upper: float

    def at(self, share: float) -> float:
        """Return the value with `share` of the range below it."""
        return float(self.lower + share * (self.upper - self.lower))

    def widened(self, margin: float, limits: tuple[float, float] | None) -> JointRange:
        """Return the range widened by `margin` of its length at either end, within `limits`. Without stated limits, a
        range on one side of 0 stays there: an angle of 0 is a closed jaw."""
        length = self.upper - self.lower
        reach = margin * length
        if limits is None and self.lower >= -ZERO_SHARE * length:
            limits = 0.0, math.inf
        elif limits is None and self.upper <= ZERO_SHARE * length:
            limits = -math.inf, 0.0
        lower, upper = self.lower - reach, self.upper + reach
        if limits is not None:
            # if stated limits are narrower than the recorded values, the latter count
            lower = min(self.lower, max(lower, limits[0]))
            upper = max(self.upper, min(upper, limits[1]))
        return JointRange(lower, upper)


class Shaft(NamedTuple):
    """The line that an instrument slides along and rotates about, in its own frame."""

    end: np.ndarray  # [3] mm; yaw and pitch turn about it
    along: np.ndarray  # [3] unit, towards the jaws
    learned: bool  # False: unknown shaft, replaced by the tracked frame's origin and z axis


def turn_about(point: np.ndarray, rotvec: np.ndarray) -> np.ndarray:
    """Return the rigid motion [4, 4] that rotates by a rotation vector [3] rad about `point` [3] mm."""
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    return rigid(rotation, point - rotation @ point)


def interpolate_pose(first: np.ndarray, second: np.ndarray, weight: float) -> np.ndarray:
    """Return the rigid pose [4, 4] between two: positions linearly, rotations by slerp.

    Weight 0 gives the first, 1 the second. Weights outside [0, 1] extrapolate.
    """
    start, end = Rotation.from_matrix(first[:3, :3]), Rotation.from_matrix(second[:3, :3])
    turn = (start.inv() * end).as_rotvec()
    rotation = (start * Rotation.from_rotvec(weight * turn)).as_matrix()
    return rigid(rotation, (1 - weight) * first[:3, 3] + weight * second[:3, 3])


def interpolate_state(first: State, second: State, weight: float) -> State:
    """Return the interpolated state of common instruments: poses as `interpolate_pose`, the rest linearly."""
    instruments = {}
    for name in (name for name in first.instruments if name in second.instruments):
        a, b = first.instruments[name], second.instruments[name]
        both = (joint for joint in a.joints if joint in b.joints)
        joints = {joint: (1 - weight) * a.joints[joint] + weight * b.joints[joint] for joint in both}
        pose = interpolate_pose(to_numpy(a.pose), to_numpy(b.pose), weight)
        instruments[name] = InstrumentState(torch.from_numpy(pose), joints)
    return State(instruments, (1 - weight) * first.time + weight * second.time)


def joint_ranges(states: Sequence[State]) -> dict[tuple[str, str], JointRange]:
    """Return the range of every joint, by (instrument, joint), over recorded states."""
    readings: dict[tuple[str, str], list[float]] = {}
    for state in states:
        for name, instrument in state.instruments.items():
            for joint, value in instrument.joints.items():
                readings.setdefault((name, joint), []).append(float(value))
    return {key: JointRange(min(values), max(values)) for key, values in readings.items()}


def _with_instruments(states: Sequence[State]) -> list[State]:
    if usable := [state for state in states if state.instruments]:
        return usable
    raise NeecoError("states: the scene was trained without instrument states; train on a capture that records them")


class InterpolatedStates:
    """States inside the recorded range.

    A random point between two random recorded states, jittered by a rigid motion common to all instruments (so that
    bodies tracked separately but joined in the world stay together), every position clipped to the recorded bounds;
    joints uniform over their recorded range.
    """

    def __init__(self, states: Sequence[State]) -> None:
        self.states = _with_instruments(states)
        self.ranges = joint_ranges(self.states)
        self.means: dict[str, np.ndarray] = {}  # mean position and the chordal mean of the rotations
        self.bounds: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        turns = []  # rad, the maximum from the mean rotation
        for name in {name for state in self.states for name in state.instruments}:
            poses = np.stack([to_numpy(s.instruments[name].pose) for s in self.states if name in s.instruments])
            rotations, positions = Rotation.from_matrix(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3])
            mean = rotations.mean().as_matrix()
            self.means[name] = rigid(mean, positions.mean(axis=0))
            self.bounds[name] = positions.min(0), positions.max(0)
            turns.append(float((Rotation.from_matrix(mean).inv() * rotations).magnitude().max()))
        spans = [upper - lower for lower, upper in self.bounds.values()]
        self.jitter_mm = JITTER_SHARE * float(np.linalg.norm(np.mean(spans, axis=0)))
        self.jitter_rad = JITTER_SHARE * float(np.mean(turns))

    def __call__(self, index: int, rng: Generator) -> State:
        first, second = (self.states[k] for k in rng.integers(len(self.states), size=2))
        if not set(first.instruments) & set(second.instruments):
            second = first
        state = interpolate_state(first, second, float(rng.random()))
        centre = np.mean([to_numpy(item.pose)[:3, 3] for item in state.instruments.values()], axis=0)
        turn = Rotation.from_rotvec(self.jitter_rad * rng.standard_normal(3)).as_matrix()
        shift = self.jitter_mm * rng.standard_normal(3)

        def jittered(name: str, pose: np.ndarray) -> np.ndarray:
            place = turn @ (pose[:3, 3] - centre) + centre + shift
            return rigid(turn @ pose[:3, :3], np.clip(place, *self.bounds[name]))

        state = with_poses(state, jittered)
        return with_joints(state, lambda name, joint: self.ranges[name, joint].at(rng.random()))


class ExtrapolatedStates(InterpolatedStates):
    """States from the recorded range widened by `margin`.

    Joints are uniform over their range widened by this share at either end, within stated limits; poses are sampled as
    in `InterpolatedStates` and then moved away from the mean recorded pose by a factor in [1, 1 + 2 margin], by which
    half the range around the mean grows; one factor for all instruments of a state.
    """

    def __init__(self, states: Sequence[State], instruments: Sequence[Instrument], margin: float) -> None:
        if not margin > 0:
            raise NeecoError(f"--margin: {margin} does not reach past the recorded range; give a fraction above 0")
        super().__init__(states)
        self.margin = margin
        limits = {(i.name, joint): limit for i in instruments for joint, limit in i.joints.items()}
        self.ranges = {key: r.widened(margin, limits.get(key)) for key, r in self.ranges.items()}

    def __call__(self, index: int, rng: Generator) -> State:
        state = super().__call__(index, rng)
        factor = 1 + 2 * self.margin * float(rng.random())
        return with_poses(state, lambda name, pose: interpolate_pose(self.means[name], pose, factor))


class GridStates:
    """Every joint value with every roll, at recorded poses.

    Cell `index` mod (joint_values * rolls): all joints at the same fraction of their recorded ranges, each instrument
    rolled about its shaft by -30 to 30 degrees. Each full round of cells uses another recorded pose.
    """

    def __init__(
        self, states: Sequence[State], shafts: Mapping[str, Shaft], joint_values: int = 5, rolls: int = 5
    ) -> None:
        self.states = _with_instruments(states)
        self.ranges = joint_ranges(self.states)
        self.shafts = shafts
        self.fractions = np.linspace(0, 1, joint_values)
        self.rolls = np.linspace(-np.pi / 6, np.pi / 6, rolls)

    def __call__(self, index: int, rng: Generator) -> State:
        round_number, cell = divmod(index, len(self.fractions) * len(self.rolls))
        fraction, roll = self.fractions[cell // len(self.rolls)], self.rolls[cell % len(self.rolls)]
        # golden-ratio steps: successive rounds are far apart in the recording
        base = self.states[int(round_number * 0.6180339887 * len(self.states)) % len(self.states)]

        turns = {name: turn_about(shaft.end, roll * shaft.along) for name, shaft in self.shafts.items()}
        state = with_poses(base, lambda name, pose: pose @ turns[name])
        return with_joints(state, lambda name, joint: self.ranges[name, joint].at(fraction))


class PathStates:
    """`count` states evenly spaced along key states, first and last included."""

    def __init__(self, keys: Sequence[State], count: int) -> None:
        if len(keys) < 2:
            raise NeecoError(f"--states path: {len(keys)} key state(s); a path needs at least two")
        self.keys, self.count = list(keys), count

    def place(self, index: int) -> tuple[int, float]:
        """Return the key state before state `index`, and the fraction of the way to the next one."""
        position = index / max(self.count - 1, 1) * (len(self.keys) - 1)
        segment = min(int(position), len(self.keys) - 2)
        return segment, position - segment

    def __call__(self, index: int, rng: Generator) -> State:
        segment, weight = self.place(index)
        return interpolate_state(self.keys[segment], self.keys[segment + 1], weight)


def with_poses(state: State, moved: Callable[[str, np.ndarray], np.ndarray]) -> State:
    """Return the state with every pose [4, 4] replaced by `moved(instrument, pose)`."""
    instruments = {
        name: InstrumentState(torch.from_numpy(moved(name, to_numpy(item.pose))), item.joints)
        for name, item in state.instruments.items()
    }
    return replace(state, instruments=instruments)


def with_joints(state: State, value: Callable[[str, str], float]) -> State:
    """Return the state with every joint set to `value(instrument, joint)`."""
    instruments = {
        name: InstrumentState(instrument.pose, {joint: value(name, joint) for joint in sorted(instrument.joints)})
        for name, instrument in state.instruments.items()
    }
    return replace(state, instruments=instruments)


StateSampler = Callable[[int, Generator], State]  # (index, its random numbers) -> state
# Draws a camera for a state; intrinsics and image size are always those of a recorded camera.
ViewSampler = Callable[[State, Generator], Camera]


class SimilarFrames:
    """Selects one of `count` recorded frames (its index): among the `n_similar` ones with the most similar states, or
    any if all states are equal. states: of the frames; empty: unknown."""

    n_similar: ClassVar[int] = 10  # recorded frames whose cameras are candidates for a sampled state

    def __init__(self, states: Sequence[State], count: int, joints: bool) -> None:
        common = set.intersection(*(set(state.instruments) for state in states)) if states else set()
        recorded = RecordedStates(states, sorted(common), joints) if common else None
        self._recorded = None if recorded is None or recorded.still else recorded
        self._count = count

    def any(self, rng: Generator) -> int:
        """Return any frame."""
        return int(rng.integers(self._count))

    def like(self, state: State, rng: Generator) -> int:
        """Return a frame whose state is similar to `state`."""
        if self._recorded is None or not set(self._recorded.instruments) <= set(state.instruments):
            return self.any(rng)
        nearest = np.argsort(self._recorded.distances(state), kind="stable")[: self.n_similar]
        return int(nearest[rng.integers(len(nearest))])


class RecordedViews:
    """The camera of a recorded frame, one of those with the most similar states.

    A camera that followed its instrument recorded it there: instruments are positioned in the image as in recorded
    ones, which a detector learns. states: the recorded frames'; empty: any camera.
    """

    def __init__(self, cameras: Sequence[Camera], states: Sequence[State] = ()) -> None:
        if not cameras:
            raise NeecoError("views: the scene stores no recorded cameras; train it again with this version")
        self.cameras = cameras
        self._frames = SimilarFrames(states, len(cameras), joints=False)

    def __call__(self, state: State, rng: Generator) -> Camera:
        return self.cameras[self._frames.like(state, rng)]


@dataclass(frozen=True)
class PerturbedViews:
    """A recorded camera, rotated about its centre and shifted, both normally distributed about zero.

    `degrees` and `mm` are standard deviations of the angle about each axis and of the shift along each.
    """

    recorded: RecordedViews
    degrees: float = 3.0
    mm: float = 3.0
    of_still: ClassVar[tuple[float, float]] = (1.0, 1.0)  # degrees, mm for a still scope, which saw one side

    def __call__(self, state: State, rng: Generator) -> Camera:
        camera = self.recorded(state, rng)
        turn = Rotation.from_rotvec(np.deg2rad(self.degrees) * rng.standard_normal(3)).as_matrix()
        offset = rigid(turn, self.mm * rng.standard_normal(3))
        return moved_camera(camera, to_numpy(camera.world_from_camera) @ offset)


@dataclass(frozen=True)
class RolledViews:
    """A recorded camera rolled about its optical axis by any angle: instruments enter the image from all sides, as
    through other ports."""

    recorded: RecordedViews

    def __call__(self, state: State, rng: Generator) -> Camera:
        camera = self.recorded(state, rng)
        roll = Rotation.from_rotvec([0.0, 0.0, 2 * np.pi * rng.random()]).as_matrix()
        return moved_camera(camera, to_numpy(camera.world_from_camera) @ rigid(roll, np.zeros(3)))


@dataclass(frozen=True)
class OrbitViews:
    """A recorded camera in orbit around `centre` (world mm), which stays at its position in the image.

    The rotation is uniform in direction and in angle up to `degrees`.
    """

    recorded: RecordedViews
    centre: np.ndarray  # [3] mm
    degrees: float = 20.0
    n_views: ClassVar[int] = 5  # recorded views that determine the centre

    def __call__(self, state: State, rng: Generator) -> Camera:
        camera = self.recorded(state, rng)
        world_from_camera = to_numpy(camera.world_from_camera)
        direction = 2 * np.pi * rng.random()
        # axis in the image plane: the camera moves sideways without roll
        axis = world_from_camera[:3, :3] @ np.array([np.cos(direction), np.sin(direction), 0.0])
        turn = turn_about(self.centre, np.deg2rad(self.degrees) * rng.random() * axis)
        return moved_camera(camera, turn @ world_from_camera)


@dataclass(frozen=True)
class Sampler:
    """Samples (state, camera) of image `index`."""

    scene: GaussianScene
    states: StateSampler
    views: ViewSampler
    cameras: tuple[Camera | None, ...] = (None,)  # prescribed with the states, in turn; None: by the view sampler
    prescribed: bool = False  # whether the state of an index is prescribed, not random
    max_view_attempts: ClassVar[int] = 50  # maximum number of views sampled until one contains the instrument

    def fixed(self, index: int) -> bool:
        """Return whether both state and camera of image `index` are prescribed: resampling would not change them."""
        return self.prescribed and self.cameras[index % len(self.cameras)] is not None

    def __call__(self, index: int, rng: Generator) -> tuple[State, Camera]:
        """Return the next (state, camera) for image `index`.

        Most views of a moving camera do not contain the instrument, and rendering is slow: views are sampled until one
        does, at most `max_view_attempts` times.
        """
        state = self.states(index, rng)
        prescribed = self.cameras[index % len(self.cameras)]
        if prescribed is not None:
            return state, prescribed
        points = working_ends_or_origins(self.scene, state)
        camera = self.views(state, rng)
        for _ in range(self.max_view_attempts):
            if any_in_image(camera, points):
                break
            camera = self.views(state, rng)
        return state, camera


def make_sampler(scene: GaussianScene, states: str, margin: float, views: Views, count: int) -> Sampler:
    """Return the sampler named by `states` (interpolate, extrapolate, grid, path:FILE or FILE) and `views`. Raises
    NeecoError."""
    recorded = RecordedViews(scene.recorded.cameras, scene.recorded.states)
    view_sampler: ViewSampler = recorded
    still = scene.recorded.still
    if views == "perturbed":
        view_sampler = PerturbedViews(recorded, *(PerturbedViews.of_still if still else ()))
    if views == "rolled":
        view_sampler = RolledViews(recorded)
    if views == "orbit":
        if still:
            raise NeecoError("--views orbit: the scope was still, which shows only one side; use recorded or perturbed")
        chosen = evenly_spaced(len(scene.recorded.cameras), OrbitViews.n_views, floor=True)
        with torch.no_grad():
            seen = [(scene.at(scene.recorded.states[k]), scene.recorded.cameras[k]) for k in chosen]
            points = [surface_points(surface_depth(rasterize(*view)), view[1]) for view in seen]
        if not sum(map(len, points)):
            raise NeecoError("--views orbit: the scene shows no surface to orbit about; use --views recorded")
        view_sampler = OrbitViews(recorded, np.median(np.concatenate(points), axis=0))
    if states == "interpolate":
        return Sampler(scene, InterpolatedStates(scene.recorded.states), view_sampler)
    if states == "extrapolate":
        return Sampler(scene, ExtrapolatedStates(scene.recorded.states, scene.instruments, margin), view_sampler)
    if states == "grid":
        return Sampler(scene, GridStates(scene.recorded.states, shafts_of(scene)), view_sampler, prescribed=True)
    lines = read_states(states_file(states), scene.recorded.with_limits(scene.instruments))
    if states.startswith(PATH_PREFIX):
        return Sampler(scene, PathStates([line.state for line in lines], count), view_sampler, prescribed=True)
    intrinsics = scene.recorded.cameras[0]
    poses = [line.world_from_camera for line in lines]
    cameras = tuple(None if pose is None else moved_camera(intrinsics, pose) for pose in poses)
    # cyclic when more images than states are requested
    return Sampler(scene, lambda index, _: lines[index % len(lines)].state, view_sampler, cameras, prescribed=True)


def states_file(states: str) -> Path:
    """Return the file named by `--states`. Raises NeecoError if it is a misspelled sampler."""
    path = Path(states.removeprefix(PATH_PREFIX))
    if path.is_dir() or (not path.suffix and not path.exists()):
        raise NeecoError(f"--states: {states!r} is neither interpolate, extrapolate, grid, path:FILE.jsonl nor a file")
    return path


@torch.no_grad()
def shafts_of(scene: DrawableScene) -> dict[str, Shaft]:
    """Return every instrument's shaft, as learned if the method learns one."""
    shafts = {item.name: Shaft(np.zeros(3), np.array([0.0, 0.0, 1.0]), False) for item in scene.instruments}
    if not is_gaussian(scene) or not scene.recorded.states:
        return shafts
    state = scene.recorded.states[0]
    for name, points in scene.keypoints(state).items():
        if not {"shaft_far", "shaft_near"} <= set(points):
            continue
        from_world = np.linalg.inv(to_numpy(scene.registered(state).instruments[name].pose))
        ends = (to_numpy(points[end]) for end in ("shaft_far", "shaft_near"))
        far, near = ((from_world @ np.append(end, 1.0))[:3] for end in ends)
        if (length := float(np.linalg.norm(near - far))) > 1e-6:
            shafts[name] = Shaft(near, (near - far) / length, True)
    return shafts


def moved_camera(camera: Camera, world_from_camera: np.ndarray) -> Camera:
    """Return the camera at another pose; world_from_camera [4, 4] with OpenCV axes."""
    return replace(camera, world_from_camera=torch.from_numpy(world_from_camera).to(camera.world_from_camera))


def surface_points(depth: np.ndarray, camera: Camera, step: int = 4) -> np.ndarray:
    """Return world points [P, 3] mm under every `step`-th pixel of a depth image [H, W] mm, if not 0."""
    rows, columns = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    z = depth[rows, columns]
    if camera.is_pinhole:
        across, down = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    else:
        pixels = np.stack([columns + 0.5, rows + 0.5], -1)
        across, down = rays_of_pixels(pixels.reshape(-1, 2), camera).reshape(pixels.shape).transpose(2, 0, 1)
    points = np.stack([across * z, down * z, z, np.ones_like(z)], -1)[z > 0]
    return (points @ to_numpy(camera.world_from_camera).T)[:, :3]


@dataclass(frozen=True)
class DrawnCameras:
    """Maps cameras with recorded intrinsics to those that render. `lens`: the recording's, if distortion is
    requested."""

    size: SizeSettings
    lens: Lens | None = None

    @classmethod
    def of(cls, images: ImageSettings, recorded: Recorded, cameras: Iterable[Camera]) -> DrawnCameras:
        """Return the cameras that `images` request. Raises NeecoError for invalid settings, a recording without a lens,
        and a camera among `cameras` whose images have another shape."""
        images.check()
        if images.lens and recorded.lens is None:
            raise NeecoError("--lens: the scene's capture states no lens; ingest it and train again, or remove --lens")
        drawn_cameras = cls(images, recorded.lens if images.lens else None)
        for camera in cameras:
            drawn_cameras(camera)
        return drawn_cameras

    def __call__(self, camera: Camera) -> Camera:
        """Return the rendering camera for `camera`, a pinhole."""
        seen = camera if self.lens is None else self.lens.distorted_camera(camera)
        size = self.size.of(seen.width, seen.height)
        return seen if size == (seen.width, seen.height) else seen.resized(*size)


RECORDED_CAMERAS = DrawnCameras(RECORDED_SIZE)
