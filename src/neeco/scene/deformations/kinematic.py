"""Rigid parts on learned hinges, method `kinematic`.

Tissue is static. Each instrument's Gaussians live in its own tracked frame and move rigidly with its pose; joints turn
parts about hinges that are learned from the images, with soft part assignment per Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from neeco.capture.model import Instrument, State
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations._hinges import PART_LOGITS, Hinges
from neeco.scene.deformations.base import (
    PLAIN_TRAINING,
    UNPERTURBED,
    Deformation,
    Deltas,
    Perturbation,
    Posed,
    floored_decay,
    state_of,
)
from neeco.scene.rotations import matrix_to_quat, quat_multiply, rotate_about


class Kinematic(Deformation):
    """Bodies of the canonical set: 0 tissue (world frame), then one per instrument (instrument frame)."""

    method = "kinematic"
    learns_from = 600  # hinges hold still until Gaussians have taken shape around them, or unformed ones drag them off
    training_defaults: ClassVar[Mapping[str, Any]] = {
        **PLAIN_TRAINING,
        "schedule.sh_interval": 500,
        "schedule.plain_density.interval": 200,
        "schedule.plain_density.opacity_reset": 0,
        "schedule.plain_density.threshold": 2e-4,
        "refine.latency": True,
        "refine.frame_poses": True,
        "density_start": 400,
        "density_stop": 0.7,
        "opacity_penalty": 0.002,
        "label_sharpness": 0.02,
        "shaft_roll": 0.5,
    }
    extra_rates: ClassVar[Mapping[str, float]] = {PART_LOGITS: 1e-2}

    def __init__(self, instruments: tuple[Instrument, ...]) -> None:
        super().__init__()
        self.instruments = instruments
        self.hinges = nn.ModuleList(Hinges(tuple(instrument.joints)) for instrument in instruments)
        self.label_names = tuple(
            (instrument.name, part) for instrument in instruments for part in part_names(tuple(instrument.joints))
        )

    @property
    def hinged(self) -> Kinematic:
        return self

    def hinges_of(self, index: int) -> Hinges:
        """The shaft and hinges of instrument `index`."""
        hinges = self.hinges[index]
        assert isinstance(hinges, Hinges)
        return hinges

    @property
    def logit_count(self) -> int:
        """Columns of the per-Gaussian part logits: the largest part count of any instrument."""
        return max((self.hinges_of(i).part_count for i in range(len(self.instruments))), default=1)

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        tissue = canonical.body(0)
        means, quats = [canonical.means[tissue]], [canonical.quats[tissue]]
        frames = [torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(canonical.counts[0], 4)]
        for index, instrument in enumerate(self.instruments):
            moved = self._pose_instrument(canonical, index, instrument, state, perturbation)
            for collected, part in zip((means, quats, frames), moved, strict=True):
                collected.append(part)
        return Posed(torch.cat(means), torch.cat(quats), canonical.log_scales.exp(), torch.cat(frames))

    def _pose_instrument(
        self,
        canonical: CanonicalGaussians,
        index: int,
        instrument: Instrument,
        state: State,
        perturbation: Perturbation,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """World means [M, 3], quats [M, 4] and SH frames [M, 4] of one instrument's Gaussians."""
        given = state_of(instrument, state)
        hinges, rows = self.hinges_of(index), canonical.body(index + 1)
        points, quats = canonical.means[rows], nn.functional.normalize(canonical.quats[rows], dim=-1)
        turned = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(points.shape[0], 4)  # [M, 4] instrument_from_sh
        if perturbation.shaft_roll:
            points, quats = hinges.spin(points, quats, perturbation.shaft_roll)
            _, turned = hinges.spin(points.detach(), turned, perturbation.shaft_roll)
        if hinges.joint_names:
            points, turn = hinges.bend(points, self.part_weights(canonical, index), given.joints)
            assert turn is not None
            quats, turned = quat_multiply(turn, quats), quat_multiply(turn, turned)
        pose = given.pose.to(points.dtype)
        world_quat = matrix_to_quat(pose[:3, :3])
        means = points @ pose[:3, :3].T + pose[:3, 3]
        return means, quat_multiply(world_quat, quats), quat_multiply(world_quat, turned).detach()

    def part_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Part weights [M, part_count] of one instrument's Gaussians."""
        logits = canonical.extras[PART_LOGITS][canonical.body(index + 1)]
        return torch.softmax(logits[:, : self.hinges_of(index).part_count], -1)

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        labels = torch.zeros(len(canonical), len(self.label_names))
        column = 0
        for index in range(len(self.instruments)):
            hinges, rows = self.hinges_of(index), canonical.body(index + 1)
            if not hinges.joint_names:
                labels[rows, column] = 1.0
                column += 1
                continue
            weights = self.part_weights(canonical, index)
            wrist = (hinges.along_shaft(canonical.means[rows]) >= hinges.wrist_start).to(weights.dtype)
            parts = [weights[:, 0] * (1 - wrist), weights[:, 0] * wrist]
            for joint in range(len(hinges.joint_names)):
                left = hinges.left_part(joint)
                parts += [weights[:, 1 + 2 * joint + left], weights[:, 2 + 2 * joint - left]]
            labels[rows, column : column + len(parts)] = torch.stack(parts, -1)
            column += len(parts)
        return labels

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        """Change from canonical to posed; tissue does not change, so the thresholds of the paper's labels separate
        exactly."""
        deltas = super().deltas(canonical, state)
        tissue = canonical.body(0)
        for tensor in (deltas.means, deltas.quats, deltas.scales):
            tensor[tissue] = 0
        return deltas

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        found: dict[str, dict[str, Tensor]] = {}
        for index, instrument in enumerate(self.instruments):
            hinges, given = self.hinges_of(index), state_of(instrument, state)
            origin, direction = hinges.shaft()
            points = {"shaft_far": origin + hinges.extent[0] * direction}
            end = hinges.extent[1]
            if hinges.joint_names:
                points["shaft_near"] = origin + hinges.wrist_start.clamp(min=float(hinges.extent[0])) * direction
                pivot, axis = hinges.hinge(0)
                points["hinge"] = pivot
                angles = hinges.offsets[0] + hinges.gains[0] * given.joints[hinges.joint_names[0]]
                left = hinges.left_part(0)
                tip = (origin + end * direction)[None]  # [1, 3]
                for name, part in (("tip_left", left), ("tip_right", 1 - left)):
                    points[name] = rotate_about(tip, axis, pivot, angles[part][None])[0]
            else:
                points["shaft_near"] = origin + end * direction
            pose = given.pose.to(torch.float32)
            found[instrument.name] = {name: pose[:3, :3] @ point + pose[:3, 3] for name, point in points.items()}
        return found

    def learning_rates(self, progress: float) -> dict[str, float]:
        rates = {
            "shaft_tilt": 8e-3,
            "shaft_shift": 8e-2,
            "hinge_angle": 1e-2,
            "hinge_depth": 8e-2,
            "offsets": 6e-3,
            "share": 6e-3,
            "scale": 2e-4,
        }
        fall = floored_decay(progress)
        return {name: rates[name.rsplit(".", 1)[-1]] * fall for name, _ in self.named_parameters()}


def part_names(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Parts of an instrument with these joints: one `instrument` without any, else shaft, wrist and two per joint."""
    if not joints:
        return ("instrument",)
    stems = [joint.removesuffix("_angle") for joint in joints]
    return ("shaft", "wrist", *(f"{stem}_{side}" for stem in stems for side in ("left", "right")))
