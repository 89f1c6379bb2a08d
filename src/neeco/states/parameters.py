"""Parameters that correct states and cameras, and their priors.

Used by all fits: Levenberg-Marquardt on one image (`alignment`, `fitter`) and Adam during training (`refinement`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid, rigid_from_vector

DEG = math.pi / 180


def moved_pose(pose: Tensor, increment: Tensor, pivot: Tensor | None = None) -> Tensor:
    """Return `pose` [4, 4] moved in its own frame, in the increment's precision; differentiable.

    increment [6]: rotation vector (rad) about `pivot` [3] mm (None: the origin), then translation (mm).
    """
    if not (increment.requires_grad or pose.requires_grad) and increment.dtype == torch.float64:
        vector = increment.detach().cpu().numpy()  # without gradients ten times as fast in numpy
        array = rigid(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])
        if pivot is not None:
            place = pivot.cpu().numpy()
            array[:3, 3] += place - array[:3, :3] @ place
        return torch.from_numpy(pose.detach().cpu().double().numpy() @ array).to(increment.device)
    step = rigid_from_vector(increment)
    if pivot is not None:
        step[:3, 3] += pivot - step[:3, :3] @ pivot
    return pose.to(increment) @ step


def moved_camera(camera: Camera, increment: Tensor) -> Camera:
    """Return `camera` moved in its own frame by `increment` [6] (see `moved_pose`)."""
    return replace(camera, world_from_camera=moved_pose(camera.world_from_camera, increment))


def sds_of(sizes: tuple[float, ...], slides: Sequence[bool] | np.ndarray) -> np.ndarray:
    """Return the standard deviations [6 + J] of an instrument's two tilts and roll (rad), two shifts across the view
    and one in depth (mm), and joints, of which `slides` [J] are prismatic; sizes: tilt, roll, across, depth, joint
    (rad), prismatic joint (mm)."""
    tilt, roll, across, depth, turn, slide = sizes
    return np.append([tilt, tilt, roll, across, across, depth], np.where(slides, slide, turn))


@dataclass(frozen=True, kw_only=True)
class InstrumentParameters:
    """Parameters of one instrument: six of its pose (see `moved_pose`), then one per joint (rad or mm)."""

    name: str
    joints: tuple[str, ...]
    slides: tuple[bool, ...]  # which joints are prismatic
    pivot: Tensor | None = None  # [3] mm, instrument frame, centre of rotations; None: the origin
    low: Tensor | None = None  # [J] rad or mm, bounds of the joints' values; None: unbounded
    high: Tensor | None = None

    @classmethod
    def of(cls, instrument: Instrument, unstated: Sequence[str] = ()) -> InstrumentParameters:
        """Return the parameters of an instrument's pose and of its joints in stated kinematics, or else `unstated`."""
        joints = tuple(unstated) if instrument.kinematics is None else tuple(instrument.kinematics.readings)
        return cls(name=instrument.name, joints=joints, slides=tuple(map(instrument.slides, joints)))


@dataclass(frozen=True)
class StateParameters:
    """Vector of P parameters that correct a state: those of every instrument, then six of the camera."""

    instruments: tuple[InstrumentParameters, ...]
    joints_last: bool = False  # the joints of all instruments follow all poses; else each instrument's follow its pose
    camera: bool = False  # whether the camera has parameters

    @cached_property
    def rows(self) -> tuple[tuple[slice, slice], ...]:
        """Return the slices of each instrument's pose and joints in the vector."""
        places, joints_before = [], 0
        for index, item in enumerate(self.instruments):
            pose = 6 * index + (0 if self.joints_last else joints_before)
            joints = 6 * len(self.instruments) + joints_before if self.joints_last else pose + 6
            places.append((slice(pose, pose + 6), slice(joints, joints + len(item.joints))))
            joints_before += len(item.joints)
        return tuple(places)

    @cached_property
    def size(self) -> int:
        """Return P."""
        return sum(6 + len(item.joints) for item in self.instruments) + 6 * self.camera

    def vector(
        self, radians: float, millimetres: float, joints: tuple[float, float], camera: tuple[float, float] = (0.0, 0.0)
    ) -> Tensor:
        """Return [P] float64 with one number each for rotations, translations, joints (revolute rad, prismatic mm), and
        the camera's rotation and translation."""
        values = torch.empty(self.size, dtype=torch.float64)
        for item, (pose, rows) in zip(self.instruments, self.rows, strict=True):
            values[pose] = torch.tensor([radians] * 3 + [millimetres] * 3, dtype=torch.float64)
            values[rows] = torch.tensor([joints[slides] for slides in item.slides], dtype=torch.float64)
        if self.camera:
            values[-6:] = torch.tensor([camera[0]] * 3 + [camera[1]] * 3, dtype=torch.float64)
        return values

    def vector_from_degrees(
        self, degrees: float, millimetres: float, joint_degrees: float, joint_millimetres: float
    ) -> Tensor:
        """Return the `vector` [P] of numbers in degrees and mm."""
        return self.vector(degrees * DEG, millimetres, (joint_degrees * DEG, joint_millimetres))

    def moved_by_parts(self, state: State, poses: Sequence[Tensor], joints: Sequence[Sequence[Any]] | None) -> State:
        """Return `state` with every instrument's pose moved by [6] of `poses` and its joints by [J] of `joints`, within
        their bounds (None: joints stay); differentiable if these are tensors."""
        instruments = dict(state.instruments)
        for number, (item, increment) in enumerate(zip(self.instruments, poses, strict=True)):
            before = instruments[item.name]
            values = dict(before.joints)
            if joints is not None:
                for index, (name, change) in enumerate(zip(item.joints, joints[number], strict=True)):
                    values[name] = before.joints[name] + change
                    if item.low is not None and item.high is not None:
                        values[name] = min(max(values[name], float(item.low[index])), float(item.high[index]))
            instruments[item.name] = InstrumentState(moved_pose(before.pose, increment, item.pivot), values)
        return replace(state, instruments=instruments)

    def moved(self, state: State, parameters: Tensor) -> State:
        """Return `state` moved by `parameters` [P] float64."""
        poses, joints = zip(*self.rows, strict=True)
        return self.moved_by_parts(
            state, [parameters[rows] for rows in poses], [parameters[rows].tolist() for rows in joints]
        )

    def increments_between(self, state: State, other: State) -> Tensor:
        """Return the parameters [P] with which `moved(state, …)` is `other`."""
        delta = torch.zeros(self.size, dtype=torch.float64)
        for item, (pose, joints) in zip(self.instruments, self.rows, strict=True):
            a, b = state.instruments[item.name], other.instruments[item.name]
            one, two = (each.pose.detach().cpu().double().numpy() for each in (a, b))
            step = np.linalg.inv(one) @ two
            shift = step[:3, 3]
            if item.pivot is not None:
                pivot = item.pivot.cpu().numpy()
                shift = shift - pivot + step[:3, :3] @ pivot
            vector = Rotation.from_matrix(step[:3, :3]).as_rotvec()
            delta[pose] = torch.from_numpy(np.concatenate([vector, shift]))
            delta[joints] = torch.tensor([b.joints[name] - a.joints[name] for name in item.joints], dtype=torch.float64)
        return delta

    def step_sign(self, state: State, index: int, step: float) -> int:
        """Return 1, or -1 if `step` upwards would move joint parameter `index` beyond its bounds."""
        for item, (_, joints) in zip(self.instruments, self.rows, strict=True):
            if joints.start <= index < joints.stop:
                value = state.instruments[item.name].joints[item.joints[index - joints.start]] + step
                return -1 if item.high is not None and value > float(item.high[index - joints.start]) else 1
        return 1
