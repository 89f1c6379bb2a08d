"""Articulation of an instrument: a straight shaft in the tracked frame, and links beyond it that readings move."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from neeco.raster.articulated import ArticulatedBody, link_weights
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import JointMotion, Skeleton

LINK_LOGITS = "part_logits"  # the per-Gaussian extra [N, logit_count] that link weights are the softmax of
MODULES = "hinges"  # the articulations' name in files of scenes, since version 0.1


@dataclass(frozen=True, kw_only=True)
class GateSettings:
    """Settings of the gate behind which nothing moves."""

    gate_radii: float = 1.0  # shaft radii behind the first joint up to which a link that it moves may reach
    gate_width_radii: float = 0.25  # width of that limit
    max_scale_radii: float = 0.6  # standard deviation of what turns, or its far end would swing out behind the joint
    max_gate_mm: float = 1e9  # where the radius is not known: everything is beyond the gate
    max_gate_width_mm: float = 1e6  # the same, of the gate's width


GATE = GateSettings()


class Articulation(nn.Module):
    """One instrument's shaft and joints.

    The shaft is the line `shaft_origin + s * shaft_direction`, kept near a start (`base`, a buffer,
    instrument_from_shaft with z along the shaft) by two learned tilts (rad) and two shifts (mm). Links are soft: a
    Gaussian moves by its link weights times the links' joint values (see `ArticulatedBody`).

    Subclasses define which readings move which links, and name the parts of labels.
    """

    base: Tensor  # [4, 4] instrument_from_shaft
    wrist_start: Tensor  # mm along the shaft: where its rotational symmetry ends
    extent: Tensor  # [2] mm along the shaft, first and last solid Gaussian
    radius: Tensor  # mm, of the shaft as carved
    rates: ClassVar[Mapping[str, float]] = {"shaft_tilt": 8e-3, "shaft_shift": 8e-2}  # of parameters, at the start

    reading_names: tuple[str, ...]  # all readings that move a link
    part_names: tuple[str, ...]  # label columns, in their order
    link_count: int  # logits of a Gaussian, the shaft's first
    weighs_positions: ClassVar[bool] = False  # whether `positioned_logits` changes any
    skeleton: Skeleton

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("base", torch.eye(4))
        self.register_buffer("wrist_start", torch.tensor(-math.inf))
        self.register_buffer("extent", torch.zeros(2))
        self.register_buffer("radius", torch.tensor(math.inf))
        self.shaft_tilt = nn.Parameter(torch.zeros(2))
        self.shaft_shift = nn.Parameter(torch.zeros(2))

    @property
    def jointed(self) -> bool:
        """Whether any reading moves a link."""
        return bool(self.reading_names)

    def shaft(self) -> tuple[Tensor, Tensor]:
        """Return (origin [3] mm, unit direction [3] towards the jaws), instrument frame."""
        one, zero = self.shaft_tilt.new_ones(1), self.shaft_tilt.new_zeros(1)
        direction = nn.functional.normalize(self.base[:3, :3] @ torch.cat([self.shaft_tilt, one]), dim=0)
        origin = self.base[:3, :3] @ torch.cat([self.shaft_shift, zero]) + self.base[:3, 3]
        return origin, direction

    def along_shaft(self, points: Tensor) -> Tensor:
        """Return the position [M] mm of points [M, 3] along the shaft."""
        origin, direction = self.shaft()
        return (points - origin) @ direction

    def first_joint(self) -> Tensor:
        """Return the position [] mm of the rearmost joint along the shaft, without gradient; 0 without joints."""
        raise NotImplementedError

    def axes(self, shaft: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Return (points [J, 3] mm, unit directions [J, 3]) of the joints' axes at rest, outermost first."""
        raise NotImplementedError

    def values(self, readings: Mapping[str, float]) -> Tensor:
        """Return the values [J, L - 1] by which each joint moves each link but the shaft, rad or mm."""
        raise NotImplementedError

    @property
    def slides(self) -> tuple[bool, ...]:
        """Whether each joint is prismatic; those beyond the tuple's end are revolute."""
        return ()

    def round_until(self) -> Tensor:
        """Return the position [] mm along the shaft up to which everything is spun with it."""
        return self.wrist_start

    def resting_body(self, roll: float = 0.0) -> Callable[..., ArticulatedBody]:
        """Return the instrument's body, the round part of its shaft spun by `roll` rad, as a function of what the state
        determines: `world_from_body` and `values`."""
        shaft, gate = self.shaft(), self._gate()
        origins, axes = self.axes(shaft)
        return partial(
            ArticulatedBody,
            origins=origins,
            axes=axes,
            shaft_origin=shaft[0],
            shaft_direction=shaft[1],
            spin_end=self.round_until(),
            gate_start=gate[0],
            gate_width=gate[1],
            longest=GATE.max_scale_radii * self.radius,
            roll=roll,
            slides=self.slides,
        )

    @torch.no_grad()
    def _gate(self) -> tuple[Tensor, Tensor]:
        """Return (start [], width []) mm along the shaft of the gate behind which nothing moves with the joints."""
        start = self.first_joint() - (GATE.gate_radii * self.radius).clamp_max(GATE.max_gate_mm)
        return start, GATE.gate_width_radii * self.radius.clamp_max(GATE.max_gate_width_mm)

    def link_weights(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return link weights [M, link_count] of Gaussians at points [M, 3] mm with logits [M, link_count or more]."""
        known = self.positioned_logits(points, logits)[:, : self.link_count]
        return link_weights(points, known, self.shaft(), *self._gate())

    def positioned_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return logits [M, link_count or more] with the prior of the Gaussians' positions [M, 3] mm added."""
        return logits

    def settled(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return the final logits [M, link_count or more] of Gaussians at points [M, 3] mm, without links that their
        positions rule out."""
        return logits

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return ([M] shares of Gaussians that look like the shaft's surface, by their link weights; [] mm along the
        shaft up to which they do)."""
        return weights[:, 0], self.first_joint()

    def longest(self, weights: Tensor) -> Tensor:
        """Return the largest standard deviation [M, 1] mm of Gaussians with link weights [M, link_count]; those that do
        not move are not limited."""
        moving = 1 - weights[:, :1]
        return GATE.max_scale_radii * self.radius / moving.clamp_min(1e-6)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return the shares [M, len(part_names)] of each part in Gaussians at points [M, 3] mm with link weights
        [M, link_count]."""
        raise NotImplementedError

    def moved_by(self, reading: str, weights: Tensor) -> Tensor:
        """Return the share [M] of each Gaussian with link weights [M, link_count] that a reading moves."""
        raise NotImplementedError

    def motion(self, weights: Tensor) -> tuple[list[JointMotion], Tensor]:
        """Return (axes in the order in which they move, values [M, axes, 2] rad or mm by which each moves each Gaussian
        of these link weights: at a reading of 0, and per unit of it)."""
        raise NotImplementedError

    def joint_points(self, readings: Mapping[str, float], shaft: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return named pivots and tips [3] mm, instrument frame; `shaft`: that of `shaft()`."""
        raise NotImplementedError

    def keypoints(self, readings: Mapping[str, float]) -> dict[str, Tensor]:
        """Return named points [3] mm, instrument frame: both ends of the shaft, pivots and tips."""
        origin, direction = self.shaft()
        rear, front = self.extent
        near = torch.maximum(self.wrist_start, rear) if self.jointed else front
        ends = {"shaft_far": origin + rear * direction, "shaft_near": origin + near * direction}
        return ends | self.joint_points(readings, (origin, direction))

    def measure_tips(self, points: Tensor, weights: Tensor) -> None:
        """Estimate the tips of moving links from solid Gaussians at points [M, 3] mm with link weights [M, link_count];
        a tip with too few stays unknown."""
        raise NotImplementedError

    def describe(self, reading: str) -> dict[str, Any]:
        """Return the learned parameters of the joint that a reading drives, for reports."""
        raise NotImplementedError

    def prior(self) -> Tensor | None:
        """Return the squared deviation of the learned from the stated kinematics, a scalar in standard deviations; None
        where nothing was stated."""
        return None


class ArticulatedInstruments(nn.Module):
    """Instruments with an articulation each. Bodies of the canonical Gaussians: 0 tissue, then one per instrument in
    its own frame."""

    def articulate(self, articulations: Sequence[Articulation]) -> None:
        """Set the articulations, one per instrument."""
        self.add_module(MODULES, nn.ModuleList(articulations))

    @property
    def articulations(self) -> tuple[Articulation, ...]:
        """The articulation of each instrument."""
        return tuple(self.get_submodule(MODULES).children())  # type: ignore[arg-type]

    @property
    def logit_count(self) -> int:
        """Columns of LINK_LOGITS: the largest link count of any instrument."""
        return max((articulation.link_count for articulation in self.articulations), default=1)

    def positioned_logits(self, canonical: CanonicalGaussians) -> Tensor | None:
        """Return the logits [N, logit_count] by which Gaussians are posed; None without."""
        logits = canonical.extras.get(LINK_LOGITS)
        if logits is None or not any(articulation.weighs_positions for articulation in self.articulations):
            return logits
        rows = [logits[canonical.body(0)]]
        for index, articulation in enumerate(self.articulations):
            own = canonical.body(index + 1)
            rows.append(articulation.positioned_logits(canonical.means[own], logits[own]))
        return torch.cat(rows)

    def link_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Return link weights [M, link_count] of one instrument's Gaussians."""
        rows = canonical.body(index + 1)
        return self.articulations[index].link_weights(canonical.means[rows], canonical.extras[LINK_LOGITS][rows])

    def spin_perturbation(self, roll: float) -> Any:
        """Return the perturbation that spins everything behind the wrists by `roll` rad about the shafts."""
        raise NotImplementedError
