"""Corrections of the recorded geometry learned in training: poses and joints per frame, one latency, cameras.

The constant tracker-to-world correction belongs to the scene (`GaussianScene.registration`): new states need it too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import reduce
from operator import add
from typing import Any

import torch
from torch import Tensor

from neeco.capture.model import Camera, Frame, Instrument, State
from neeco.geometry.rotations import vector_from_rotation
from neeco.raster.optimizer import adam_update
from neeco.scene.deformation import log_linear
from neeco.scene.drawable import Recorded
from neeco.states.parameters import InstrumentParameters, StateParameters, moved_camera

LEARNED = ("poses", "joints", "cameras", "latency")
PRIORS = ("pose_mean", "joint_mean", "pose_sd", "joint_sd")
STATE = (
    *LEARNED,
    *PRIORS,
    "frame_steps",
    "fitted",
    "verdicts",
    "error_scale",
)  # tensors of a checkpoint, without the moments
ON_CPU = ("frame_steps", "fitted", "verdicts", "error_scale")  # read in every step


@dataclass(frozen=True, kw_only=True)
class RefinementLimits:
    """Limits of corrections and of the use of temporal neighbours."""

    max_speedup: float = 10.0  # maximum factor on the learning rates of poses that are less certain than usual
    min_deviation: float = 1e-4  # rad, mm: minimum standard deviation; with 0 a pose would never move
    mean_decay: float = 0.4  # mean decay of the learning rates over a run
    min_share: float = 0.05  # minimum remaining share of a prior's standard deviations
    uncorrected: float = 1.2  # ratio of the remaining error to the RMS of the learned corrections
    max_neighbour_s: float = 1.0  # maximum time between instants with similar unrecorded joints
    max_velocity_s: float = 0.5  # maximum time between frames for computing velocities
    mm_per_rad: float = 20.0  # motion of a prismatic joint equivalent to 1 rad of a revolute one


LIMITS = RefinementLimits()


class Verdict(IntEnum):
    """Verdict on the recorded state of an instant."""

    ACCEPTED = 0  # as recorded, up to learned corrections
    REFITTED = 1  # contradicts the others; fitted to its image from other initial states
    EXCLUDED = 2  # contradicts the others, and no state explains its image, which is ignored in the loss


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Corrections of the recorded geometry during training; each has its own switch."""

    registration: bool = False  # one constant tracker-to-world correction (rigid + scale)
    latency: bool = False  # one clock offset between images and poses
    frame_poses: bool = False  # every training frame's instrument pose, smooth in time
    frame_joints: bool = False  # every training frame's readings of joints in stated kinematics
    cameras: bool = False  # every training frame's camera
    start: int = 400  # iteration
    rotation_rate: float = 6e-4  # rad, Adam's learning rate of frame_poses
    translation_rate: float = 4e-2  # mm
    camera_rate: float = 0.2  # factor on the rates of poses: SfM cameras are more accurate than tracked instruments
    joint_rate: float = 2e-3  # rad; of a prismatic joint, this and its priors are arcs at 20 mm from a pivot
    unrecorded_rate: float = 2e-2  # of unrecorded joints
    latency_rate: float = 2e-5  # s
    prior_weight: float = 2e-5
    prior_rotation: float = 4.4e-3  # rad, standard deviation of the prior: a tracker's 0.25 deg
    prior_translation: float = 0.3  # mm
    prior_joint: float = 1.5e-2  # rad: backlash and encoder noise
    prior_unrecorded: float = 0.1  # rad by which an unrecorded joint differs from its temporal neighbours
    registration_rotation_rate: float = 1e-4  # rad
    registration_translation_rate: float = 1e-2  # mm
    registration_scale_rate: float = 1e-4  # of the log scale


class Refinement:
    """Corrections as 6-vectors (rotation rad, translation mm, in the instrument's or camera's own frame), joints and a
    latency in s.

    Readings of joints in stated kinematics are corrected in rad or mm. Unrecorded ones start half way between their
    limits and are smooth in time. All frames of one instant (several cameras) share a correction, as errors of single
    cameras do not vary between instants. Tensors: `poses` [P, I, 6] of P instants, `joints` [P, R], `cameras` [F, 6],
    `latency` [1]; priors of the first two: `pose_mean`, `pose_sd`, `joint_mean`, `joint_sd`; `fitted` [F] bool: frames
    whose state was set (`set_state`); `verdicts` [P] on recorded states; `error_scale` [1]: of their errors, in units
    of a robot's usual ones, if larger than a tracker's (else 0).
    """

    def __init__(
        self, config: RefineConfig, frames: tuple[Frame, ...], instruments: tuple[Instrument, ...], device: torch.device
    ) -> None:
        self.config = config
        # of every instrument the pose, and its joints in stated kinematics or all of them
        self.layout = StateParameters(tuple(InstrumentParameters.of(item, tuple(item.joints)) for item in instruments))
        items = self.layout.instruments
        names = tuple(item.name for item in items)
        self.readings = tuple((item.name, reading) for item in items for reading in item.joints)
        missing = {(item.name, reading) for item in instruments for reading in item.unrecorded}
        self.unrecorded = torch.tensor(
            [reading in missing for reading in self.readings], dtype=torch.bool, device=device
        )  # [R]
        stated = {item.name for item in instruments if item.kinematics is not None}
        # places in the readings of those whose motion is stated; others are corrected by `set_state` alone
        self.learned = torch.tensor(
            [place for place, (name, _) in enumerate(self.readings) if name in stated], dtype=torch.int64, device=device
        )
        self.instants, self.neighbours = _instants(frames, names)
        self.frames_of_instant: list[list[int]] = [[] for _ in self.neighbours]
        for index, instant in enumerate(self.instants):
            self.frames_of_instant[instant].append(index)
        first = tuple(frames[members[0]] for members in self.frames_of_instant)
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
        self.pose_mean, self.joint_mean = torch.zeros_like(self.poses), torch.zeros_like(self.joints)
        self.frame_steps, self.error_scale = torch.zeros(len(frames)), torch.zeros(1, dtype=torch.float64)
        self.verdicts = torch.full((len(first),), Verdict.ACCEPTED, dtype=torch.uint8)
        self.fitted = torch.zeros(len(frames), dtype=torch.bool)
        self._leaves: dict[str, Tensor] = {}

    def _set_priors_and_rates(self, frames: tuple[Frame, ...], first: tuple[Frame, ...], device: torch.device) -> None:
        """Set standard deviations and learning rates of all corrections; `first`: a frame of every pose."""
        config, items = self.config, self.layout.instruments
        usual_pose_sd = torch.tensor([config.prior_rotation] * 3 + [config.prior_translation] * 3)
        priors = _pose_priors(first, tuple(item.name for item in items), usual_pose_sd)  # [P, I, 6]
        self.camera_sigma, self.pose_sd = usual_pose_sd.to(device), priors.to(device)
        slides = [slides for item in items for slides in item.slides]
        per_rad = torch.tensor([LIMITS.mm_per_rad if each else 1.0 for each in slides], device=device)
        usual_joint_sd = per_rad * torch.where(self.unrecorded, config.prior_unrecorded, config.prior_joint)
        self.usual_joint_sd = usual_joint_sd  # [R]
        self.joint_sd = usual_joint_sd.repeat(len(self.neighbours), 1)  # [P, R] rad or mm
        for frame, instant in zip(frames, self.instants, strict=True):
            for column, ((name, reading), slide) in enumerate(zip(self.readings, slides, strict=True)):
                stated = frame.state.instruments[name].uncertainty
                if stated is not None and reading in stated.joints_deg:
                    deviation = stated.joints_deg[reading]
                    sd = deviation if slide else math.radians(deviation)
                    self.joint_sd[instant, column] = max(sd, LIMITS.min_deviation)
        rates = torch.tensor([config.rotation_rate] * 3 + [config.translation_rate] * 3)
        self.rates = {
            # increased where states are less certain than usual
            "poses": rates.to(device),
            "joints": per_rad * torch.where(self.unrecorded, config.unrecorded_rate, config.joint_rate),
            "cameras": (rates * config.camera_rate).to(device),
            "latency": torch.tensor(config.latency_rate, device=device),
        }

    def apply(self, index: int, state: State, camera: Camera, iteration: int) -> tuple[State, Camera, Tensor | None]:
        """Return the corrected state and camera of frame `index`, and the prior's penalty; leaves wait for `step`."""
        self._leaves = {}
        config, instruments = self.config, self.layout.instruments
        if iteration < config.start:
            return self.state(index, state) if self.fitted[index] else state, camera, None
        penalties, instant = [], self.instants[index]
        if instruments and (config.frame_poses or config.latency or config.frame_joints):
            offset = self.latency.new_zeros(len(instruments), 6)
            if config.frame_poses:
                leaf = self._leaf("poses", self.poses[instant])
                offset = offset + leaf
                penalties.append(self._prior(leaf - self.pose_mean[instant], self.pose_sd[instant]))
            if config.latency:
                offset = offset + self.velocities[instant] * self._leaf("latency", self.latency)
            joints: Sequence[Sequence[Any]] | None = None
            if config.frame_joints and len(self.learned):
                leaf = self._leaf("joints", self.joints[instant])
                free = self.unrecorded & ~self.fitted[index].to(self.unrecorded.device)
                expected = torch.where(free, self.joints[self.neighbours[instant]].mean(0), self.joint_mean[instant])
                learned = self.learned if len(self.learned) < len(self.readings) else slice(None)
                penalties.append(self._prior((leaf - expected)[learned], self.joint_sd[instant][learned]))
                joints = self._of_instruments(leaf)
            elif self.fitted[index] and self.readings:
                joints = self._of_instruments(self.joints[instant])
            state = self.layout.moved_by_parts(state, list(offset), joints)
        if config.cameras:
            leaf = self._leaf("cameras", self.cameras[index])
            camera = moved_camera(camera, leaf)
            penalties.append(self._prior(leaf, self.camera_sigma))
        return state, camera, reduce(add, penalties) if penalties else None

    @torch.no_grad()
    def state(self, index: int, recorded: State) -> State:
        """Return the recorded state `recorded` of frame `index` with its current correction, at any iteration."""
        instant = self.instants[index]
        offset = self.poses[instant] + self.velocities[instant] * self.latency
        parts = self._of_instruments(self.joints[instant]) if self.readings else None
        joints = None if parts is None else [[float(change) for change in part] for part in parts]
        moved = self.layout.moved_by_parts(recorded, list(offset), joints)
        instruments = {
            name: replace(item, pose=item.pose.to(recorded.instruments[name].pose))
            for name, item in moved.instruments.items()
        }
        return replace(moved, instruments=instruments)

    @torch.no_grad()
    def set_state(self, index: int, recorded: State, state: State, deviations: Tensor) -> None:
        """Correct the recorded state `recorded` of frame `index`, and of its whole instant, to `state`, from iteration
        0 on.

        deviations [S] of `layout` (rad, mm): standard deviations of `state`, the new centre of the prior.
        """
        instant = self.instants[index]
        pose, joints = self._parts(self.layout.increments_between(recorded, state))
        self.poses[instant] = pose - self.velocities[instant] * self.latency
        self.pose_mean[instant] = self.poses[instant]
        if self.readings:
            self.joints[instant] = self.joint_mean[instant] = joints
        self.set_deviations(index, deviations)
        for name in ("poses", "joints"):
            for order in ("first", "second"):  # Adam's moments are of the former state
                self.moments[f"{order}.{name}"][instant] = 0
        self.fitted[self.frames_of_instant[instant]] = True

    @torch.no_grad()
    def set_deviations(self, index: int, deviations: Tensor) -> None:
        """Set the standard deviations [S] of `layout` (rad, mm) of the prior on the corrections of frame `index`."""
        pose, joints = self._parts(deviations.clamp(min=LIMITS.min_deviation))
        instant = self.instants[index]
        self.pose_sd[instant] = pose
        if self.readings:
            self.joint_sd[instant] = joints

    def verdict(self, index: int) -> Verdict:
        """Return the verdict on the recorded state of frame `index`."""
        return Verdict(int(self.verdicts[self.instants[index]]))

    def judge(self, index: int, verdict: Verdict) -> None:
        """Set the verdict on the recorded state of frame `index`, and of all frames of its instant."""
        self.verdicts[self.instants[index]] = verdict

    def counts(self, index: int) -> bool:
        """Return whether frame `index` counts in the loss."""
        return self.verdict(index) is not Verdict.EXCLUDED

    @torch.no_grad()
    def prior_shares(self) -> Tensor:
        """Return the size [3] of errors of states that were not fitted, as shares of the priors' standard deviations:
        of rotations, translations and readings.

        Corrections of exact states are as large as the corrections' own errors; for inaccurate states most of the error
        is corrected. Corrections are informative only for states whose steps can reach a tracker's errors. If most
        states were fitted, the shares are 1: images of the others hardly show an instrument.
        """
        steps = torch.stack([self.frame_steps[frames].sum() for frames in self.frames_of_instant])
        fitted = torch.stack([self.fitted[frames[0]] for frames in self.frames_of_instant])
        if 2 * int(fitted.sum()) > len(fitted):
            return self.pose_sd.new_ones(3)
        config = self.config
        least = max(config.prior_rotation / config.rotation_rate, config.prior_translation / config.translation_rate)
        taken = (LIMITS.mean_decay * steps >= least) & ~fitted
        used, readings = taken.to(self.poses.device), self.learned[~self.unrecorded[self.learned]]
        poses, joints = self.poses[used] / self.pose_sd[used], self.joints[used] / self.joint_sd[used]
        parts = (poses[..., :3], poses[..., 3:], joints[:, readings])
        corrected = (self.config.frame_poses, self.config.frame_poses, self.config.frame_joints)
        shares = [
            LIMITS.uncorrected * part.square().mean().sqrt() if learned and part.numel() else part.new_ones(())
            for part, learned in zip(parts, corrected, strict=True)
        ]
        return torch.stack(shares).clamp(min=LIMITS.min_share)

    @torch.no_grad()
    def scale_deviations(self, shares: Tensor) -> None:
        """Scale the standard deviations of states that were not fitted by `prior_shares` [3], at the end of a run."""
        readings = self.learned[~self.unrecorded[self.learned]]
        for instant, frames in enumerate(self.frames_of_instant):
            if not self.fitted[frames[0]]:
                self.pose_sd[instant] *= shares.repeat_interleave(3)[:6]
                self.joint_sd[instant, readings] *= shares[2]

    def deviations(self, index: int) -> Tensor:
        """Return the standard deviations [S] float64 of `layout` of the prior on the corrections of frame `index`."""
        deviations = torch.empty(self.layout.size, dtype=torch.float64)
        instant = self.instants[index]
        joints = self.joint_sd[instant].split([len(item.joints) for item in self.layout.instruments])
        for number, (rows, joint_rows) in enumerate(self.layout.rows):
            deviations[rows] = self.pose_sd[instant, number].cpu().double()
            deviations[joint_rows] = joints[number].cpu().double()
        return deviations

    def _parts(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Return poses [I, 6] and joints [R] from a vector [S] of `layout`."""
        poses, joints = zip(*self.layout.rows, strict=True)
        both = torch.stack([vector[rows] for rows in poses]), torch.cat([vector[rows] for rows in joints])
        return both[0].to(self.poses), both[1].to(self.poses)

    def _of_instruments(self, joints: Tensor) -> list[tuple[Tensor, ...]]:
        """Return joints [R] split by instrument."""
        return [tuple(changes) for changes in joints.split([len(item.joints) for item in self.layout.instruments])]

    def _leaf(self, name: str, values: Tensor) -> Tensor:
        """Return a leaf copy of learned values for autograd."""
        self._leaves[name] = values.clone().requires_grad_()
        return self._leaves[name]

    def _prior(self, correction: Tensor, sigma: Tensor) -> Tensor:
        """Return the penalty [] on a correction [..., 6] or [R] with these standard deviations."""
        return self.config.prior_weight * (correction / sigma).square().mean()

    @torch.no_grad()
    def step(self, index: int, progress: float) -> None:
        """Take an Adam step on the corrections that `apply` used for this frame."""
        if not self._leaves:
            return
        self.frame_steps[index] += 1
        decay = log_linear(1.0, 0.1, progress)
        instant, frame_steps = self.instants[index], float(self.frame_steps[index])
        rows: dict[str, tuple[Any, float]] = {
            "poses": (instant, float(self.frame_steps[self.frames_of_instant[instant]].sum())),
            "joints": (instant, frame_steps),
            "cameras": (index, frame_steps),
            "latency": (slice(None), float(self.frame_steps.sum())),  # shared by all frames
        }
        for name, leaf in self._leaves.items():
            if leaf.grad is None:
                continue
            row, steps = rows[name]
            first, second = self.moments[f"first.{name}"][row], self.moments[f"second.{name}"][row]
            if name == "joints" and len(self.learned) < len(self.readings):
                leaf.grad[~torch.isin(torch.arange(len(leaf)).to(self.learned), self.learned)] = 0
            update = adam_update(leaf.grad, first, second, steps, (0.9, 0.99), 1e-12)
            rate = self.rates[name]
            if name == "poses":
                rate = rate * (self.pose_sd[row] / self.camera_sigma).clamp(1, LIMITS.max_speedup)
            elif name == "joints":
                rate = rate * (self.joint_sd[row] / self.usual_joint_sd).clamp(1, LIMITS.max_speedup)
            getattr(self, name)[row] -= decay * rate * update
        self._leaves = {}

    @torch.no_grad()
    def center(self) -> None:
        """Subtract the mean correction, as a constant one belongs to the instrument's shape (and to
        `GaussianScene.registration`); the median if states were fitted, since single ones were wrong."""
        used = (self.frame_steps > 0).nonzero()[:, 0]
        if len(used):
            instants = torch.tensor(sorted({self.instants[k] for k in used.tolist()}), device=self.poses.device)
            self.poses[instants] -= self._middle(self.poses[instants])
            self.joints -= torch.where(self.unrecorded, 0.0, self._middle(self.joints))
            used = used.to(self.cameras.device)
            self.cameras[used] -= self.cameras[used].mean(0)

    def _middle(self, corrections: Tensor) -> Tensor:
        """Return the constant part of corrections [n, ...]."""
        return corrections.median(0).values if bool(self.fitted.any()) else corrections.mean(0)

    def found(self, recorded: Recorded, instruments: tuple[Instrument, ...]) -> Recorded:
        """Return the recording with unrecorded joints as estimated, within their limits, with the fitted states and the
        size of all state errors."""
        recorded = replace(recorded, error_scale=float(self.error_scale))
        if not bool(self.unrecorded.any() | self.fitted.any()):
            return recorded
        states = [
            self.state(index, state) if self.fitted[index] else state for index, state in enumerate(recorded.states)
        ]
        for item in instruments:
            for reading in item.unrecorded:
                column = self.readings.index((item.name, reading))
                low, high = item.joints[reading] or (-math.inf, math.inf)
                for index, instant in enumerate(self.instants):
                    before = states[index].instruments[item.name]
                    value = min(max(item.halfway(reading) + float(self.joints[instant, column]), low), high)
                    changed = replace(before, joints={**before.joints, reading: value})
                    states[index] = replace(
                        states[index], instruments={**states[index].instruments, item.name: changed}
                    )
        return replace(recorded, states=tuple(states))

    def to_json(self, recorded: Recorded) -> dict[str, Any]:
        """Return the corrected state of every training frame, with its standard deviations as `uncertainty`, and
        whether it was fitted to the image (`fitted`; else the deviations are the prior's) or excluded (`left_out`: it
        contradicts the others, and has no deviations)."""
        entries: dict[str, Any] = {}
        for index, (name, recorded_state, camera) in enumerate(
            zip(recorded.names, recorded.states, recorded.cameras, strict=True)
        ):
            state, deviations = self.state(index, recorded_state), self.deviations(index)
            instruments: dict[str, Any] = {}
            for item, (pose, joints) in zip(self.layout.instruments, self.layout.rows, strict=True):
                item_state = state.instruments[item.name]
                turn = camera.world_from_camera[:3, :3].cpu().double().T @ item_state.pose[:3, :3].cpu().double()
                shifts = (turn.square() @ deviations[pose][3:].square()).sqrt()  # along the camera's axes
                joint_sds = zip(deviations[joints].tolist(), item.slides, strict=True)
                units = [value if slides else math.degrees(value) for value, slides in joint_sds]
                instruments[item.name] = {
                    "pose": item_state.pose.cpu().double().tolist(),
                    "joints": {joint: float(value) for joint, value in item_state.joints.items()},
                }
                if self.counts(index):
                    instruments[item.name]["uncertainty"] = {
                        "translation_mm": shifts.tolist(),
                        "rotation_deg": deviations[pose][:3].rad2deg().tolist(),
                        "joints_deg": dict(zip(item.joints, units, strict=True)),
                    }
            entries[name] = {
                "instruments": instruments,
                "fitted": bool(self.fitted[index]),
                "left_out": not self.counts(index),
            }
        return entries

    def tensors(self) -> dict[str, Tensor]:
        """Return all mutable tensors, for a checkpoint."""
        return {name: getattr(self, name) for name in STATE} | self.moments

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `tensors` returned. Raises ValueError for other shapes."""
        for name, tensor in self.tensors().items():
            if tensors[name].shape != tensor.shape:
                raise ValueError(f"{name}: {list(tensors[name].shape)}, not {list(tensor.shape)}")
        for name in STATE:
            setattr(self, name, tensors[name].cpu() if name in ON_CPU else tensors[name])
        self.moments = {name: tensors[name] for name in self.moments}


def _instants(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> tuple[list[int], list[list[int]]]:
    """Return (instant of each frame, neighbours of each instant).

    Frames with equal time and poses show one instant. Its neighbours are the adjacent instants of the recording within
    `max_neighbour_s`; without any, it is its own.
    """
    numbers: dict[tuple[object, ...], int] = {}
    instants: list[int] = []
    times: list[float] = []
    for frame in frames:
        poses = [frame.state.instruments[name].pose.double().numpy().tobytes() for name in instruments]
        number = numbers.setdefault((frame.state.time, *poses), len(numbers))
        times += [frame.state.time] if number == len(times) else []
        instants.append(number)
    pairs = [[k for k in (i - 1, i + 1) if 0 <= k < len(times)] for i in range(len(times))]
    near = [[k for k in ks if abs(times[k] - times[i]) < LIMITS.max_neighbour_s] or [i] for i, ks in enumerate(pairs)]
    return instants, near


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
            priors[row, k] = torch.cat([turns, shifts]).clamp(min=LIMITS.min_deviation).float()
    return priors


def _velocities(frames: tuple[Frame, ...], instruments: tuple[str, ...]) -> Tensor:
    """Return the velocity [F, I, 6] (rad/s, mm/s, body frame) from differences between neighbours in time, else 0."""
    count = len(frames)
    velocity = torch.zeros(count, len(instruments), 6)
    order = sorted(range(count), key=lambda i: frames[i].state.time)
    for place, index in enumerate(order):
        before, after = frames[order[max(place - 1, 0)]], frames[order[min(place + 1, count - 1)]]
        elapsed = after.state.time - before.state.time
        if not 0 < elapsed < LIMITS.max_velocity_s:
            continue
        for k, name in enumerate(instruments):
            earlier, later = before.state.instruments[name].pose.double(), after.state.instruments[name].pose.double()
            rotation = vector_from_rotation(earlier[:3, :3].T @ later[:3, :3])
            pose = frames[index].state.instruments[name].pose.double()
            translation = pose[:3, :3].T @ (later[:3, 3] - earlier[:3, 3])
            velocity[index, k] = (torch.cat([rotation, translation]) / elapsed).float()
    return velocity
