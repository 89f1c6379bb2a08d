"""How well joints of a chain explain the evidence: the volume that stays on it when moved with their links."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.raster.rotations import axis_angle_quat, quat_to_matrix, rigid
from neeco.training.instruments.evidence import Evidence, score_points

SURE = 0.8  # mean evidence from which a point counts; with less, what lies beside the links does, too
MIN_SEEN = 0.1  # share of the frames that must see a point
EDGE = 0.3  # radii in which a link begins, beyond its pivot
BESIDE = 2.0  # radii about the shaft's line in which links are looked for
POINTS = 3000

Part = tuple[tuple[str, float], ...]  # readings with their gains


@dataclass(frozen=True)
class ChainJoint:
    """A joint in the shaft's coordinates (z along it), with all readings at their middles. `parts`: what moves each
    of the links that it carries; the next joint is carried by the first."""

    slides: bool
    pivot: Tensor  # [3] mm
    axis: Tensor  # [3] unit
    parts: tuple[Part, ...]

    def motion(self, values: Tensor) -> Tensor:
        """[F, 4, 4] of what it turns by `values` [F] rad, or slides by so many mm."""
        if self.slides:
            still = torch.eye(3, device=values.device).expand(len(values), 3, 3)
            return rigid(still, values[:, None] * self.axis)
        turn = quat_to_matrix(axis_angle_quat(self.axis, values))
        return rigid(turn, self.pivot - turn @ self.pivot)


Chain = tuple[ChainJoint, ...]


@dataclass(frozen=True)
class ChainEvidence:
    """Evidence of one instrument in the coordinates of its shaft, and its readings less their middles."""

    evidence: Evidence
    camera_from_shaft: Tensor  # [F, 4, 4]
    readings: Mapping[str, Tensor]  # [F] each, rad or mm
    radius: float  # mm, of the shaft
    seed: int

    @property
    def still(self) -> Tensor:
        """[F, 4, 4]: moved by nothing but the shaft."""
        return torch.eye(4, device=self.evidence.device).expand(len(self.camera_from_shaft), 4, 4)

    def value(self, part: Part, shift: int = 0) -> Tensor:
        """[F] rad or mm by which readings move a link, the last of them shifted by `shift` frames against the
        images."""
        shifts = [0] * (len(part) - 1) + [shift]
        moved = [gain * self.readings[name].roll(by) for (name, gain), by in zip(part, shifts, strict=True)]
        return torch.stack(moved).sum(0)

    def box(self, pivot: Tensor, behind: float, beyond: float, count: int = POINTS) -> Tensor:
        """[count, 3] mm evenly about the shaft's line, from `behind` radii behind a pivot to `beyond` beyond it."""
        random = torch.quasirandom.SobolEngine(3, scramble=True, seed=self.seed).draw(count)
        low, high = random.new_tensor([-BESIDE, -BESIDE, -behind]), random.new_tensor([BESIDE, BESIDE, beyond])
        return (low + random * (high - low)).to(pivot) * self.radius + pivot

    def cell(self, behind: float, beyond: float, count: int = POINTS) -> float:
        """mm^3 for which each point of such a `box` stands."""
        return (2 * BESIDE) ** 2 * (behind + beyond) * self.radius**3 / count

    def volume(self, moved: Tensor, points: Tensor) -> Tensor:
        """[N] in [0, 1]: how surely points [N, 3] stay on evidence when moved by `moved` [F, 4, 4]."""
        score, seen = score_points(self.evidence, self.camera_from_shaft @ moved, points)
        return ((score - SURE) / (1 - SURE)).clamp(0, 1) * (seen > MIN_SEEN)

    def explained(
        self, chain: Chain, points: Tensor, known: Tensor, carrier: Tensor | None = None, shift: int = 0
    ) -> Tensor:
        """[N] `known` [N], or more where points [N, 3] stay on evidence with a link of a chain. `carrier` [F, 4, 4]:
        moves the chain as a whole; `shift`: by how many frames the last reading of its last joint is shifted."""
        best, carrier = known, self.still if carrier is None else carrier
        for place, joint in enumerate(chain):
            by = shift if place == len(chain) - 1 else 0
            begun = ((points - joint.pivot)[:, 2] / (EDGE * self.radius)).clamp(0, 1)
            beyond = torch.nonzero(begun)[:, 0]
            moved = [carrier @ joint.motion(self.value(part, by)) for part in joint.parts]
            for motion in moved:
                own = self.volume(motion, points[beyond]) * begun[beyond]
                best = best.index_copy(0, beyond, torch.maximum(best[beyond], own))
            carrier = moved[0]
        return best

    def carrier(self, chain: Chain) -> Tensor:
        """[F, 4, 4] of the last link."""
        moved = self.still
        for joint in chain:
            moved = moved @ joint.motion(self.value(joint.parts[0]))
        return moved


def direction(slides: bool, angle: float, tilts: Sequence[float] = (0.0, 0.0)) -> Tensor:
    """[3] unit: of an axis across the shaft at `angle` rad about it, tilted by the first of `tilts` rad towards it; of
    one that slides along the shaft (the other way beyond a quarter of a turn), tilted by both."""
    if slides:
        sign = math.copysign(1.0, math.cos(angle))
        along = torch.tensor([math.tan(tilts[0]), math.tan(tilts[1]), 1.0]) * sign
        return torch.nn.functional.normalize(along, dim=0)
    around = math.cos(tilts[0])
    return torch.tensor([math.cos(angle) * around, math.sin(angle) * around, math.sin(tilts[0])])
