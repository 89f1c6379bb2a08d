"""How camera and instrument move, and what trackers make of it. float64, mm, rad, s; the scene frame has z up."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

FRAME_RATE = 25.0
TEST_EVERY, TEST_AT = 8, 4
THINNINGS = (3, 9, 27)  # a slowed recording is also learned from every third training frame, every ninth, every 27th
Array = np.ndarray


@dataclass(frozen=True)
class Path:
    """The ranges of a scene's motion. `*_train` bound the training frames; unseen frames go on to `*_most`."""

    camera_center: tuple[float, float, float]
    camera_sway: tuple[float, float, float]
    look_at: tuple[float, float, float]
    look_sway: tuple[float, float]
    camera_roll: float  # rad about the view's axis
    trocar: tuple[float, float, float]  # the shaft passes here
    hinge_center: tuple[float, float, float]
    hinge_sway: tuple[float, float, float]
    hinge_extra: tuple[float, float, float]  # how far unseen poses lie from the middle, beyond the sway
    opening_train: float
    opening_most: float
    roll_middle: float
    roll_train: float  # about the middle, either way
    roll_most: float
    wrist_train: tuple[float, ...] = ()  # how far the joints of a wrist turn either way
    wrist_most: tuple[float, ...] = ()


@dataclass(frozen=True)
class Bend:
    """How the joints of a wristed instrument stand, rad."""

    opening: float
    pitch: float
    yaw: float


@dataclass(frozen=True)
class Moment:
    """Exact poses and state at one time."""

    scene_from_camera: Array  # [4, 4], OpenCV axes
    scene_from_mechanical: Array
    opening: float
    roll: float  # about the middle of the range
    hinge: Array  # [3], scene frame; where it is while the wrist is straight
    wrist: tuple[float, ...] = ()  # pitch and yaw

    @property
    def joints(self) -> float | Bend:
        """What the instrument's design takes: the opening of one that has no wrist."""
        return Bend(self.opening, *self.wrist) if self.wrist else self.opening


@dataclass(frozen=True)
class Trajectory:
    """A recording's motion as a function of time (s), and its frames' splits."""

    path: Path
    hinge_mm: float  # from the mechanical frame's origin to the hinge, along z
    times: Array
    splits: tuple[str, ...]
    _camera: Callable[[float], tuple[Array, Array]]  # centre and point looked at
    _hinge: CubicSpline
    _opening: PchipInterpolator
    _roll: PchipInterpolator
    _wrist: CubicSpline | None = None
    slower: float = 1.0  # the planned motion takes so many times its time

    def at(self, time: float) -> Moment:
        """Everything at `time`; times a little outside the recording are as good as its ends."""
        time = float(np.clip(time, self.times[0] - 0.1, self.times[-1] + 0.1)) / self.slower
        center, target = self._camera(time)
        hinge = np.asarray(self._hinge(time))
        opening, roll = float(self._opening(time)), float(self._roll(time))
        return Moment(
            look(center, target, self.path.camera_roll),
            aim(np.array(self.path.trocar), hinge, self.path.roll_middle + roll, self.hinge_mm),
            opening,
            roll,
            hinge,
            () if self._wrist is None else tuple(map(float, self._wrist(time))),
        )


def plan(path: Path, hinge_mm: float, seen: int, unseen: int, seed: int) -> Trajectory:
    """A smooth trajectory: the instrument comes in, sweeps, rolls, opens and closes within the training ranges; then
    `unseen` frames, the first half with the jaws wider and the rest rolled and moved farther than ever before."""
    generator = np.random.default_rng(seed)
    count = seen + unseen
    times = np.arange(count) / FRAME_RATE
    end, last = (seen - 1) / FRAME_RATE, times[-1]
    rest = last - end
    splits = tuple("unseen" if n >= seen else "test" if n % TEST_EVERY == TEST_AT else "train" for n in range(count))
    phase = generator.uniform(0, 2 * np.pi, 5)
    knots = np.linspace(0, end, max(4, round(end / 0.85)))
    beyond = end + rest * np.array([0.25, 0.5, 0.75, 1.0])
    hinge = np.array(path.hinge_center) + np.array(path.hinge_sway) * _spread(len(knots), 3, generator)
    trocar = np.array(path.trocar)
    hinge[0] += 0.09 * (trocar - hinge[0])  # the instrument comes in
    extra = np.array(path.hinge_center) + np.array(path.hinge_extra)
    far = np.stack([hinge[-1], hinge[-1] * 0.5 + extra * 0.5, extra, extra + 0.3 * np.array(path.hinge_sway)])

    def camera(time: float) -> tuple[Array, Array]:
        waves = np.sin(2 * np.pi * time / np.array([7.9, 5.7, 9.7, 6.7, 8.9]) + phase)
        center = np.array(path.camera_center) + np.array(path.camera_sway) * waves[:3]
        return center, np.array(path.look_at) + np.array([*(np.array(path.look_sway) * waves[3:]), 0.0])

    return Trajectory(
        path,
        hinge_mm,
        times,
        splits,
        camera,
        CubicSpline(np.r_[knots, beyond], np.concatenate([hinge, far])),
        _opening_curve(path, end, rest, generator),
        _roll_curve(path, end, rest, generator),
        _wrist_curve(path, end, rest, np.random.default_rng((seed, 1))) if any(path.wrist_train) else None,
    )


def slowed(trajectory: Trajectory, frames: int) -> Trajectory:
    """The same motion, so slow that `frames`, a multiple of 27, training frames show what the planned ones do.

    Test frames lie midway between two neighbouring training frames, and do so whichever of `THINNINGS` is learned from.
    Unseen frames show the states they did. Recordings whose numbers of training frames are multiples share states.
    """
    seen = trajectory.splits.index("unseen")
    slower = frames / FRAME_RATE / float(trajectory.times[seen - 1])
    every = THINNINGS[-1]
    train = np.arange(frames) / FRAME_RATE
    test = np.arange(every / 2, frames - every, every) / FRAME_RATE
    times = np.concatenate([train, test, trajectory.times[seen:] * slower])
    splits = ["train"] * len(train) + ["test"] * len(test) + ["unseen"] * (len(trajectory.times) - seen)
    order = np.argsort(times)
    return replace(trajectory, times=times[order], splits=tuple(splits[i] for i in order), slower=slower)


def is_unseen(path: Path, moment: Moment) -> bool:
    """The rule of the split: wider or rolled farther than any training frame."""
    return moment.opening > path.opening_train or abs(moment.roll) > path.roll_train


def _opening_curve(path: Path, end: float, rest: float, generator: np.random.Generator) -> PchipInterpolator:
    knots = np.linspace(0, end, max(4, round(end / 0.7)))
    low, high = 0.02 * path.opening_train, 0.98 * path.opening_train
    ups = np.arange(len(knots)) % 2 == 0
    values = np.where(ups, generator.uniform(0.55, 1.0, len(knots)), generator.uniform(0.0, 0.4, len(knots)))
    values = low + (high - low) * (values - values.min()) / np.ptp(values)
    values[-1] = high
    over, most = path.opening_train * 1.02, path.opening_most
    after = np.array([0.15, 0.28, 0.40, 0.48, 0.56, 0.72, 0.86, 1.0]) * rest + end
    wide = [(over + most) / 2, most, over + 0.6 * (most - over), most * 0.97, over, 0.35 * high, 0.7 * high, 0.4 * high]
    first = end + 0.98 / FRAME_RATE  # the first unseen frame is already past the limit
    return PchipInterpolator(np.r_[knots, first, after], np.r_[values, over, wide])


def _roll_curve(path: Path, end: float, rest: float, generator: np.random.Generator) -> PchipInterpolator:
    knots = np.linspace(0, end, max(4, round(end / 1.1)))
    values = generator.uniform(0.5, 0.98, len(knots)) * np.where(np.arange(len(knots)) % 2 == 0, -1, 1)
    values = values / np.abs(values).max() * 0.98 * path.roll_train
    values[-1] = 0.2 * path.roll_train
    after = np.array([0.3, 0.44, 0.52, 0.65, 0.82, 1.0]) * rest + end
    far = [0.1 * path.roll_train, 0.7 * path.roll_train, 1.03 * path.roll_train, path.roll_most]
    far += [(path.roll_train + path.roll_most) / 2, 0.95 * path.roll_most]
    return PchipInterpolator(np.r_[knots, after], np.r_[values, far])


def _wrist_curve(path: Path, end: float, rest: float, generator: np.random.Generator) -> CubicSpline:
    """Pitch and yaw: over all of their training range, then beyond it, one after the other."""
    knots = np.linspace(0, end, max(5, round(end / 0.9)))
    train, most = np.array(path.wrist_train), np.array(path.wrist_most)
    seen = 0.9 * train * _spread(len(knots), len(train), generator)  # a spline goes a little beyond its knots
    after = np.array([0.25, 0.5, 0.75, 1.0]) * rest + end
    signs = np.array([[1.0, 0.2], [-0.3, 1.0], [-1.0, -0.4], [0.5, -1.0]])
    return CubicSpline(np.r_[knots, after], np.concatenate([seen, signs * most]))


def _spread(count: int, width: int, generator: np.random.Generator) -> Array:
    """[count, width] in [-1, 1], each column evenly filled in random order."""
    base = np.linspace(-1, 1, count)
    return np.stack([generator.permutation(base) for _ in range(width)], -1)


def look(center: Array, target: Array, roll: float) -> Array:
    """Camera pose [4, 4] (OpenCV axes) whose image x is about the scene's x, rolled about the view's axis."""
    forward = _unit(target - center)
    about = np.array([math.sin(roll), -math.cos(roll), 0.0])
    down = _unit(about - forward * (about @ forward))
    return rigid(np.stack([np.cross(down, forward), down, forward], -1), center)


def aim(trocar: Array, hinge: Array, roll: float, hinge_mm: float) -> Array:
    """Pose [4, 4] of the mechanical frame of an instrument through `trocar` whose hinge is at `hinge`."""
    z = _unit(hinge - trocar)
    x = _unit(np.cross(np.array([0.0, 0.0, 1.0]), z))
    rotation = np.stack([x, np.cross(z, x), z], -1) @ Rotation.from_rotvec([0, 0, roll]).as_matrix()
    return rigid(rotation, hinge - hinge_mm * z)


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def rigid(rotation: Array, translation: Array) -> Array:
    """[4, 4] from rotation [3, 3] and translation [3]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix
