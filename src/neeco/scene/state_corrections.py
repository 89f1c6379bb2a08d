"""Corrections of instrument states as smooth functions of the states: errors of a robot's calibration, which depend on
where its joints are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.rotations import rigid_from_vector
from neeco.raster.devices import CachedPredicate


@dataclass(frozen=True, kw_only=True)
class CorrectionSettings:
    """Size of the regression, and units of its features."""

    max_anchors: int = 64  # states that a correction is interpolated between
    position_mm: float = 10.0  # of a difference that counts as one
    angle_rad: float = 0.17  # the same of an angle, also of revolute joints
    slide_mm: float = 10.0  # the same of prismatic ones


CORRECTIONS = CorrectionSettings()
N_POSE_FEATURES = 12  # position and rotation matrix


class StateCorrections(nn.Module):
    """One kernel regression per instrument: increments are sums of Gaussian kernels at `anchors`, so that states far
    from all of them are not corrected.

    An instrument's increments are six of its pose in its own frame (rotation vector in rad, translation in mm), then
    one of each recorded reading of its stated kinematics (rad or mm). Buffers: `anchors` [I, A, F] features
    of states (see `features`), `weights` [I, A, 6 + R], `lengths` [I] of the kernels, in units of features.
    All weights are zero until errors are found that depend on the state.
    """

    anchors: Tensor
    weights: Tensor
    lengths: Tensor

    def __init__(self, instruments: Sequence[Instrument], device: torch.device) -> None:
        super().__init__()
        self.names = tuple(item.name for item in instruments)
        trees = [() if item.kinematics is None else item.kinematics.readings for item in instruments]
        self.readings = tuple(
            tuple(reading for reading in readings if reading not in item.unrecorded)
            for item, readings in zip(instruments, trees, strict=True)
        )
        slide, angle = CORRECTIONS.slide_mm, CORRECTIONS.angle_rad
        recorded = zip(instruments, self.readings, strict=True)
        self._units = [[slide if item.slides(name) else angle for name in readings] for item, readings in recorded]
        most = max(map(len, self.readings), default=0)
        zeros = partial(torch.zeros, device=device)
        self.register_buffer("anchors", zeros(len(self._units), CORRECTIONS.max_anchors, N_POSE_FEATURES + most))
        self.register_buffer("weights", zeros(len(self._units), CORRECTIONS.max_anchors, 6 + most))
        self.register_buffer("lengths", zeros(len(self._units)) + 1)
        self._corrects = CachedPredicate(lambda weights: weights.any())

    def features(self, index: int, state: InstrumentState) -> Tensor:
        """Return the features [F] of a state of instrument `index`, differences of which are compared by kernels."""
        pose = state.pose.detach().to(self.anchors)
        readings = [float(torch.as_tensor(state.joints[reading]).detach()) for reading in self.readings[index]]
        joints = [reading / unit for reading, unit in zip(readings, self._units[index], strict=True)]
        joints += [0.0] * (self.anchors.shape[2] - N_POSE_FEATURES - len(joints))
        rotation = pose[:3, :3].flatten() / (2**0.5 * CORRECTIONS.angle_rad)
        return torch.cat([pose[:3, 3] / CORRECTIONS.position_mm, rotation, pose.new_tensor(joints)])

    def increments(self, index: int, state: InstrumentState) -> Tensor:
        """Return the increments [6 + R] of a state of instrument `index`."""
        similar = kernel(self.features(index, state)[None], self.anchors[index], self.lengths[index])
        return similar[0] @ self.weights[index]

    def corrected(self, state: State) -> State:
        """Return `state` with the instruments' corrections."""
        if self.weights.is_meta or not self._corrects(self.weights):
            return state
        moved = dict(state.instruments)
        for index, (name, readings) in enumerate(zip(self.names, self.readings, strict=True)):
            if name in moved:
                before, increments = moved[name], self.increments(index, moved[name])
                joints = {**before.joints}
                for reading, change in zip(readings, increments[6:].tolist(), strict=False):
                    joints[reading] = joints[reading] + change
                pose = before.pose.to(increments) @ rigid_from_vector(increments[:6])
                moved[name] = InstrumentState(pose, joints)
        return replace(state, instruments=moved)


def kernel(one: Tensor, other: Tensor, length: Tensor | float) -> Tensor:
    """Return the Gaussian kernel [A, B] between features [A, F] and [B, F]."""
    return torch.exp(-0.5 * (one[:, None] - other).square().sum(2) / length**2)
