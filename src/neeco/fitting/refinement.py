"""Corrections to the recorded geometry: instrument poses and joints per frame, one latency, cameras per frame.

The constant tracker-to-world correction is the scene's own (`GaussianScene.registration`): new states need it too.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neeco.capture.model import Camera, Frame, Instrument, InstrumentState, State
from neeco.geometry.rotations import rigid_from_vector, vector_from_rotation
from neeco.raster.optimizer import adam_update
from neeco.scene.deformation import log_linear
from neeco.scene.drawable import Recorded

LEARNED = ("poses", "joints", "cameras", "latency")
MM_PER_RAD = 20.0  # what a joint that slides is taken to move as one that turns does
FASTER = 10.0  # times the usual rates, at most, where a pose is less sure than usual
SUREST = 1e-4  # rad, mm: a standard deviation of 0 would hold a pose for ever
SMOOTH_S = 1.0  # s between instants that tell something of each other
STATE = (*LEARNED, "frame_steps")  # tensors of a checkpoint beside the moments


@dataclass(frozen=True)
class RefineConfig:
    """What of the recorded geometry may be corrected while training; each part switches on its own."""

    registration: bool = False  # one constant tracker-to-world correction (rigid + scale)
    latency: bool = False  # one clock offset between images and poses
    frame_poses: bool = False  # every training frame's instrument pose, smooth in time
    frame_joints: bool = False  # every training frame's readings of joints in stated kinematics
    cameras: bool = False  # every training frame's camera
    start: int = 400  # iteration
    rotation_rate: float = 6e-4  # rad, Adam's learning rate of frame_poses
    translation_rate: float = 4e-2  # mm
    camera_rate: float = 0.2  # times the rates of poses: SfM cameras are better than tracked instruments
    joint_rate: float = 2e-3  # rad; where a joint slides, this and its priors count as so much at 20 mm from a pivot
    unrecorded_rate: float = 2e-2  # of joints that nobody recorded
    latency_rate: float = 2e-5  # s
    prior_weight: float = 2e-5
    prior_rotation: float = 4.4e-3  # rad, standard deviation of the prior: a tracker's 0.25 deg
    prior_translation: float = 0.3  # mm
    prior_joint: float = 1.5e-2  # rad: play and noise of encoders
    prior_unrecorded: float = 0.1  # rad by which a joint that nobody recorded departs from the instants beside
    registration_rotation_rate: float = 1e-4  # rad
    registration_translation_rate: float = 1e-2  # mm
    registration_scale_rate: float = 1e-4  # of the log scale


class Refinement:
    """6-vectors (rotation rad, translation mm, in the instrument's or camera's own frame) and a latency in s.

    Readings of joints in stated kinematics are corrected in rad or mm, those that nobody recorded are found from half
    way between their limits on, smooth in time, once for frames of one instant, as several cameras see it. Poses are
    corrected once for the two images of a stereo scope, P of all; where scopes stand apart, what is wrong with their
    cameras makes every image's own pose fit better. Tensors: `poses` [P, I, 6], `joints` [instants, R], `cameras`
    [F, 6], `latency` [1].
    """

    def __init__(
        self, config: RefineConfig, frames: tuple[Frame, ...], instruments: tuple[Instrument, ...], device: torch.device
    ) -> None:
        self.config = config
        self.instruments = names = tuple(instrument.name for instrument in instruments)
        trees = [(item.name, item.kinematics) for item in instruments if item.kinematics is not None]
        self.readings = tuple((name, reading) for name, tree in trees for reading in tree.readings)
        missing = {(item.name, reading) for item in instruments for reading in item.unrecorded}
        self.unrecorded = torch.tensor(
            [reading in missing for reading in self.readings], dtype=torch.bool, device=device
        )  # [R]
        sliding = {(item.name, reading) for item in instruments for reading in item.joints if item.slides(reading)}
        per_rad = torch.tensor([MM_PER_RAD if reading in sliding else 1.0 for reading in self.readings], device=device)
        self.instants, self.beside = _instants(frames, names)
        self.pose_rows = _numbered(
            [(instant, _scope(frame)) for instant, frame in zip(self.instants, frames, strict=True)]
        )
        self.posed: list[list[int]] = [[] for _ in range(max(self.pose_rows, default=-1) + 1)]  # frames of each pose
        for frame, row in enumerate(self.pose_rows):
            self.posed[row].append(frame)
        over = [frames[shown[0]].state.tissue for shown in self.posed]
        self.worlds = {  # poses of each tissue
            tissue: torch.tensor([row for row, other in enumerate(over) if other == tissue], device=device)
            for tissue in dict.fromkeys(over)
        }
        self.joints = torch.zeros(len(self.beside), len(self.readings), device=device)
        self.poses = torch.zeros(len(self.posed), len(names), 6, device=device)
        self.cameras = torch.zeros(len(frames), 6, device=device)
        self.latency = torch.zeros(1, device=device)
        first = tuple(frames[shown[0]] for shown in self.posed)
        self.velocities = _velocities(first, names).to(device)  # [P, I, 6] per s, body frame
        rates = torch.tensor([config.rotation_rate] * 3 + [config.translation_rate] * 3)
        usual = torch.tensor([config.prior_rotation] * 3 + [config.prior_translation] * 3)
        self.camera_sigma = usual.to(device)
        priors = _pose_priors(first, names, usual)  # [P, I, 6]
        self.prior_sigma = priors.to(device)
        self.rates = {
            "poses": (rates * (priors / usual).clamp(1, FASTER)).to(device),
            "joints": per_rad * torch.where(self.unrecorded, config.unrecorded_rate, config.joint_rate),
            "cameras": (rates * config.camera_rate).to(device),
            "latency": torch.tensor(config.latency_rate, device=device),
        }
        usual = per_rad * torch.where(self.unrecorded, config.prior_unrecorded, config.prior_joint)
        self.joint_sigma = self._joint_priors(frames, usual, sliding)  # [instants, R]
        self.moments = {
            f"{order}.{name}": torch.zeros_like(getattr(self, name))
            for order in ("first", "second")
            for name in LEARNED
        }
        self.frame_steps = torch.zeros(len(frames))  # on the CPU: read in every step
        self._leaves: dict[str, Tensor] = {}

    def apply(self, index: int, state: State, camera: Camera, iteration: int) -> tuple[State, Camera, Tensor | None]:
        """The corrected state and camera of frame `index`, and the prior's penalty; leaves wait for `step`."""
        self._leaves = {}
        if iteration < self.config.start:
            return state, camera, None
        penalty, instant, row = None, self.instants[index], self.pose_rows[index]
        if self.instruments and (self.config.frame_poses or self.config.latency or self.config.frame_joints):
            offset = self.latency.new_zeros(len(self.instruments), 6)
            if self.config.frame_poses:
                leaf = self._leaves["poses"] = self.poses[row].clone().requires_grad_()
                offset = offset + leaf
                penalty = self._prior(leaf, self.prior_sigma[row])
            if self.config.latency:
                leaf = self._leaves["latency"] = self.latency.clone().requires_grad_()
                offset = offset + self.velocities[row] * leaf
            moved = dict(state.instruments)
            for k, name in enumerate(self.instruments):
                given = state.instruments[name]
                moved[name] = InstrumentState(given.pose.to(offset) @ rigid_from_vector(offset[k]), given.joints)
            if self.config.frame_joints and self.readings:
                leaf = self._leaves["joints"] = self.joints[instant].clone().requires_grad_()
                expected = torch.where(self.unrecorded, self.joints[self.beside[instant]].mean(0), 0.0)
                joint_penalty = self._prior(leaf - expected, self.joint_sigma[instant])
                penalty = joint_penalty if penalty is None else penalty + joint_penalty
                for (name, reading), change in zip(self.readings, leaf, strict=True):
                    corrected_reading: Any = moved[name].joints[reading] + change
                    moved[name] = replace(moved[name], joints={**moved[name].joints, reading: corrected_reading})
            state = replace(state, instruments=moved)
        if self.config.cameras:
            leaf = self._leaves["cameras"] = self.cameras[index].clone().requires_grad_()
            corrected = camera.world_from_camera.to(leaf) @ rigid_from_vector(leaf)
            camera = replace(camera, world_from_camera=corrected)
            camera_penalty = self._prior(leaf, self.camera_sigma)
            penalty = camera_penalty if penalty is None else penalty + camera_penalty
        return state, camera, penalty

    def _joint_priors(self, frames: tuple[Frame, ...], usual: Tensor, sliding: set[tuple[str, str]]) -> Tensor:
        """[instants, R] standard deviations of readings, rad or mm: as states say, else as `usual` [R]."""
        priors = usual.repeat(len(self.beside), 1)
        for frame, instant in zip(frames, self.instants, strict=True):
            for column, (name, reading) in enumerate(self.readings):
                sure = frame.state.instruments[name].uncertainty
                if sure is not None and reading in sure.joints_deg:
                    deviation = sure.joints_deg[reading]
                    own = deviation if (name, reading) in sliding else math.radians(deviation)
                    priors[instant, column] = max(own, SUREST)
        return priors

    def _prior(self, correction: Tensor, sigma: Tensor) -> Tensor:
        """Penalty [] on a correction [..., 6] or [R] of such standard deviations."""
        return self.config.prior_weight * (correction / sigma).square().mean()

    @torch.no_grad()
    def step(self, index: int, progress: float) -> None:
        """Adam on what `apply` used for this frame."""
        if not self._leaves:
            return
        self.frame_steps[index] += 1
        decay = log_linear(1.0, 0.1, progress)
        pose, own = self.pose_rows[index], float(self.frame_steps[index])
        rows: dict[str, tuple[Any, float]] = {
            "poses": (pose, float(self.frame_steps[self.posed[pose]].sum())),
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
        """Take the mean correction out, of every tissue's poses: a constant one belongs to the instrument's shape (and
        to `GaussianScene.registration`)."""
        seen = (self.frame_steps > 0).nonzero()[:, 0]
        if len(seen):
            rows = torch.tensor(sorted({self.pose_rows[frame] for frame in seen.tolist()}), device=self.poses.device)
            for world in self.worlds.values():
                own = rows[torch.isin(rows, world)]
                self.poses[own] -= self.poses[own].mean(0)
            self.joints -= torch.where(self.unrecorded, 0.0, self.joints.mean(0))
            seen = seen.to(self.cameras.device)
            self.cameras[seen] -= self.cameras[seen].mean(0)

    def found(self, recorded: Recorded, instruments: tuple[Instrument, ...]) -> Recorded:
        """The recording with joints that nobody recorded as they were found, within their limits."""
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
        """Everything that changes, for a checkpoint."""
        return {name: getattr(self, name) for name in STATE} | self.moments

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """The inverse of `tensors`. Raises ValueError for those of other shapes."""
        for name, tensor in self.tensors().items():
            if tensors[name].shape != tensor.shape:
                raise ValueError(f"{name}: {list(tensors[name].shape)}, not {list(tensor.shape)}")
        for name in STATE:
            setattr(self, name, tensors[name].cpu() if name == "frame_steps" else tensors[name])
        self.moments = {name: tensors[name] for name in self.moments}


def _instants(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> tuple[list[int], list[list[int]]]:
    """(which instant each frame shows, the instants beside each): frames of one time and one set of poses show one
    instant; those beside follow or precede it in the recording within SMOOTH_S, itself where none does."""
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
             and abs(times[k] - t) < SMOOTH_S] or [i] for i, t in enumerate(times)]  # fmt: skip
    return shown, near


def _pose_priors(frames: Sequence[Frame], instruments: tuple[str, ...], usual: Tensor) -> Tensor:
    """[F, I, 6] standard deviations of corrections (rad, mm, in the instrument's own frame): as states say of
    themselves, else as `usual` [6]."""
    priors = usual.repeat(len(frames), len(instruments), 1)
    for row, frame in enumerate(frames):
        for k, name in enumerate(instruments):
            state = frame.state.instruments[name]
            if (sure := state.uncertainty) is None:
                continue
            camera = frame.camera.world_from_camera.detach().cpu().double()
            turn = state.pose[:3, :3].detach().cpu().double().T @ camera[:3, :3]  # instrument_from_camera
            shifts = (turn.square() @ torch.tensor(sure.translation_mm, dtype=torch.float64).square()).sqrt()
            turns = torch.tensor(sure.rotation_deg, dtype=torch.float64).deg2rad()
            priors[row, k] = torch.cat([turns, shifts]).clamp(min=SUREST).float()
    return priors


def _scope(frame: Frame) -> bytes:
    """Tells scopes apart: by the place of their lamps."""
    camera = frame.camera
    lamps = camera.world_from_camera if camera.world_from_lamps is None else camera.world_from_lamps
    return lamps.detach().cpu().double().numpy().tobytes()


def _numbered(keys: Sequence[Hashable]) -> list[int]:
    """The number of each key, counted from the first that is like it."""
    numbers: dict[Hashable, int] = {}
    return [numbers.setdefault(key, len(numbers)) for key in keys]


def _velocities(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> Tensor:
    """[F, I, 6] body-frame velocity (rad/s, mm/s) by differences between neighbours in time; 0 where time stands
    still."""
    count = len(frames)
    velocity = torch.zeros(count, len(instruments), 6)
    order = sorted(range(count), key=lambda i: (frames[i].state.tissue or "", frames[i].state.time))
    for place, index in enumerate(order):
        before, after = frames[order[max(place - 1, 0)]], frames[order[min(place + 1, count - 1)]]
        elapsed = after.state.time - before.state.time
        if not 0 < elapsed < 0.5 or before.state.tissue != after.state.tissue:
            continue
        for k, name in enumerate(instruments):
            earlier, later = before.state.instruments[name].pose.double(), after.state.instruments[name].pose.double()
            rotation = vector_from_rotation(earlier[:3, :3].T @ later[:3, :3])
            here = frames[index].state.instruments[name].pose.double()
            translation = here[:3, :3].T @ (later[:3, 3] - earlier[:3, 3])
            velocity[index, k] = (torch.cat([rotation, translation]) / elapsed).float()
    return velocity
