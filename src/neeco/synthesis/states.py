"""Samplers of instrument states.

A sampler turns (index, random generator) into a state. The generator is seeded by (seed, index) alone, so any image of
a data set can be rendered without the others, in any order, with the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.rotations import rigid
from neeco.labels.drawing import to_numpy

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
