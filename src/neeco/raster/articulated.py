"""Posing of articulated bodies: Gaussians on jointed links, by the definition in torch and by kernels.

A body is a range of rows that move together and by the same joints; instruments are unknown here. A Gaussian's link
weights blend the joints' values (angles, distances), not transforms as in linear blend skinning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neeco.base.errors import NeecoError
from neeco.geometry.rotations import axis_angle_quat, matrix_to_quat, quat_multiply, rotate_about
from neeco.raster.devices import constant
from neeco.raster.native import all_run_native, native
from neeco.raster.triton.ready import runs_triton

MIN_MOVING_SHARE = 1e-6
MAX_JOINTS, MAX_LINKS = 31, 32  # limits of the kernels, per body
Rows = tuple[Tensor, Tensor, Tensor, Tensor]  # means [N, 3], quats [N, 4], scales [N, 3], sh_frames [N, 4]


@dataclass(frozen=True, kw_only=True)
class ArticulatedBody:
    """Pose and joint values of one articulated body; lengths in mm, angles in rad, all but the pose in its own frame.

    Link 0 is fixed to the body. Joint j is revolute, or prismatic where `slides[j]`: it moves a Gaussian by the sum of
    its link weights times `values[j]` of the links, which is 0 for links that the joint does not move. Joints act in
    their order, the outermost on a chain first, since all axes are those of the body at rest. A Gaussian's weight of a
    link is the softmax of its logits times the gate sigmoid((s - gate_start) / gate_width) at its position s along the
    shaft. Gradients reach the shaft by `roll` alone, and neither the gate nor `longest`.
    """

    world_from_body: Tensor  # [4, 4] rigid
    origins: Tensor  # [J, 3] points on the axes
    axes: Tensor  # [J, 3] unit
    values: Tensor  # [J, L - 1] rad, or mm of prismatic joints, of links 1 to L - 1
    shaft_origin: Tensor  # [3]
    shaft_direction: Tensor  # [3] unit
    spin_end: Tensor  # [] along the shaft: only Gaussians before it are spun about it
    gate_start: Tensor  # []
    gate_width: Tensor  # []
    longest: Tensor  # [] maximum standard deviation of a Gaussian times its moving share
    roll: float = 0.0  # about the shaft
    slides: tuple[bool, ...] = ()  # whether each joint is prismatic; those beyond the end are revolute

    @property
    def link_count(self) -> int:
        """Number of links L, with link 0."""
        return 1 + self.values.shape[1] if len(self.origins) else 1

    @property
    def slide_mask(self) -> int:
        """Bit mask: joint j is prismatic."""
        return sum(1 << joint for joint, slides in enumerate(self.slides) if slides)

    def numbers(self) -> Tensor:
        """Return all but roll and joint types as kernels read them, [22 + J (5 + L)], differentiable: the pose's upper
        rows 12, shaft 3 + 3, spin_end, gate_start, gate_width, longest, then per joint origin 3, axis 3 and values L -
        1."""
        ends = torch.stack([self.spin_end, self.gate_start, self.gate_width, self.longest])
        joints = torch.cat([self.origins, self.axes, self.values], 1)
        return torch.cat(
            [self.world_from_body[:3].flatten(), self.shaft_origin, self.shaft_direction, ends, joints.flatten()]
        )


def link_weights(
    points: Tensor, logits: Tensor, shaft: tuple[Tensor, Tensor], gate_start: Tensor, gate_width: Tensor
) -> Tensor:
    """Return the weight [M, L] of each link, summing to 1, of Gaussians at `points` [M, 3] with link logits [M, L]; the
    shaft (origin [3], unit direction [3]) and the gate are `ArticulatedBody`'s, without gradient."""
    with torch.no_grad():
        along = (points - shaft[0]) @ shaft[1]
        gate = torch.sigmoid((along - gate_start) / gate_width)
    moving = torch.softmax(logits, -1)[:, 1:] * gate[:, None]
    return torch.cat([1 - moving.sum(1, keepdim=True), moving], 1)


def pose_bodies(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor | None,
    counts: Sequence[int],
    bodies: Sequence[ArticulatedBody | None],
) -> Rows:
    """Return world means, quats, scales (standard deviations, mm) and sh_frames (world_from_sh, without gradient) of
    Gaussians given by means [N, 3] mm, quats [N, 4] of any length, log_scales [N, 3] and link logits [N, L or more].

    The first `counts[0]` rows belong to the first body, and so on; a body that is None is fixed in the world. Gradients
    reach the tensors of the Gaussians and of the bodies, see `ArticulatedBody`. float32 on the CPU takes the native
    kernel, with the same bits for any number of threads; float32 on a CUDA device takes the Triton kernel (not tested
    on a GPU); everything else takes the definition. Raises NeecoError where counts, bodies and tensors do not fit.
    """
    _check(means, quats, log_scales, logits, counts, bodies)
    kernel = _kernel([t for t in (means, quats, log_scales, logits) if t is not None])
    if kernel is None:
        return pose_bodies_reference(means, quats, log_scales, logits, counts, bodies)
    numbers = [None if body is None else body.numbers().to(means) for body in bodies]
    body_arguments = [(0, 0, 0.0) if body is None else (body.link_count, body.slide_mask, body.roll) for body in bodies]
    return _Pose.apply(kernel, means, quats, log_scales, logits, tuple(counts), body_arguments, *numbers)


def pose_bodies_reference(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor | None,
    counts: Sequence[int],
    bodies: Sequence[ArticulatedBody | None],
) -> Rows:
    """`pose_bodies` in plain torch, any float type and device."""
    posed: list[Rows] = []
    start = 0
    for count, body in zip(counts, bodies, strict=True):
        rows = slice(start, start + count)
        still = constant((1.0, 0.0, 0.0, 0.0), means.device).to(means.dtype).expand(count, 4)
        at_rest = means[rows], quats[rows], log_scales[rows].exp(), still
        posed.append(at_rest if body is None else _pose_body(at_rest, None if logits is None else logits[rows], body))
        start += count
    moved, turned, scales, frames = (torch.cat(column) for column in zip(*posed, strict=True))
    return moved, turned, scales, frames.detach()


def _pose_body(at_rest: Rows, logits: Tensor | None, body: ArticulatedBody) -> Rows:
    points, quats, scales, frames = at_rest
    quats = torch.nn.functional.normalize(quats, dim=-1)

    def turn(axis: Tensor, origin: Tensor, angle: Tensor) -> Rows:
        quat = axis_angle_quat(axis, angle)
        turned = quat_multiply(quat, quats), scales, quat_multiply(quat, frames)
        return rotate_about(points, axis, origin, angle), *turned

    resting = points.detach()
    if body.roll:
        along = (resting - body.shaft_origin) @ body.shaft_direction
        angle = (along < body.spin_end).to(points.dtype) * body.roll
        points, quats, scales, frames = turn(body.shaft_direction, body.shaft_origin, angle)
    if len(body.origins):
        assert logits is not None
        shaft = body.shaft_origin, body.shaft_direction
        weights = link_weights(resting, logits[:, : body.link_count], shaft, body.gate_start, body.gate_width)
        moving = 1 - weights[:, :1].detach()
        scales = torch.minimum(scales, body.longest / moving.clamp_min(MIN_MOVING_SHARE))
        for joint in range(len(body.origins)):
            amount = weights[:, 1:] @ body.values[joint]
            if body.slide_mask >> joint & 1:
                points = points + amount[:, None] * body.axes[joint]
            else:
                points, quats, scales, frames = turn(body.axes[joint], body.origins[joint], amount)
    rotation, translation = body.world_from_body[:3, :3], body.world_from_body[:3, 3]
    quat = matrix_to_quat(rotation)
    return points @ rotation.T + translation, quat_multiply(quat, quats), scales, quat_multiply(quat, frames)


def _kernel(tensors: Sequence[Tensor]) -> Any:
    """Return the kernel class for these tensors; None: the definition."""
    if all_run_native(*tensors):
        return native().Posing
    if all(runs_triton(t) for t in tensors):
        from neeco.raster.triton.articulated import Posing

        return Posing
    return None


class _Pose(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        kernel: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor | None,
        counts: tuple[int, ...],
        how: list[tuple[int, int, float]],
        *numbers: Tensor | None,
    ) -> Any:
        inputs = [means, quats, log_scales, logits, *numbers]
        plain = [None if t is None else t.detach().contiguous() for t in inputs]
        posing = kernel(*plain[:4], counts, plain[4:], how)
        posed = [means.new_empty(len(means), columns) for columns in (3, 4, 3, 4)]
        posing.forward(*posed)
        ctx.mark_non_differentiable(posed[3])
        # saved so that autograd detects a modified input before the backward pass
        ctx.save_for_backward(*inputs)
        ctx.posing = posing
        return tuple(posed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        means, quats, log_scales, logits, *numbers = ctx.saved_tensors
        to = [t.new_empty(t.shape) for t in (means, quats, log_scales)]
        to_logits = None if logits is None else logits.new_zeros(logits.shape)
        to_numbers = [None if t is None else t.new_zeros(t.shape) for t in numbers]
        ctx.posing.backward(*(g.contiguous() for g in gradients[:3]), *to, to_logits, to_numbers)
        return None, *to, to_logits, None, None, *to_numbers


def _check(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor | None,
    counts: Sequence[int],
    bodies: Sequence[ArticulatedBody | None],
) -> None:
    n = means.shape[0]
    if (means.shape, quats.shape, log_scales.shape) != ((n, 3), (n, 4), (n, 3)):
        shapes = ", ".join(str(tuple(t.shape)) for t in (means, quats, log_scales))
        raise NeecoError(f"pose_bodies: shapes {shapes}; expected [N, 3], [N, 4] and [N, 3]")
    if len(counts) != len(bodies) or sum(counts) != n or min(counts, default=0) < 0:
        raise NeecoError(f"pose_bodies: counts: {tuple(counts)} of {len(bodies)} bodies must sum to {n} Gaussians")
    for body in bodies:
        if body is not None and (len(body.origins) > MAX_JOINTS or body.link_count > MAX_LINKS):
            size = f"{len(body.origins)} joints and {body.link_count} links"
            raise NeecoError(f"pose_bodies: a body of {size}; at most {MAX_JOINTS} and {MAX_LINKS} can be posed")
    columns = max((body.link_count for body in bodies if body is not None and len(body.origins)), default=0)
    has = 0 if logits is None else logits.shape[1] if logits.dim() == 2 and logits.shape[0] == n else -1
    if has < columns:
        shape = None if logits is None else tuple(logits.shape)
        raise NeecoError(f"pose_bodies: logits: {shape}; expected [{n}, {columns} or more]")
