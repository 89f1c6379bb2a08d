"""The geometry of instruments: a shaft and hinges in the tracked frame, and the volume that instruments sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from neeco.raster.devices import CachedPredicate
from neeco.raster.posing import ArticulatedBody, link_weights
from neeco.raster.rotations import rotate_about
from neeco.scene.canonical import CanonicalGaussians

LABEL_SHARE = "label_share"  # the per-Gaussian extra [N] in [0, 1]: how far one of an instrument counts as instrument
PART_LOGITS = "part_logits"  # the per-Gaussian extra [N, logit_count] that part weights are the softmax of
# in radii of the shaft
JAW_BEHIND_HINGE = 1.0  # how far behind its hinge a jaw may reach
JAW_BEHIND_SOFTNESS = 0.25  # width of that limit
MAX_JAW_SCALE = 0.6  # standard deviation of what turns, or its far end would swing out behind the hinge
JAWS_BEYOND = 0.75  # beyond the hinge, where nothing but jaws is

FIXED_JAW_GAIN = 0.25  # rad per rad of reading: a part that turns less is a jaw that stands still
MAX_RADIUS, MAX_SOFTNESS = 1e9, 1e6  # mm: where the radius is not known, so far behind that everything is beyond it
CELLS = 64  # per side of a swept volume


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

    base: Tensor  # [4, 4] instrument_from_shaft
    wrist_start: Tensor  # mm along the shaft: where its rotational symmetry ends
    extent: Tensor  # [2] mm along the shaft, first and last solid Gaussian
    middle: Tensor  # [J] rad or mm, as the readings
    closed: Tensor  # [J] the lowest recorded reading; nan: not known
    radius: Tensor  # mm, of the shaft as carved
    tips: Tensor  # [J, 2, 3] mm, of each joint's parts as learned; nan: not measured

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        super().__init__()
        count = len(joint_names)
        self.joint_names = joint_names
        self.register_buffer("base", torch.eye(4))
        self.register_buffer("wrist_start", torch.tensor(-math.inf))
        self.register_buffer("extent", torch.zeros(2))
        self.register_buffer("middle", torch.zeros(count))
        self.register_buffer("closed", torch.full((count,), math.nan))
        self.register_buffer("radius", torch.tensor(math.inf))
        self.register_buffer("tips", torch.full((count, 2, 3), math.nan))
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

        No gradient reaches the shaft: only spinning it teaches where it lies, or the hinges would move it.
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

    def body(self, world_from_instrument: Tensor, joints: Mapping[str, float], roll: float = 0.0) -> ArticulatedBody:
        """How the instrument's Gaussians stand at these readings, all that lies behind the wrist spun by `roll` rad."""
        turned = [joints[name] - self.middle[joint] for joint, name in enumerate(self.joint_names)]
        shaft = self.shaft()
        angles = self.offsets + self.gains * torch.stack(turned)[:, None] if turned else self.offsets
        return ArticulatedBody(
            world_from_instrument,
            *self.hinges(shaft),
            torch.block_diag(*angles.split(1)) if len(turned) > 1 else angles,  # a joint moves its own two parts
            *shaft,
            self.wrist_start,
            *self._gate(),
            MAX_JAW_SCALE * self.radius,
            roll,
        )

    @torch.no_grad()
    def _gate(self) -> tuple[Tensor, Tensor]:
        """(start [], width []) mm along the shaft: what lies far behind the first hinge never turns about it."""
        first = self.hinge_depth.min() if self.joint_names else torch.zeros_like(self.radius)
        start = first - (JAW_BEHIND_HINGE * self.radius).clamp_max(MAX_RADIUS)
        return start, JAW_BEHIND_SOFTNESS * self.radius.clamp_max(MAX_SOFTNESS)

    def part_weights(self, points: Tensor, logits: Tensor) -> Tensor:
        """Part weights [M, part_count] of Gaussians at points [M, 3] mm with part logits [M, part_count or more]."""
        return link_weights(points, logits[:, : self.part_count], self.shaft(), *self._gate())

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

    def opening(self, joint: int, reading: float) -> Tensor:
        """[2] rad between a joint's two parts and the shaft, along which they lie where the joint is closed."""
        from_closed = self.gains[joint] * (reading - self.closed[joint])
        return torch.where(self.closed[joint].isnan(), self.turns(joint, reading), from_closed)

    def tips_at(self, joint: int, reading: float) -> Tensor:
        """[2, 3] mm, instrument frame: the tips of a joint's left and right part. A tip that was not measured starts at
        the shaft's end where the joint is closed."""
        pivot, axis = self.hinge(joint)
        origin, direction = self.shaft()
        known = self.tips[joint].isfinite().all(1)  # [2]
        points = torch.where(known[:, None], self.tips[joint], origin + self.extent[1] * direction)  # [2, 3]
        angles = torch.where(known, self.turns(joint, reading), self.opening(joint, reading))
        return rotate_about(points, axis, pivot, angles).index_select(0, self.left_right_order(joint))

    def longest(self, weights: Tensor) -> Tensor:
        """[M, 1] mm: largest standard deviation of Gaussians by their part weights [M, part_count]; what does not turn
        is not limited."""
        turning = 1 - weights[:, :1]
        return MAX_JAW_SCALE * self.radius / turning.clamp_min(1e-6)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """[M, 2 + 2 J] shares of shaft, wrist, and every joint's left and right part in Gaussians at points [M, 3] mm
        of part weights [M, part_count].

        A fixed jaw is learned as body, since it moves like it: beyond the hinge there are only jaws.
        """
        along, body = self.along_shaft(points), weights[:, 0]
        jaws: list[Tensor] = []
        for joint in range(len(self.joint_names)):
            gains = self.gains[joint].detach().abs()
            fixed = (gains < FIXED_JAW_GAIN) & (gains == gains.min())  # [2]
            beyond = along > self.hinge_depth[joint] + JAWS_BEYOND * self.radius  # [M]
            fixed_jaw = body[:, None] * (beyond[:, None] & fixed)
            pair = weights[:, 1 + 2 * joint : 3 + 2 * joint] + fixed_jaw
            body = body - fixed_jaw.sum(1)
            jaws += pair.index_select(1, self.left_right_order(joint)).unbind(1)
        wrist = (along >= self.wrist_start).to(weights.dtype)
        return torch.stack([body * (1 - wrist), body * wrist, *jaws], -1)

    def left_right_order(self, joint: int) -> Tensor:
        """A joint's two parts (0 and 1) as indices [2], the left one first.

        The hinge axis is given the sign that makes its largest component in the instrument frame positive; the left
        part opens towards (shaft direction x axis).
        """
        _, axis = self.hinge(joint)
        sign = torch.sign(axis.gather(0, axis.abs().argmax()[None]))
        left = (sign * self.gains[joint]).argmin()
        return torch.stack([left, 1 - left])


class HingedInstruments:
    """Instruments with a shaft and hinges each. Bodies of the canonical Gaussians: 0 tissue, then one per instrument in
    its own frame."""

    hinges: nn.ModuleList  # `Hinges` of each instrument

    def hinges_of(self, index: int) -> Hinges:
        """The shaft and hinges of instrument `index`."""
        hinges = self.hinges[index]
        assert isinstance(hinges, Hinges)
        return hinges

    @property
    def logit_count(self) -> int:
        """Columns of PART_LOGITS: the largest part count of any instrument."""
        return max((self.hinges_of(index).part_count for index in range(len(self.hinges))), default=1)

    def part_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Part weights [M, part_count] of one instrument's Gaussians."""
        rows = canonical.body(index + 1)
        return self.hinges_of(index).part_weights(canonical.means[rows], canonical.extras[PART_LOGITS][rows])

    def spin_perturbation(self, roll: float) -> Any:
        """The perturbation of `Scene.at` that spins everything behind the wrists by `roll` rad about the shafts."""
        raise NotImplementedError


class SweptVolume(nn.Module):
    """All of space until `cover` is called, then what lies within `margin_mm` of the points given to it.

    Its buffers are saved with its owner.
    """

    low: Tensor  # [3] mm, world frame: corner of the grid
    cell: Tensor  # [3] mm; 0 while nothing is covered
    occupied: Tensor  # [CELLS, CELLS, CELLS] bool

    def __init__(self, margin_mm: float) -> None:
        super().__init__()
        self.margin_mm = margin_mm
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("cell", torch.zeros(3))
        self.register_buffer("occupied", torch.zeros(CELLS, CELLS, CELLS, dtype=torch.bool))
        self._covered = CachedPredicate(lambda cell: cell.any())

    @property
    def bounded(self) -> bool:
        """Has a volume been covered?"""
        return self._covered(self.cell)

    def cover(self, points: Tensor) -> None:
        """Make it the cells whose centre lies within the margin of a cell that holds one of `points` [P, 3] mm."""
        margin = self.margin_mm
        low = points.min(0).values - margin
        size = (points.max(0).values + margin - low).clamp_min(1e-3)
        self.low.copy_(low)
        self.cell.copy_(size / CELLS)
        index = ((points - self.low) / self.cell).long().clamp(0, CELLS - 1)
        holds = np.zeros((CELLS,) * 3, bool)
        holds[tuple(index.T.cpu().numpy())] = True
        distance = distance_transform_edt(~holds, sampling=self.cell.tolist())
        self.occupied.copy_(torch.from_numpy(distance <= margin))

    def contains(self, points: Tensor) -> Tensor:
        """[N] bool for points [N, 3] mm, world frame."""
        if not self.bounded:
            return torch.ones(len(points), dtype=torch.bool, device=points.device)
        index = ((points - self.low) / self.cell).floor().long()
        inside = ((index >= 0) & (index < CELLS)).all(1)
        x, y, z = index.clamp(0, CELLS - 1).unbind(1)
        return inside & self.occupied[x, y, z]
