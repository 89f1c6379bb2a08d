"""Corrections of the recorded geometry that training learns: poses and joints per frame, one latency, cameras.

The constant tracker-to-world correction is the scene's own (`GaussianScene.registration`): new states need it too.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import torch
from torch import Tensor

from neeco.capture.model import Camera, Frame, Instrument, State
from neeco.fitting.parameters import InstrumentParameters, StateParameters, moved_camera
from neeco.geometry.rotations import vector_from_rotation
from neeco.raster.optimizer import adam_update
from neeco.scene.deformation import log_linear
from neeco.scene.drawable import Recorded

LEARNED = ("poses", "joints", "cameras", "latency")
STATE = (*LEARNED, "frame_steps")  # tensors of a checkpoint, without the moments
MM_PER_RAD = 20.0  # motion of a prismatic joint that counts as much as 1 rad of a revolute one
MAX_SPEEDUP = 10.0  # of the learning rates where a pose is less certain than usual
MIN_DEVIATION = 1e-4  # rad, mm: a standard deviation of 0 would hold a pose for ever
MAX_NEIGHBOUR_S = 1.0  # s between instants whose unrecorded joints are similar
MAX_VELOCITY_S = 0.5  # s between frames that velocities are taken from


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Corrections of the recorded geometry while training; each is switched on by itself."""

    registration: bool = False  # one constant tracker-to-world correction (rigid + scale)
    latency: bool = False  # one clock offset between images and poses
    frame_poses: bool = False  # every training frame's instrument pose, smooth in time
    frame_joints: bool = False  # every training frame's readings of joints in stated kinematics
    cameras: bool = False  # every training frame's camera
    start: int = 400  # iteration
    rotation_rate: float = 6e-4  # rad, Adam's learning rate of frame_poses
    translation_rate: float = 4e-2  # mm
    camera_rate: float = 0.2  # times the rates of poses: SfM cameras are better than tracked instruments
    joint_rate: float = 2e-3  # rad; of a prismatic joint, this and its priors are arcs at 20 mm from a pivot
    unrecorded_rate: float = 2e-2  # of joints that nobody recorded
    latency_rate: float = 2e-5  # s
    prior_weight: float = 2e-5
    prior_rotation: float = 4.4e-3  # rad, standard deviation of the prior: a tracker's 0.25 deg
    prior_translation: float = 0.3  # mm
    prior_joint: float = 1.5e-2  # rad: play and noise of encoders
    prior_unrecorded: float = 0.1  # rad by which an unrecorded joint departs from its neighbours in time
    registration_rotation_rate: float = 1e-4  # rad
    registration_translation_rate: float = 1e-2  # mm
    registration_scale_rate: float = 1e-4  # of the log scale


class Refinement:
    """Corrections as 6-vectors (rotation rad, translation mm, in the instrument's or camera's own frame), joints and a
    latency in s.

    Readings of joints in stated kinematics are corrected in rad or mm. Those that nobody recorded start half way
    between their limits and are smooth in time. Both are corrected once for all frames of one instant, as several
    cameras observe it. Poses are corrected once for both images of a stereo scope, P in total; where scopes stand
    apart, every image has its own, which absorbs errors of the cameras. Tensors: `poses` [P, I, 6], `joints`
    [instants, R], `cameras` [F, 6], `latency` [1].
    """

    def __init__(
        self, config: RefineConfig, frames: tuple[Frame, ...], instruments: tuple[Instrument, ...], device: torch.device
    ) -> None:
        self.config = config
        self.layout = StateParameters(tuple(map(InstrumentParameters.of, instruments)))
        items = self.layout.instruments
        names = tuple(item.name for item in items)
        self.readings = tuple((item.name, reading) for item in items for reading in item.joints)
        missing = {(item.name, reading) for item in instruments for reading in item.unrecorded}
        self.unrecorded = torch.tensor(
            [reading in missing for reading in self.readings], dtype=torch.bool, device=device
        )  # [R]
        self.instants, self.neighbours = _instants(frames, names)
        import os

        if os.environ.get("SHARE"):
            self.pose_rows = list(self.instants)
        else:
            self.pose_rows = _numbered(
                [(instant, _scope(frame)) for instant, frame in zip(self.instants, frames, strict=True)]
            )
        self.frames_of_pose = _members(self.pose_rows)
        first = tuple(frames[shown[0]] for shown in self.frames_of_pose)
        tissues = _members(_numbered([frame.state.tissue for frame in first]))
        self.pose_rows_of_tissue = [torch.tensor(rows, device=device) for rows in tissues]
        self.joints = torch.zeros(len(self.neighbours), len(self.readings), device=device)
        self.poses = torch.zeros(len(first), len(names), 6, device=device)
        self.cameras = torch.zeros(len(frames), 6, device=device)
        self.latency = torch.zeros(1, device=device)
        self.velocities = _velocities(first, names).to(device)  # [P, I, 6] per s, body frame
        self._set_priors_and_rates(frames, first, device)
        self.moments = {
            f"{order}.{name}": torch.zeros_like(getattr(self, name))
            for order in ("first", "second")
            for name in LEARNED
        }
        self.frame_steps = torch.zeros(len(frames))  # on the CPU: read in every step
        self._leaves: dict[str, Tensor] = {}

    def _set_priors_and_rates(self, frames: tuple[Frame, ...], first: tuple[Frame, ...], device: torch.device) -> None:
        """Set standard deviations and learning rates of all corrections; `first`: a frame of every pose."""
        config, items = self.config, self.layout.instruments
        usual_pose_sd = torch.tensor([config.prior_rotation] * 3 + [config.prior_translation] * 3)
        priors = _pose_priors(first, tuple(item.name for item in items), usual_pose_sd)  # [P, I, 6]
        self.camera_sigma, self.prior_sigma = usual_pose_sd.to(device), priors.to(device)
        slides = [slides for item in items for slides in item.slides]
        per_rad = torch.tensor([MM_PER_RAD if each else 1.0 for each in slides], device=device)
        usual_joint_sd = per_rad * torch.where(self.unrecorded, config.prior_unrecorded, config.prior_joint)
        self.joint_sigma = usual_joint_sd.repeat(len(self.neighbours), 1)  # [instants, R] rad or mm
        for frame, instant in zip(frames, self.instants, strict=True):
            for column, ((name, reading), slide) in enumerate(zip(self.readings, slides, strict=True)):
                stated = frame.state.instruments[name].uncertainty
                if stated is not None and reading in stated.joints_deg:
                    deviation = stated.joints_deg[reading]
                    own = deviation if slide else math.radians(deviation)
                    self.joint_sigma[instant, column] = max(own, MIN_DEVIATION)
        rates = torch.tensor([config.rotation_rate] * 3 + [config.translation_rate] * 3)
        self.rates = {
            "poses": (rates * (priors / usual_pose_sd).clamp(1, MAX_SPEEDUP)).to(device),
            "joints": per_rad * torch.where(self.unrecorded, config.unrecorded_rate, config.joint_rate),
            "cameras": (rates * config.camera_rate).to(device),
            "latency": torch.tensor(config.latency_rate, device=device),
        }

    def apply(self, index: int, state: State, camera: Camera, iteration: int) -> tuple[State, Camera, Tensor | None]:
        """Return the corrected state and camera of frame `index`, and the prior's penalty; leaves wait for `step`."""
        self._leaves = {}
        config, instruments = self.config, self.layout.instruments
        if iteration < config.start:
            return state, camera, None
        penalties, instant, row = [], self.instants[index], self.pose_rows[index]
        if instruments and (config.frame_poses or config.latency or config.frame_joints):
            offset = self.latency.new_zeros(len(instruments), 6)
            if config.frame_poses:
                leaf = self._leaf("poses", self.poses[row])
                offset = offset + leaf
                penalties.append(self._prior(leaf, self.prior_sigma[row]))
            if config.latency:
                offset = offset + self.velocities[row] * self._leaf("latency", self.latency)
            joints: Sequence[Sequence[Any]] | None = None
            if config.frame_joints and self.readings:
                leaf = self._leaf("joints", self.joints[instant])
                expected = torch.where(self.unrecorded, self.joints[self.neighbours[instant]].mean(0), 0.0)
                penalties.append(self._prior(leaf - expected, self.joint_sigma[instant]))
                joints = [tuple(changes) for changes in leaf.split([len(item.joints) for item in instruments])]
            state = self.layout.moved_by_parts(state, list(offset), joints)
        if config.cameras:
            leaf = self._leaf("cameras", self.cameras[index])
            camera = moved_camera(camera, leaf)
            penalties.append(self._prior(leaf, self.camera_sigma))
        return state, camera, reduce(add, penalties) if penalties else None

    def _leaf(self, name: str, values: Tensor) -> Tensor:
        """Return a copy of learned values that takes a gradient."""
        self._leaves[name] = values.clone().requires_grad_()
        return self._leaves[name]

    def _prior(self, correction: Tensor, sigma: Tensor) -> Tensor:
        """Return the penalty [] on a correction [..., 6] or [R] of such standard deviations."""
        return self.config.prior_weight * (correction / sigma).square().mean()

    @torch.no_grad()
    def step(self, index: int, progress: float) -> None:
        """Take a step of Adam on the corrections that `apply` used for this frame."""
        if not self._leaves:
            return
        self.frame_steps[index] += 1
        decay = log_linear(1.0, 0.1, progress)
        pose, own = self.pose_rows[index], float(self.frame_steps[index])
        rows: dict[str, tuple[Any, float]] = {
            "poses": (pose, float(self.frame_steps[self.frames_of_pose[pose]].sum())),
            "joints": (self.instants[index], own),
            "cameras": (index, own),
            "latency": (slice(None), float(self.frame_steps.sum())),  # shared by all frames
        }
        for name, leaf in self._leaves.items():
            if leaf.grad is None:
                continue
            row, steps = rows[name]
            first, second = self.moments[f"first.{name}"][row], self.moments[f"second.{name}"][row]
            update = adam_update(leaf.grad, first, second, steps, (0.9, 0.99), 1e-12)
            rate = self.rates[name][row] if name == "poses" else self.rates[name]
            getattr(self, name)[row] -= decay * rate * update
        self._leaves = {}

    @torch.no_grad()
    def center(self) -> None:
        """Subtract the mean correction, of poses per tissue: a constant one belongs to the instrument's shape (and to
        `GaussianScene.registration`)."""
        used = (self.frame_steps > 0).nonzero()[:, 0]
        if len(used):
            rows = torch.tensor(sorted({self.pose_rows[frame] for frame in used.tolist()}), device=self.poses.device)
            for rows_of_tissue in self.pose_rows_of_tissue:
                own = rows[torch.isin(rows, rows_of_tissue)]
                self.poses[own] -= self.poses[own].mean(0)
            self.joints -= torch.where(self.unrecorded, 0.0, self.joints.mean(0))
            used = used.to(self.cameras.device)
            self.cameras[used] -= self.cameras[used].mean(0)

    def pose_rows_of(self, instant: int) -> list[int]:
        """Return the rows of `poses` of an instant."""
        return sorted({row for row, other in zip(self.pose_rows, self.instants, strict=True) if other == instant})

    def found(self, recorded: Recorded, instruments: tuple[Instrument, ...]) -> Recorded:
        """Return the recording with unrecorded joints as estimated, within their limits."""
        if not bool(self.unrecorded.any()):
            return recorded
        states = list(recorded.states)
        for item in instruments:
            for reading in item.unrecorded:
                column = self.readings.index((item.name, reading))
                low, high = item.joints[reading] or (-math.inf, math.inf)
                for index, instant in enumerate(self.instants):
                    given = states[index].instruments[item.name]
                    value = min(max(item.halfway(reading) + float(self.joints[instant, column]), low), high)
                    changed = replace(given, joints={**given.joints, reading: value})
                    states[index] = replace(
                        states[index], instruments={**states[index].instruments, item.name: changed}
                    )
        return replace(recorded, states=tuple(states))

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that changes, for a checkpoint."""
        return {name: getattr(self, name) for name in STATE} | self.moments

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `tensors` returned. Raises ValueError for other shapes."""
        for name, tensor in self.tensors().items():
            if tensors[name].shape != tensor.shape:
                raise ValueError(f"{name}: {list(tensors[name].shape)}, not {list(tensor.shape)}")
        for name in STATE:
            setattr(self, name, tensors[name].cpu() if name == "frame_steps" else tensors[name])
        self.moments = {name: tensors[name] for name in self.moments}


def _instants(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> tuple[list[int], list[list[int]]]:
    """Return (instant of each frame, neighbours of each instant).

    Frames of one time and one set of poses show one instant. Its neighbours follow or precede it in the recording
    within MAX_NEIGHBOUR_S; without any it is its own.
    """
    numbers: dict[tuple[object, ...], int] = {}
    shown: list[int] = []
    times: list[float] = []
    over: list[str | None] = []
    for frame in frames:
        poses = [frame.state.instruments[name].pose.double().numpy().tobytes() for name in instruments]
        number = numbers.setdefault((frame.state.tissue, frame.state.time, *poses), len(numbers))
        over += [frame.state.tissue] if number == len(times) else []
        times += [frame.state.time] if number == len(times) else []
        shown.append(number)
    near = [[k for k in (i - 1, i + 1) if 0 <= k < len(times) and over[k] == over[i]
             and abs(times[k] - t) < MAX_NEIGHBOUR_S] or [i] for i, t in enumerate(times)]  # fmt: skip
    return shown, near


def _pose_priors(frames: Sequence[Frame], instruments: tuple[str, ...], usual_sd: Tensor) -> Tensor:
    """Return the standard deviations [F, I, 6] of corrections (rad, mm, in the instrument's own frame): the states' own
    uncertainties, else `usual_sd` [6]."""
    priors = usual_sd.repeat(len(frames), len(instruments), 1)
    for row, frame in enumerate(frames):
        for k, name in enumerate(instruments):
            state = frame.state.instruments[name]
            if (stated := state.uncertainty) is None:
                continue
            camera = frame.camera.world_from_camera.detach().cpu().double()
            turn = state.pose[:3, :3].detach().cpu().double().T @ camera[:3, :3]  # instrument_from_camera
            shifts = (turn.square() @ torch.tensor(stated.translation_mm, dtype=torch.float64).square()).sqrt()
            turns = torch.tensor(stated.rotation_deg, dtype=torch.float64).deg2rad()
            priors[row, k] = torch.cat([turns, shifts]).clamp(min=MIN_DEVIATION).float()
    return priors


def _scope(frame: Frame) -> bytes:
    """Return a key that differs between scopes: the pose of their lamps."""
    camera = frame.camera
    lamps = camera.world_from_camera if camera.world_from_lamps is None else camera.world_from_lamps
    return lamps.detach().cpu().double().numpy().tobytes()


def _numbered(keys: Sequence[Hashable]) -> list[int]:
    """Return the number of each key, equal for equal keys."""
    numbers: dict[Hashable, int] = {}
    return [numbers.setdefault(key, len(numbers)) for key in keys]


def _members(numbers: Sequence[int]) -> list[list[int]]:
    """Return the places in `numbers` of 0, of 1, and so on."""
    members: list[list[int]] = [[] for _ in range(max(numbers, default=-1) + 1)]
    for place, number in enumerate(numbers):
        members[number].append(place)
    return members


def _velocities(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> Tensor:
    """Return the velocity [F, I, 6] (rad/s, mm/s, body frame) from differences between neighbours in time, else 0."""
    count = len(frames)
    velocity = torch.zeros(count, len(instruments), 6)
    order = sorted(range(count), key=lambda i: (frames[i].state.tissue or "", frames[i].state.time))
    for place, index in enumerate(order):
        before, after = frames[order[max(place - 1, 0)]], frames[order[min(place + 1, count - 1)]]
        elapsed = after.state.time - before.state.time
        if not 0 < elapsed < MAX_VELOCITY_S or before.state.tissue != after.state.tissue:
            continue
        for k, name in enumerate(instruments):
            earlier, later = before.state.instruments[name].pose.double(), after.state.instruments[name].pose.double()
            rotation = vector_from_rotation(earlier[:3, :3].T @ later[:3, :3])
            here = frames[index].state.instruments[name].pose.double()
            translation = here[:3, :3].T @ (later[:3, 3] - earlier[:3, 3])
            velocity[index, k] = (torch.cat([rotation, translation]) / elapsed).float()
    return velocity
