"""The numbers by which states are changed: an increment of pose and joints for every instrument."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.geometry.rotations import rigid_from_vector, vector_from_rotation
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.scene import GaussianScene

DEG = math.pi / 180
BELOW, ABOVE = 0.1, 0.5  # of a joint's recorded range: how far below and above it a joint is looked for
STEP_DEG, STEP_MM, STEP_JOINT_DEG = 0.2, 0.1, 0.5  # finite differences at full size


@dataclass(frozen=True)
class TrackedInstrument:
    """One instrument's axis and what its joints may be."""

    name: str
    pivot: Tensor  # [3] mm, instrument frame: what it turns about; its first joint, or where its shaft ends
    axis: Tensor  # [3] unit, along the shaft, instrument frame
    joints: tuple[str, ...]
    slides: tuple[bool, ...]
    low: Tensor  # [J] rad or mm
    high: Tensor


@dataclass(frozen=True)
class Coordinates:
    """Increments of states: P numbers, for every instrument a rotation vector (rad) about its pivot, a translation (mm)
    along its own axes, then its joints (rad or mm)."""

    instruments: tuple[TrackedInstrument, ...]

    @classmethod
    def of(cls, scene: GaussianScene) -> Coordinates:
        """Raises NeecoError for a scene that does not keep tissue and instruments apart, or knows no instrument."""
        deformation = scene.deformation
        if not (deformation.separates_instruments and isinstance(deformation, ArticulatedInstruments)):
            raise NeecoError(
                f"track: method {scene.method} does not keep tissue and instruments apart; use a run of method "
                "kinematic"
            )
        if not scene.instruments:
            raise NeecoError("track: the run has no instrument; train on a capture that records one")
        if not scene.recorded.states:
            raise NeecoError("track: the run remembers no recorded frame; train it again with this version")
        found = []
        for instrument, articulation in zip(scene.instruments, deformation.articulations, strict=True):
            shaft = articulation.shaft()
            if articulation.jointed:
                pivot = articulation.axes(shaft)[0][-1]
            else:
                pivot = articulation.keypoints({})["shaft_near"]
            found.append(_tracked(instrument, scene.recorded.states, pivot, shaft[1]))
        return cls(tuple(found))

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each instrument's numbers are."""
        found, start = [], 0
        for item in self.instruments:
            found.append(slice(start, start + 6 + len(item.joints)))
            start = found[-1].stop
        return tuple(found)

    @property
    def size(self) -> int:
        """P."""
        return self.slices[-1].stop

    def each(self, degrees: float, millimetres: float, joint_degrees: float, joint_millimetres: float) -> Tensor:
        """[P] with one number for rotations, translations, and joints that turn or slide; angles become rad."""
        rows = []
        for item in self.instruments:
            rows += [degrees * DEG] * 3 + [millimetres] * 3
            rows += [joint_millimetres if slides else joint_degrees * DEG for slides in item.slides]
        return torch.tensor(rows, dtype=torch.float64)

    @property
    def steps(self) -> Tensor:
        """[P] finite differences at full size."""
        return self.each(STEP_DEG, STEP_MM, STEP_JOINT_DEG, STEP_MM)

    def moved(self, state: State, increments: Tensor) -> State:
        """`state` changed by increments [P], joints kept within their bounds."""
        instruments = dict(state.instruments)
        for item, rows in zip(self.instruments, self.slices, strict=True):
            own, given = increments[rows], state.instruments[item.name]
            turn = rigid_from_vector(own[:6])
            turn[:3, 3] += item.pivot - turn[:3, :3] @ item.pivot
            values = torch.tensor([given.joints[name] for name in item.joints], dtype=torch.float64) + own[6:]
            values = values.clamp(item.low, item.high)
            joints = dict(zip(item.joints, values.tolist(), strict=True))
            instruments[item.name] = InstrumentState(given.pose.double() @ turn, joints)
        return replace(state, instruments=instruments)

    def between(self, state: State, other: State) -> Tensor:
        """[P] with which `moved(state, …)` is `other`."""
        rows = []
        for item in self.instruments:
            a, b = state.instruments[item.name], other.instruments[item.name]
            turn = torch.linalg.inv(a.pose.double()) @ b.pose.double()
            shift = turn[:3, 3] - item.pivot + turn[:3, :3] @ item.pivot
            joints = torch.tensor([b.joints[name] - a.joints[name] for name in item.joints], dtype=torch.float64)
            rows += [vector_from_rotation(turn[:3, :3]), shift, joints]
        return torch.cat(rows)

    def inwards(self, state: State, index: int, step: float) -> int:
        """1, or -1 where number `index` is a joint that a step upwards would lead beyond its bounds."""
        for item, rows in zip(self.instruments, self.slices, strict=True):
            joint = index - rows.start - 6
            if 0 <= joint < len(item.joints):
                value = state.instruments[item.name].joints[item.joints[joint]]
                return -1 if value + step > float(item.high[joint]) else 1
        return 1

    def along(self, instrument: int, millimetres: float = 0.0, roll: float = 0.0) -> Tensor:
        """[P] that shifts one instrument along its shaft and rolls it (rad) about it."""
        item, rows = self.instruments[instrument], self.slices[instrument]
        increments = torch.zeros(self.size, dtype=torch.float64)
        increments[rows.start : rows.start + 3] = roll * item.axis
        increments[rows.start + 3 : rows.start + 6] = millimetres * item.axis
        return increments

    def with_joints(self, state: State, instrument: int, values: Sequence[float]) -> State:
        """`state` with one instrument's joints at `values` [J]."""
        item = self.instruments[instrument]
        given = state.instruments[item.name]
        joints = dict(zip(item.joints, map(float, values), strict=True))
        return replace(state, instruments={**state.instruments, item.name: replace(given, joints=joints)})


def _tracked(instrument: Instrument, states: Sequence[State], pivot: Tensor, axis: Tensor) -> TrackedInstrument:
    names = tuple(instrument.joints)
    values = torch.tensor(
        [[state.instruments[instrument.name].joints[name] for name in names] for state in states], dtype=torch.float64
    ).reshape(len(states), len(names))
    low, high = values.amin(0), values.amax(0)
    low, high = low - BELOW * (high - low), high + ABOVE * (high - low)
    for k, name in enumerate(names):
        limits = instrument.joints[name]
        if limits is not None:  # of what was recorded, noise may pass them
            low[k], high[k] = max(float(low[k]), limits[0]), min(float(high[k]), limits[1])
    return TrackedInstrument(
        instrument.name,
        pivot.detach().cpu().double(),
        axis.detach().cpu().double(),
        names,
        tuple(instrument.slides(name) for name in names),
        low,
        high,
    )
