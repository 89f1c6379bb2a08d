"""What every articulation is: a straight shaft in the tracked frame, and links beyond it that readings move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from neeco.raster.articulated import ArticulatedBody, link_weights
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import JointMotion, Skeleton

LABEL_SHARE = "label_share"  # the per-Gaussian extra [N] in [0, 1]: how far one of an instrument counts as instrument
LINK_LOGITS = "part_logits"  # the per-Gaussian extra [N, logit_count] that link weights are the softmax of
MODULES = "hinges"  # the articulations' name in files of scenes, since version 0.1
# in radii of the shaft
BEHIND_JOINT = 1.0  # how far behind the first joint a link that it moves may reach
BEHIND_SOFTNESS = 0.25  # width of that limit
MAX_SCALE = 0.6  # standard deviation of what turns, or its far end would swing out behind the joint
MAX_RADIUS, MAX_SOFTNESS = 1e9, 1e6  # mm: where the radius is not known, so far behind that everything is beyond it


class Articulation(nn.Module):
    """One instrument's shaft and joints.

    The shaft is the line `shaft_origin + s * shaft_direction`, kept near a start (`base`, a buffer,
    instrument_from_shaft with z along the shaft) by two learned tilts (rad) and two shifts (mm). Links are soft: a
    Gaussian moves by its link weights times what moves the links, as `ArticulatedBody` has it.

    Subclasses say which readings move which links, and name the parts of labels.
    """

    base: Tensor  # [4, 4] instrument_from_shaft
    wrist_start: Tensor  # mm along the shaft: where its rotational symmetry ends
    extent: Tensor  # [2] mm along the shaft, first and last solid Gaussian
    radius: Tensor  # mm, of the shaft as carved
    rates: ClassVar[Mapping[str, float]] = {"shaft_tilt": 8e-3, "shaft_shift": 8e-2}  # of parameters, at the start

    reading_names: tuple[str, ...]  # of all readings that move something
    part_names: tuple[str, ...]  # label columns, in their order
    link_count: int  # logits of a Gaussian, the shaft's first
    weighs_places: ClassVar[bool] = False  # does `placed_logits` change any?
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
        """Does any reading move anything?"""
        return bool(self.reading_names)

    def shaft(self) -> tuple[Tensor, Tensor]:
        """(origin [3] mm, unit direction [3] towards the jaws), instrument frame."""
        one, zero = self.shaft_tilt.new_ones(1), self.shaft_tilt.new_zeros(1)
        direction = nn.functional.normalize(self.base[:3, :3] @ torch.cat([self.shaft_tilt, one]), dim=0)
        origin = self.base[:3, :3] @ torch.cat([self.shaft_shift, zero]) + self.base[:3, 3]
        return origin, direction

    def along_shaft(self, points: Tensor) -> Tensor:
        """Position [M] mm of points [M, 3] along the shaft."""
        origin, direction = self.shaft()
        return (points - origin) @ direction

    def first_joint(self) -> Tensor:
        """[] mm along the shaft: the rearmost joint; not learned through. 0 without joints."""
        raise NotImplementedError

    def axes(self, shaft: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """(points [J, 3] mm, unit directions [J, 3]) of what joints move about or along, outermost first, at rest."""
        raise NotImplementedError

    def values(self, readings: Mapping[str, float]) -> Tensor:
        """[J, L - 1] by which each joint moves each link but the shaft, rad or mm."""
        raise NotImplementedError

    @property
    def slides(self) -> tuple[bool, ...]:
        """Of each joint, whether it slides; shorter: the others turn."""
        return ()

    def round_until(self) -> Tensor:
        """[] mm along the shaft up to where all is spun with it."""
        return self.wrist_start

    def body(self, world_from_instrument: Tensor, readings: Mapping[str, float], roll: float = 0.0) -> ArticulatedBody:
        """How the instrument's Gaussians stand at these readings, the round part of its shaft spun by `roll` rad."""
        shaft = self.shaft()
        return ArticulatedBody(
            world_from_instrument,
            *self.axes(shaft),
            self.values(readings),
            *shaft,
            self.round_until(),
            *self._gate(),
            MAX_SCALE * self.radius,
            roll,
            self.slides,
        )

    @torch.no_grad()
    def _gate(self) -> tuple[Tensor, Tensor]:
        """(start [], width []) mm along the shaft: what lies far behind the first joint never moves with it."""
        start = self.first_joint() - (BEHIND_JOINT * self.radius).clamp_max(MAX_RADIUS)
        return start, BEHIND_SOFTNESS * self.radius.clamp_max(MAX_SOFTNESS)

    def link_weights(self, points: Tensor, logits: Tensor) -> Tensor:
        """Link weights [M, link_count] of Gaussians at points [M, 3] mm with logits [M, link_count or more]."""
        known = self.placed_logits(points, logits)[:, : self.link_count]
        return link_weights(points, known, self.shaft(), *self._gate())

    def placed_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        """Logits [M, link_count or more] with what the places [M, 3] mm of Gaussians say of them."""
        return logits

    def misplaced(self, points: Tensor, weights: Tensor) -> Tensor | None:
        """[M] at least 0: how far Gaussians at points [M, 3] mm with link weights [M, link_count] belong to links that
        their places speak against; None where places say nothing."""
        return None

    def settled(self, points: Tensor, logits: Tensor) -> Tensor:
        """Logits [M, link_count or more] of Gaussians at points [M, 3] mm once all is learned, without links that their
        places rule out."""
        return logits

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """([M] shares of Gaussians that look like the shaft's surface, by their link weights; [] mm along the shaft as
        far as they do)."""
        return weights[:, 0], self.first_joint()

    def longest(self, weights: Tensor) -> Tensor:
        """[M, 1] mm: largest standard deviation of Gaussians by their link weights [M, link_count]; what does not move
        is not limited."""
        moving = 1 - weights[:, :1]
        return MAX_SCALE * self.radius / moving.clamp_min(1e-6)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """[M, len(part_names)] shares of each part in Gaussians at points [M, 3] mm of link weights [M, link_count]."""
        raise NotImplementedError

    def moved_by(self, reading: str, weights: Tensor) -> Tensor:
        """[M] share of each Gaussian, by its link weights [M, link_count], that a reading moves."""
        raise NotImplementedError

    def motion(self, weights: Tensor) -> tuple[list[JointMotion], Tensor]:
        """(axes in the order in which they move, [M, axes, 2] rad or mm by which each moves each Gaussian of these link
        weights: at a reading of 0, and per unit of it)."""
        raise NotImplementedError

    def joint_points(self, readings: Mapping[str, float]) -> dict[str, Tensor]:
        """Named pivots and tips [3] mm, instrument frame."""
        raise NotImplementedError

    def keypoints(self, readings: Mapping[str, float]) -> dict[str, Tensor]:
        """Named points [3] mm, instrument frame: both ends of the shaft, pivots and tips."""
        origin, direction = self.shaft()
        rear, front = self.extent
        near = torch.maximum(self.wrist_start, rear) if self.jointed else front
        ends = {"shaft_far": origin + rear * direction, "shaft_near": origin + near * direction}
        return ends | self.joint_points(readings)

    def measure_tips(self, points: Tensor, weights: Tensor) -> None:
        """Take the tips of what moves from solid Gaussians at points [M, 3] mm with link weights [M, link_count]; they
        stay unknown where there are too few."""
        raise NotImplementedError

    def describe(self, reading: str) -> dict[str, Any]:
        """What was learned of the joint that a reading drives, for reports."""
        raise NotImplementedError

    def prior(self) -> Tensor | None:
        """How far what is learned departs from what was stated, a scalar in squared standard deviations; None where
        nothing was stated."""
        return None


class ArticulatedInstruments(nn.Module):
    """Instruments with an articulation each. Bodies of the canonical Gaussians: 0 tissue, then one per instrument in
    its own frame."""

    def articulate(self, articulations: Sequence[Articulation]) -> None:
        """Take these, one per instrument."""
        self.add_module(MODULES, nn.ModuleList(articulations))

    @property
    def articulations(self) -> tuple[Articulation, ...]:
        """Of each instrument."""
        return tuple(self.get_submodule(MODULES).children())  # type: ignore[arg-type]

    @property
    def logit_count(self) -> int:
        """Columns of LINK_LOGITS: the largest link count of any instrument."""
        return max((articulation.link_count for articulation in self.articulations), default=1)

    def placed_logits(self, canonical: CanonicalGaussians) -> Tensor | None:
        """[N, logit_count] what posing takes; None without."""
        logits = canonical.extras.get(LINK_LOGITS)
        if logits is None or not any(articulation.weighs_places for articulation in self.articulations):
            return logits
        rows = [logits[canonical.body(0)]]
        for index, articulation in enumerate(self.articulations):
            own = canonical.body(index + 1)
            rows.append(articulation.placed_logits(canonical.means[own], logits[own]))
        return torch.cat(rows)

    def link_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Link weights [M, link_count] of one instrument's Gaussians."""
        rows = canonical.body(index + 1)
        return self.articulations[index].link_weights(canonical.means[rows], canonical.extras[LINK_LOGITS][rows])

    def spin_perturbation(self, roll: float) -> Any:
        """The perturbation of `Scene.at` that spins everything behind the wrists by `roll` rad about the shafts."""
        raise NotImplementedError
