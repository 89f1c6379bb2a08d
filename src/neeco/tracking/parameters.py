"""Parameters of tracked states: rotations about a joint, joints near their recorded range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import State
from neeco.methods.kinematic.articulation import ArticulatedInstruments
from neeco.scene import GaussianScene
from neeco.states.crop_rendering import InstrumentRenderer, TissueRenderer
from neeco.states.fitter import Fitter
from neeco.states.parameters import InstrumentParameters, StateParameters

RANGE_BELOW, RANGE_ABOVE = 0.1, 0.5  # extension of a joint's range, as shares of its recorded range


@dataclass(frozen=True, kw_only=True)
class TrackedInstrument(InstrumentParameters):
    """Parameters of one instrument, its shaft's axis, and the bounds of its joints."""

    pivot: Tensor  # [3] mm, instrument frame: its first joint, or the end of its shaft
    axis: Tensor  # [3] unit, along the shaft, instrument frame
    low: Tensor  # [J] rad or mm
    high: Tensor


@dataclass(frozen=True)
class TrackedParameters(StateParameters):
    """The parameters of all instruments of a scene."""

    instruments: tuple[TrackedInstrument, ...]

    @classmethod
    def of(cls, scene: GaussianScene) -> TrackedParameters:
        """Create them for a scene. Raises NeecoError if its tissue and instruments are not separate, or it has no
        instrument."""
        deformation = scene.deformation
        if not (deformation.separates_instruments and isinstance(deformation, ArticulatedInstruments)):
            raise NeecoError(
                f"track: method {scene.method} does not keep tissue and instruments apart; use a run of method "
                "kinematic"
            )
        if not scene.instruments:
            raise NeecoError("track: the run has no instrument; train on a capture that records one")
        if not scene.recorded.states:
            raise NeecoError("track: the run stores no recorded frames; train it again with this version")
        instruments = []
        for instrument, articulation in zip(scene.instruments, deformation.articulations, strict=True):
            shaft, names = articulation.shaft(), tuple(instrument.joints)
            recorded = [state.instruments[instrument.name].joints for state in scene.recorded.states]
            values = torch.tensor([[joints[name] for name in names] for joints in recorded], dtype=torch.float64)
            values = values.reshape(len(recorded), len(names))
            lowest, highest = values.amin(0), values.amax(0)
            low, high = lowest - RANGE_BELOW * (highest - lowest), highest + RANGE_ABOVE * (highest - lowest)
            for k, name in enumerate(names):
                limits = instrument.joints[name]
                if limits is not None:  # noisy recorded values may exceed them
                    low[k], high[k] = max(float(low[k]), limits[0]), min(float(high[k]), limits[1])
            if articulation.jointed:
                pivot = articulation.axes(shaft)[0][-1]
            else:
                pivot = articulation.keypoints({})["shaft_near"]
            instruments.append(
                TrackedInstrument(
                    name=instrument.name,
                    joints=names,
                    slides=tuple(instrument.slides(name) for name in names),
                    pivot=pivot.detach().cpu().double(),
                    axis=shaft[1].detach().cpu().double(),
                    low=low,
                    high=high,
                )
            )
        return cls(tuple(instruments))

    def along(self, instrument: int, millimetres: float = 0.0, roll: float = 0.0) -> Tensor:
        """Return the parameters [P] that shift one instrument along its shaft and roll it (rad) about it."""
        axis, (pose, _) = self.instruments[instrument].axis, self.rows[instrument]
        increments = torch.zeros(self.size, dtype=torch.float64)
        increments[pose] = torch.cat([roll * axis, millimetres * axis])
        return increments

    def with_joints(self, state: State, instrument: int, values: Sequence[float]) -> State:
        """Return `state` with one instrument's joints at `values` [J]."""
        item = self.instruments[instrument]
        previous = state.instruments[item.name]
        joints = dict(zip(item.joints, map(float, values), strict=True))
        return replace(state, instruments={**state.instruments, item.name: replace(previous, joints=joints)})


TrackingFitter = Fitter[TrackedParameters]


def fitter_of(scene: GaussianScene) -> TrackingFitter:
    """Return the fitter of a scene's instruments over its tissue. Raises NeecoError as `TrackedParameters.of`."""
    parameters = TrackedParameters.of(scene)
    scene.visibility()  # for trust in states; of the whole scene, if training did not store it
    instruments = InstrumentRenderer(scene)
    return Fitter(instruments, parameters, TissueRenderer(scene, instruments))
