"""One instrument's shaft and hinges, in its own tracked frame: what `kinematic` learns about how it moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from neeco.raster.posing import HingedBody, part_weights
from neeco.raster.rotations import rotate_about
from neeco.scene.canonical import CanonicalGaussians

BEHIND_HINGE = 1.0  # radii of the shaft: how far behind its hinge a jaw may reach
LONGEST = 0.6  # radii: standard deviation of what turns, or its far end would swing out behind the hinge
BEHIND_SOFT = 0.25  # radii
FARTHEST, WIDEST = 1e9, 1e6  # mm: where the radius is not known, a gate so far behind that everything is beyond it
STILL = 0.25  # rad per rad of reading: a part that turns less is a jaw that stands still
STILL_BEYOND = 0.75  # radii of the shaft beyond the hinge, where nothing but jaws is
PART_LOGITS = "part_logits"  # the per-Gaussian extra [N, logit_count] that part weights are the softmax of


class Hinges(nn.Module):
    """A straight shaft and joints whose hinge axes cross it at right angles.

    The shaft is the line `shaft_origin + s * shaft_direction`, kept near a start (`base`, a buffer,
    instrument_from_shaft with z along the shaft) by two learned tilts (rad) and two shifts (mm). Joint j turns two
    parts about the axis at `hinge_angle[j]` (rad, around the shaft) and `hinge_depth[j]` (mm, along it); part k turns
    by `offsets[j, k] + gains[j, k] * (reading - middle[j])`, `middle` being the mean of the recorded readings, or a
    change of the gains would turn everything. The reading is the angle between the two parts, so the gains are
    `scale * (share, share - 1)`: `share` is learned freely, `scale` stays near 1.
    Parts are soft: a Gaussian turns by its part weights times the parts' angles.
    """

    base: Tensor
    wrist_start: Tensor
    extent: Tensor
    middle: Tensor
    closed: Tensor
    radius: Tensor
    tips: Tensor

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        super().__init__()
        count = len(joint_names)
        self.joint_names = joint_names
        self.register_buffer("base", torch.eye(4))
        self.register_buffer(
            "wrist_start", torch.tensor(-math.inf)
        )  # mm along the shaft; rotational symmetry ends here
        self.register_buffer("extent", torch.zeros(2))  # mm along the shaft, first and last solid Gaussian
        self.register_buffer("middle", torch.zeros(count))  # rad or mm, as the readings
        self.register_buffer("closed", torch.full((count,), math.nan))  # the lowest recorded reading; nan: not known
        self.register_buffer("radius", torch.tensor(math.inf))  # mm, of the shaft as carved
        self.register_buffer("tips", torch.full((count, 2, 3), math.nan))  # mm, of each joint's parts as learned
        self.shaft_tilt = nn.Parameter(torch.zeros(2))
        self.shaft_shift = nn.Parameter(torch.zeros(2))
        self.hinge_angle = nn.Parameter(torch.zeros(count))
        self.hinge_depth = nn.Parameter(torch.zeros(count))
        self.offsets = nn.Parameter(torch.zeros(count, 2))
        self.share = nn.Parameter(torch.full((count,), 0.5))
        self.scale = nn.Parameter(torch.ones(count))

    @property
    def gains(self) -> Tensor:
        """[J, 2] rad of each part per rad of reading."""
        return self.scale[:, None] * torch.stack([self.share, self.share - 1], -1)

    @property
    def part_count(self) -> int:
        """Body plus two parts per joint."""
        return 1 + 2 * len(self.joint_names)

    def shaft(self) -> tuple[Tensor, Tensor]:
        """(origin [3] mm, unit direction [3] towards the jaws), instrument frame."""
        one, zero = self.shaft_tilt.new_ones(1), self.shaft_tilt.new_zeros(1)
        direction = nn.functional.normalize(self.base[:3, :3] @ torch.cat([self.shaft_tilt, one]), dim=0)
        origin = self.base[:3, :3] @ torch.cat([self.shaft_shift, zero]) + self.base[:3, 3]
        return origin, direction

    def hinges(self, shaft: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """(pivots [J, 3] mm, unit axes [J, 3]) of all joints, instrument frame; `shaft`, where it is there already.

        The shaft is taken as it is: only spinning it teaches where it lies, or the hinges would drag it along.
        """
        origin, direction = (part.detach() for part in shaft or self.shaft())
        angle = self.hinge_angle
        around = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1) @ self.base[:3, :3].T
        axes = nn.functional.normalize(around - (around @ direction)[:, None] * direction, dim=1)
        return origin + self.hinge_depth[:, None] * direction, axes

    def hinge(self, joint: int) -> tuple[Tensor, Tensor]:
        """(pivot [3] mm, unit axis [3]) of one joint, instrument frame."""
        pivots, axes = self.hinges()
        return pivots[joint], axes[joint]

    def along_shaft(self, points: Tensor) -> Tensor:
        """Position [M] mm of points [M, 3] along the shaft."""
        origin, direction = self.shaft()
        return (points - origin) @ direction

    def body(self, world_from_instrument: Tensor, joints: Mapping[str, float], roll: float = 0.0) -> HingedBody:
        """How the instrument's Gaussians stand at these readings, all that lies behind the wrist spun by `roll` rad."""
        turned = [joints[name] - self.middle[joint] for joint, name in enumerate(self.joint_names)]
        shaft = self.shaft()
        return HingedBody(
            world_from_instrument,
            *self.hinges(shaft),
            self.offsets + self.gains * torch.stack(turned)[:, None] if turned else self.offsets,
            *shaft,
            self.wrist_start,
            *self._gate(),
            LONGEST * self.radius,
            roll,
        )

    @torch.no_grad()
    def _gate(self) -> tuple[Tensor, Tensor]:
        """(start [], width []) mm along the shaft: what lies far behind the first hinge never turns about it."""
        first = self.hinge_depth.min() if self.joint_names else torch.zeros_like(self.radius)
        start = first - (BEHIND_HINGE * self.radius).clamp_max(FARTHEST)
        return start, BEHIND_SOFT * self.radius.clamp_max(WIDEST)

    def part_weights(self, points: Tensor, logits: Tensor) -> Tensor:
        """Part weights [M, part_count] of Gaussians at points [M, 3] mm with part logits [M, part_count or more]."""
        return part_weights(points, logits[:, : self.part_count], self.shaft(), *self._gate())

    def bend(self, points: Tensor, weights: Tensor, joints: Mapping[str, float]) -> Tensor:
        """Move points [M, 3] by the joints; weights [M, part_count] sum to 1 over parts: body, then two per joint."""
        pivots, axes = self.hinges()
        for index, name in enumerate(self.joint_names):
            angle = weights[:, 1 + 2 * index : 3 + 2 * index] @ self.turns(index, joints[name])
            points = rotate_about(points, axes[index], pivots[index], angle)
        return points

    def turns(self, joint: int, reading: float) -> Tensor:
        """[2] rad by which a joint's two parts are turned."""
        return self.offsets[joint] + self.gains[joint] * (reading - self.middle[joint])

    def opened(self, joint: int, reading: float) -> Tensor:
        """[2] rad by which a joint's two parts stand off the shaft, which they lie along where it is closed."""
        opened = self.gains[joint] * (reading - self.closed[joint])
        return torch.where(self.closed[joint].isnan(), self.turns(joint, reading), opened)

    def tips_at(self, joint: int, reading: float) -> Tensor:
        """[2, 3] mm, instrument frame: the tips of a joint's left and right part. For one that was not measured the
        shaft's end is taken, from where the joint lies closed."""
        pivot, axis = self.hinge(joint)
        origin, direction = self.shaft()
        known = self.tips[joint].isfinite().all(1)  # [2]
        points = torch.where(known[:, None], self.tips[joint], origin + self.extent[1] * direction)  # [2, 3]
        angles = torch.where(known, self.turns(joint, reading), self.opened(joint, reading))
        return rotate_about(points, axis, pivot, angles).index_select(0, self.left_first(joint))

    def longest(self, weights: Tensor) -> Tensor:
        """[M, 1] mm: how long the Gaussians may be (standard deviation), by their part weights [M, part_count]: what
        does not turn as long as it likes."""
        turning = 1 - weights[:, :1]
        return LONGEST * self.radius / turning.clamp_min(1e-6)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """[M, 2 + 2 J] shares of shaft, wrist, and every joint's left and right part in Gaussians at points [M, 3] mm
        of part weights [M, part_count].

        A jaw that stands still is learned as body, since it moves like it: beyond the hinge nothing but jaws is.
        """
        along, body = self.along_shaft(points), weights[:, 0]
        jaws: list[Tensor] = []
        for joint in range(len(self.joint_names)):
            gains = self.gains[joint].detach().abs()
            still = (gains < STILL) & (gains == gains.min())  # [2]
            beyond = along > self.hinge_depth[joint] + STILL_BEYOND * self.radius  # [M]
            kept = body[:, None] * (beyond[:, None] & still)
            pair = weights[:, 1 + 2 * joint : 3 + 2 * joint] + kept
            body = body - kept.sum(1)
            jaws += pair.index_select(1, self.left_first(joint)).unbind(1)
        wrist = (along >= self.wrist_start).to(weights.dtype)
        return torch.stack([body * (1 - wrist), body * wrist, *jaws], -1)

    def left_first(self, joint: int) -> Tensor:
        """A joint's two parts (0 and 1) as indices [2], the left one first.

        The hinge axis is given the sign that makes its largest component in the instrument frame positive; the left
        part opens towards (shaft direction x axis).
        """
        _, axis = self.hinge(joint)
        sign = torch.sign(axis.gather(0, axis.abs().argmax()[None]))
        left = (sign * self.gains[joint]).argmin()
        return torch.stack([left, 1 - left])


class Hinged(Protocol):
    """What the search for instruments asks of a deformation with hinges. Bodies: 0 tissue, then one per instrument in
    its own frame."""

    @property
    def logit_count(self) -> int:
        """Columns of PART_LOGITS: the largest part count of any instrument."""
        ...

    def hinges_of(self, index: int) -> Hinges:
        """The shaft and hinges of instrument `index`."""
        ...

    def part_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Part weights [M, part_count] of one instrument's Gaussians."""
        ...

    def spun(self, roll: float) -> Any:
        """The perturbation of `Scene.at` that spins everything behind the wrists by `roll` rad about the shafts."""
        ...
