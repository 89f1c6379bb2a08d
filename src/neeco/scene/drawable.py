"""Interface of learned scenes (Gaussians or a radiance field), and the recording that they were learned from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from torch import Tensor, nn

from neeco.capture.model import Camera, Capture, Frame, Instrument, InstrumentState, RecordedStates, State
from neeco.geometry.lens import Lens
from neeco.raster.types import Rendering

Skeleton = tuple[tuple[str, str], ...]  # pairs of keypoints' names that a line joins
LIMIT_RANGES = 2.0  # limits of a joint without stated ones: its recorded range, extended on both sides by this multiple
N_NEIGHBOURS = 4  # training frames for interpolating an unrecorded joint


@dataclass(frozen=True)
class JointMotion:
    """Axis about which a reading turns its links, or along which it slides them; instrument frame."""

    pivot: Tensor  # [3] mm
    axis: Tensor  # [3] unit
    reading: str
    slides: bool = False  # prismatic


@dataclass(frozen=True)
class Recorded:
    """Every training frame's name, split, state and camera, and the lens through which all were recorded."""

    names: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    states: tuple[State, ...] = ()
    cameras: tuple[Camera, ...] = ()
    _: KW_ONLY
    lens: Lens | None = None  # lens whose distortion was removed from the images; None: unknown
    scale: float = 1.0  # scale of the images at which the scene was learned
    still: bool = False  # whether the camera did not move
    error_scale: float = 0.0  # size of state errors in units of a robot's usual ones; 0: no larger than a tracker's

    @classmethod
    def of(
        cls,
        frames: Sequence[Frame],
        instruments: tuple[Instrument, ...],
        *,
        lens: Lens | None = None,
        scale: float = 1.0,
        still: bool = False,
    ) -> Recorded:
        """Return the recording of `instruments` in `frames`: only these, and of each only its named joints."""
        states = []
        for frame in frames:
            chosen = {}
            for instrument in instruments:
                recorded = frame.state.instruments[instrument.name]
                joints = {joint: recorded.joints[joint] for joint in instrument.joints}
                chosen[instrument.name] = InstrumentState(recorded.pose, joints)
            states.append(State(chosen, frame.state.time))
        names, splits = tuple(frame.name for frame in frames), tuple(frame.split for frame in frames)
        cameras = tuple(frame.camera for frame in frames)
        return cls(names, splits, tuple(states), cameras, lens=lens, scale=scale, still=still)

    def as_fitted(self, capture: Capture) -> Capture:
        """Return `capture`, which the scene was learned from, with training states as fitted to their images."""
        fitted = dict(zip(self.names, self.states, strict=True))
        frames = []
        for frame in capture.frames:
            state = fitted.get(frame.name) if frame.split == "train" else None
            if state is not None:
                instruments = {**frame.state.instruments, **state.instruments}
                frame = replace(frame, state=replace(frame.state, instruments=instruments))
            frames.append(frame)
        return replace(capture, frames=tuple(frames))

    def completed(self, capture: Capture, instruments: Sequence[Instrument]) -> Capture:
        """Return `capture`, of the scene's `instruments`, with joints that neither recording states interpolated from
        the nearest training frames."""
        unstated = {item.name: set(item.unrecorded) for item in capture.instruments}
        incomplete = [
            replace(item, unrecorded=tuple(joint for joint in item.unrecorded if joint in unstated[item.name]))
            for item in instruments
            if unstated.get(item.name, set()) & set(item.unrecorded)
        ]
        if not incomplete:
            return capture
        frames = [replace(frame, state=self.with_unrecorded(frame.state, incomplete)) for frame in capture.frames]
        return replace(capture, frames=tuple(frames))

    def with_unrecorded(self, state: State, instruments: Sequence[Instrument]) -> State:
        """Return `state` with the unrecorded joints of `instruments`, interpolated from the nearest training frames."""
        if not any(item.unrecorded for item in instruments) or not self.states:
            return state
        filled = dict(state.instruments)
        for item in instruments:
            if not item.unrecorded or item.name not in filled:
                continue
            far = self._poses[item.name].distances(state)
            far = far + np.abs([state.time - other.time for other in self.states])
            nearest = np.argsort(far, kind="stable")[:N_NEIGHBOURS]
            shares = 1 / (far[nearest] + 1e-6)
            interpolated = {}
            for joint in item.unrecorded:
                values = [self.states[k].instruments[item.name].joints[joint] for k in nearest]
                interpolated[joint] = float(np.average(values, weights=shares))
            filled[item.name] = replace(filled[item.name], joints={**filled[item.name].joints, **interpolated})
        return replace(state, instruments=filled)

    @cached_property
    def _poses(self) -> dict[str, RecordedStates]:
        """Return the recorded poses of every instrument."""
        return {name: RecordedStates(self.states, [name], joints=False) for name in self.states[0].instruments}

    def with_limits(self, instruments: Sequence[Instrument]) -> tuple[Instrument, ...]:
        """Return the instruments with limits for joints without stated ones: the recorded values, extended on both
        sides by LIMIT_RANGES recorded ranges."""
        limited = []
        for item in instruments:
            joints = dict(item.joints)
            for joint in (name for name, limits in joints.items() if limits is None and self.states):
                values = [float(state.instruments[item.name].joints[joint]) for state in self.states]
                margin = LIMIT_RANGES * (max(values) - min(values))
                joints[joint] = (min(values) - margin, max(values) + margin) if margin else None
            limited.append(replace(item, joints=joints))
        return tuple(limited)

    def as_learned(self, camera: Camera) -> Camera:
        """Return the camera with the nearest focal length of the training images, unless its own is in their range."""
        if camera.learned_fx is not None:
            return camera
        least, most = self._learned_focal
        nearest = min(max(camera.fx, least), most)
        return camera if camera.fx == nearest else replace(camera, learned_fx=nearest)

    @cached_property
    def _learned_focal(self) -> tuple[float, float]:
        """Return the smallest and largest focal length, px, of the training images; 0 and infinity without any."""
        focal = [self.scale * camera.fx for camera in self.cameras]
        return min(focal, default=0.0), max(focal, default=math.inf)


@dataclass(frozen=True)
class ArticulatedMotion:
    """Articulation of a scene whose Gaussians move rigidly with instruments and links, for other renderers."""

    log_scales: Tensor  # [N, 3], as rendered
    amounts: Tensor  # [N, A, 2] rad or mm by which axis a moves a Gaussian: at a reading of 0, and per unit of it
    axes: tuple[tuple[JointMotion, ...], ...]  # of every moving instrument, in the order in which they move
    links: tuple[tuple[Tensor, Tensor], ...] = ()  # of every instrument: weights [M, L], links' amounts [L, A, 2]


class DrawableScene(nn.Module):
    """A learned scene that can be rendered: a `GaussianScene` or a radiance field.

    Code that poses or labels Gaussians takes a `GaussianScene` (see `require_gaussians`). `settings` are the method's
    own."""

    has_gaussians: bool  # False: nothing to rasterise, pose or label; an image takes seconds
    settings: Any

    def __init__(self, method: str, instruments: tuple[Instrument, ...], recorded: Recorded) -> None:
        super().__init__()
        self.method = method
        self.instruments = instruments
        self.recorded = recorded
        self.diagnostics: dict[str, Any] = {}

    @property
    def casts_shadow(self) -> bool:
        """Whether the instruments' shadow is rendered explicitly, so that none is learned as a faint part of them."""
        return False

    @property
    def label_names(self) -> tuple[tuple[str, str], ...]:
        """(instrument, part) of each label column; empty where the scene learns no labels. Mask id = index + 1, 0 is
        tissue."""
        return ()

    @property
    def num_gaussians(self) -> int | None:
        """Number of Gaussians; None: a scene without Gaussians."""
        return None

    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """Render `state` from the recorded `camera`; `labels`: with label channels, if the scene has any."""
        raise NotImplementedError

    def motion(self) -> ArticulatedMotion | None:
        """Return the articulation if it determines all motion, else None."""
        return None

    def torch_threads(self) -> AbstractContextManager[None]:
        """Use the number of torch's threads that renders the scene fastest: by default all."""
        return nullcontext()

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return (tensors, JSON-able fields) to store in addition to its modules' state."""
        return {}, {}
