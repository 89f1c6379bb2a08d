"""Articulation of an instrument: a straight shaft in the tracked frame, and distal links that joint readings move.

The links are those of a kinematic tree that the capture states or that was estimated from the images; corrections of
axes, pivots and readings are learned. Unstated hinges across the shaft have parameters of their own (`hinges.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.kinematics import PRISMATIC, KinematicTree, Link
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.tree_links import common_name, joints_by_axis, links_apart, signature
from neeco.raster.articulated import ArticulatedBody, link_weights
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import JointMotion, Skeleton

LINK_LOGITS = "part_logits"  # per-Gaussian extra [N, logit_count]; link weights are its softmax
MODULES = "hinges"  # key of the articulations in scene files, since version 0.1


@dataclass(frozen=True, kw_only=True)
class ArticulationSettings:
    """Priors on stated kinematics, the proximal limit of moving links, link assignment about joints, and tips."""

    # standard deviations of the stated kinematics
    axis_sd: float = 0.09  # rad
    pivot_sd: float = 2.0  # mm
    gain_sd: float = 0.03  # relative error of a reading's gain
    gate_radii: float = 1.0  # shaft radii behind the first joint that its link may extend to
    gate_width_radii: float = 0.25  # width of that limit's transition
    max_scale_radii: float = 0.6  # maximum size on moving links, lest the far end swings out behind the joint
    max_gate_mm: float = 1e9  # where the radius is unknown: no limit
    max_gate_width_mm: float = 1e6  # the same for the transition's width
    side_logits: float = 2.0  # logits per shaft radius on the wrong side of a joint
    side_start: float = 0.4  # shaft radii from the pivot to the plane that separates two links
    prongs: float = 0.7  # shaft radii by which that plane is farther out at the prongs of the clevis
    prongs_from: float = 0.3  # shaft radii along the axis where this offset starts
    prongs_to: float = 0.7  # shaft radii along the axis where it is complete
    min_step_mm: float = 1.0  # minimum distance of two pivots that define a direction
    shaft_reach: float = 3.0  # maximum distance from the axis, shaft radii, proximal to the first pivot
    end_reach: float = 8.0  # maximum distance from any pivot, shaft radii, distal to the first pivot
    max_wrist_radii: float = 1.5  # shaft radii behind the first joint within which an estimated shaft end is accepted
    min_part_share: float = 0.5  # minimum weight of a link for a Gaussian to belong to it
    min_tip_gaussians: int = 10  # minimum number of Gaussians for measuring a link's tip
    tip_quantile: float = 0.97  # quantile of distances from the pivot beyond which Gaussians form the tip


SETTINGS = ArticulationSettings()

# wide: an offset is only observable through the axes it moves, whose stated positions are no more accurate
OFFSET_SD = {False: 0.1, True: 2.0}  # rad (revolute), mm (prismatic)


class Articulation(nn.Module):
    """One instrument's shaft, and the links of its kinematic tree with learned corrections.

    The shaft is the line `shaft_origin + s * shaft_direction`, kept near a start (`base`, a buffer,
    instrument_from_shaft with z along the shaft) by two learned tilts (rad) and two shifts (mm). Links are soft: a
    Gaussian moves by its link weights times the links' joint values (see `ArticulatedBody`).

    Joint j, of those of the tree that share an axis, turns about that axis (or slides along it): `axis_turns[j]` (rad)
    turns the stated axis and `axis_shifts[j]` (mm) shifts its pivot, in the root's frame at rest. A reading r counts as
    `(1 + reading_gains[r]) * (reading - reading_offsets[r])`, offsets in rad or mm. No offset is
    learned of readings that move no other axis: links of another shape would have the same effect. Links that do not
    move relative to each other are one, named after the first of them.
    """

    base: Tensor  # [4, 4] instrument_from_shaft
    wrist_start: Tensor  # mm along the shaft: where its rotational symmetry ends
    extent: Tensor  # [2] mm along the shaft, first and last solid Gaussian
    radius: Tensor  # mm, of the shaft as carved
    points: Tensor  # [J, 3] mm, on the stated axes at rest, outermost first
    directions: Tensor  # [J, 3] unit
    gains: Tensor  # [J, L - 1, R] stated value of joint j for link l per unit of reading r
    constants: Tensor  # [J, L - 1] stated value at readings of 0
    observable: Tensor  # [R] 1 where a reading's offset moves another axis, else 0
    outer: Tensor  # [J, L] 1 for links beyond a revolute joint, else 0
    inner: Tensor  # [J, L] 1 for the link that carries it, else 0
    tips: Tensor  # [L, 3] mm, at rest; nan: not measured, or another link follows
    rates: ClassVar[Mapping[str, float]] = {  # of parameters, at the start
        "shaft_tilt": 8e-3,
        "shaft_shift": 8e-2,
        "axis_turns": 3e-3,
        "axis_shifts": 3e-2,
        "reading_offsets": 2e-3,
        "reading_gains": 2e-4,
    }
    stated: ClassVar[bool] = True  # whether axes are corrections of a stated tree (else searched hinges)
    reading_names: tuple[str, ...]  # all readings that move a link
    part_names: tuple[str, ...]  # label columns, in their order
    jointed: bool  # whether any reading moves a link
    link_count: int  # logits of a Gaussian, the shaft's first
    slides: tuple[bool, ...]  # whether each joint is prismatic
    offset_sds: list[float]  # [R] standard deviations of the readings' offsets: rad, or mm of a prismatic joint's
    skeleton: Skeleton

    def __init__(self, tree: KinematicTree, joint_groups: Sequence[Sequence[Link]] | None = None) -> None:
        """joint_groups: joints of the tree that share an axis, from distal to proximal."""
        super().__init__()
        self.register_buffer("base", torch.eye(4))
        self.register_buffer("wrist_start", torch.tensor(-math.inf))
        self.register_buffer("extent", torch.zeros(2))
        self.register_buffer("radius", torch.tensor(math.inf))
        self.shaft_tilt = nn.Parameter(torch.zeros(2))
        self.shaft_shift = nn.Parameter(torch.zeros(2))
        self.tree = tree
        self.reading_names, self.jointed = tree.readings, bool(tree.readings)
        links = links_apart(tree)
        self.link_names = self.part_names = tuple(link.name for link in links)
        self.link_count = len(links)
        self.joint_groups = joints_by_axis(tree) if joint_groups is None else joint_groups
        self.slides = tuple(group[0].type == PRISMATIC for group in self.joint_groups)
        first = [tree.joints.index(group[0]) for group in self.joint_groups]
        points, directions = tree.axes_at_rest
        gains = np.zeros((len(first), len(links) - 1, len(tree.readings)))
        constants = np.zeros(gains.shape[:2])
        for j, group in enumerate(self.joint_groups):
            for joint in group:
                for k, link in enumerate(links[1:]):
                    if tree.carries(joint, link):
                        constants[j, k] += joint.offset
                        for name, gain in joint.value.items():
                            gains[j, k, tree.readings.index(name)] += gain
        stated = {"points": points[first], "directions": directions[first], "gains": gains, "constants": constants}
        for name, numbers in stated.items():
            self.register_buffer(name, torch.from_numpy(numbers).float(), persistent=False)
        self.register_buffer("tips", torch.full((len(links), 3), torch.nan))
        self.add_unknowns(len(first), len(tree.readings))
        sliding = gains[np.array(self.slides, bool)].any((0, 1))
        self.offset_sds = [OFFSET_SD[slides] for slides in sliding.tolist()]
        parents = [group[0].parent for group in self.joint_groups]
        # index of the joint that moves each joint's axis; -1: none
        self.inner_joints = tuple(
            next((j for j, group in enumerate(self.joint_groups) if any(one.name == parent for one in group)), -1)
            for parent in parents
        )
        moving = set(self.inner_joints)
        carries = [any(bool(gains[j, :, r].any()) for j in moving if j >= 0) for r in range(len(tree.readings))]
        self.register_buffer("observable", torch.tensor(carries, dtype=torch.float32), persistent=False)
        turns = torch.tensor([not slides for slides in self.slides], dtype=torch.float32)[:, None]
        moved = torch.stack([self.moves(j) for j in range(len(first))]) if first else torch.zeros(0, len(links) - 1)
        carrier = torch.tensor([self.link_of(parent) for parent in parents], dtype=torch.long)
        self.register_buffer("outer", turns * nn.functional.pad(moved.float(), (1, 0)), persistent=False)
        self.register_buffer("inner", turns * nn.functional.one_hot(carrier, len(links)), persistent=False)
        self._pivot_names = [common_name([link.name for link in group]) for group in self.joint_groups]
        self._ends = [k for k, link in enumerate(links) if k and not any(o.parent == link.name for o in links)]
        bones, ends = [], [self.link_names[k] for k in self._ends]  # from every pivot to the next ones and to the tips
        for name, group, inner in zip(self._pivot_names, self.joint_groups, self.inner_joints, strict=True):
            bones.append((f"pivot_{self._pivot_names[inner]}" if inner >= 0 else "shaft_near", f"pivot_{name}"))
            bones += [(f"pivot_{name}", f"tip_{link.name}") for link in group if link.name in ends]
        self.skeleton = (("shaft_far", "shaft_near"), *bones[::-1])

    def add_unknowns(self, joints: int, readings: int) -> None:
        """Add the learnable parameters of axes and readings."""
        self.axis_turns = nn.Parameter(torch.zeros(joints, 3))
        self.axis_shifts = nn.Parameter(torch.zeros(joints, 3))
        self.reading_offsets = nn.Parameter(torch.zeros(readings))
        self.reading_gains = nn.Parameter(torch.zeros(readings))

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
        """Return the position [] mm of the most proximal joint along the shaft, without gradient; 0 without joints."""
        return self.along_shaft(self.axes()[0]).detach().min()

    def axes(self, shaft: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Return (points [J, 3] mm, unit directions [J, 3]) of the joints' axes at rest, outermost first; `shaft`:
        result of `shaft()`, if already computed."""
        turned = self.directions + torch.linalg.cross(self.axis_turns, self.directions)
        return self.points + self.axis_shifts, nn.functional.normalize(turned, dim=1)

    def values(self, readings: Mapping[str, float]) -> Tensor:
        """Return joint values [J, L - 1], rad or mm, by which each joint moves each link except the shaft."""
        recorded = torch.stack([torch.as_tensor(readings[name]).to(self.gains) for name in self.reading_names])
        return self.constants + self.gains @ (
            (1 + self.reading_gains) * (recorded - self.observable * self.reading_offsets)
        )

    @property
    def per_unit(self) -> Tensor:
        """Return `values` per unit of each reading, [J, L - 1, R]."""
        return self.gains * (1 + self.reading_gains)

    @torch.no_grad()
    def round_until(self) -> Tensor:
        """Return the position [] mm along the shaft up to which it is spun: its end, without the links of the first
        joint, whose axis would turn."""
        return torch.minimum(self.wrist_start, self.first_joint() - self.radius)

    def resting_body(self, roll: float = 0.0) -> Callable[..., ArticulatedBody]:
        """Return the instrument's body, with the surface of revolution spun by `roll` rad, as a function of
        `world_from_body` and `values`."""
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
            longest=SETTINGS.max_scale_radii * self.radius,
            roll=roll,
            slides=self.slides,
        )

    @torch.no_grad()
    def _gate(self) -> tuple[Tensor, Tensor]:
        """Return (start [], width []) mm along the shaft of the gate proximal to which joints move nothing."""
        start = self.first_joint() - (SETTINGS.gate_radii * self.radius).clamp_max(SETTINGS.max_gate_mm)
        return start, SETTINGS.gate_width_radii * self.radius.clamp_max(SETTINGS.max_gate_width_mm)

    def link_weights(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return link weights [M, link_count] of Gaussians at points [M, 3] mm with logits [M, link_count or more]."""
        placed = self.positioned_logits(points, logits)[:, : self.link_count]
        return link_weights(points, placed, self.shaft(), *self._gate())

    def positioned_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return logits [M, link_count or more] plus a prior from the positions [M, 3] mm: near a joint, motion hardly
        discriminates between links, so a Gaussian is assigned to the link on its side of the plane through the joint
        across the links at rest."""
        return nn.functional.pad(self._sides(points), (0, logits.shape[1] - self.link_count)) + logits

    @torch.no_grad()
    def _sides(self, points: Tensor) -> Tensor:
        """Return the logits [M, L] <= 0 of the links given the positions [M, 3] mm of Gaussians."""
        pivots, axes = self.axes()
        # unit directions [J, 3] of the links at every joint at rest, from the preceding pivot; else the shaft's
        headings = [self.shaft()[1]] * len(pivots)
        for joint in reversed(range(len(pivots))):  # the innermost first
            inner = self.inner_joints[joint]
            if inner >= 0 and not self.slides[joint]:
                step = pivots[joint] - pivots[inner]
                far = float(step.norm()) > SETTINGS.min_step_mm
                headings[joint] = nn.functional.normalize(step, dim=0) if far else headings[inner]
        directions = torch.stack(headings)
        along = (points @ directions.T - (pivots * directions).sum(1)) / self.radius  # [M, J]
        aside = (points @ axes.T - (pivots * axes).sum(1)).abs() / self.radius  # [M, J]
        prongs = SETTINGS.prongs * ((aside - SETTINGS.prongs_from) / (SETTINGS.prongs_to - SETTINGS.prongs_from)).clamp(
            0, 1
        )
        beyond = SETTINGS.side_logits * (along - SETTINGS.side_start - prongs)
        return beyond.clamp_max(0) @ self.outer - beyond.clamp_min(0) @ self.inner

    @property
    def _following(self) -> int:
        """Return the index of the link after the shaft."""
        return next(k for k in range(1, self.link_count) if bool(self.moves(len(self.points) - 1)[k - 1]))

    def settled(self, points: Tensor, logits: Tensor) -> Tensor:
        """Return the final logits [M, link_count or more] of Gaussians at points [M, 3] mm, with links excluded by
        position."""
        return logits

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return ([M] weights of Gaussians on surfaces that look like the shaft, given their link weights; [] mm along
        the shaft where these end): the next link turns about a ball or pin that looks like the shaft's end, or slides
        out of it."""
        return weights[:, 0] + weights[:, self._following], self._latest_end() + self.radius

    def _latest_end(self) -> Tensor:
        """Return the distal limit [] mm of the shaft's end: the first joint, plus one radius if prismatic."""
        return self.first_joint() + self.slides[-1] * self.radius

    def longest(self, weights: Tensor) -> Tensor:
        """Return the maximum standard deviation [M, 1] mm of Gaussians with link weights [M, link_count]; static ones
        are unlimited."""
        moving = 1 - weights[:, :1]
        return SETTINGS.max_scale_radii * self.radius / moving.clamp_min(1e-6)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return the weights [M, len(part_names)] of each part for Gaussians at points [M, 3] mm with link weights [M,
        link_count]. A ball, a pin and a sliding rod look the same when they move: whatever moves with the shaft but
        lies beyond its end (where its colour or symmetry ends) is labelled as the next link."""
        first = self.first_joint()
        valid = (self.wrist_start > first - SETTINGS.max_wrist_radii * self.radius) & (
            self.wrist_start <= self._latest_end()
        )
        end = torch.where(valid, self.wrist_start, torch.full_like(first, torch.inf))
        beyond = weights[:, 0] * (self.along_shaft(points) > end)
        moved = nn.functional.one_hot(torch.tensor([0, self._following]), self.link_count).to(weights)
        return weights + beyond[:, None] * (moved[1] - moved[0])

    def place(self, points: Tensor, link: int, readings: Mapping[str, float]) -> Tensor:
        """Return points [M, 3] mm of one link, moved from rest to these readings, instrument frame."""
        return points if link == 0 else self._placed(points, link, self.values(readings), self.axes())

    def _placed(self, points: Tensor, link: int, values: Tensor, about: tuple[Tensor, Tensor]) -> Tensor:
        """Like `place`, for given joint values and axes."""
        if link == 0:
            return points
        pivots, axes = about
        for joint, value in enumerate(values[:, link - 1]):
            if self.slides[joint]:
                points = points + value * axes[joint]
            else:
                points = rotate_about(points, axes[joint], pivots[joint], value.expand(len(points)))
        return points

    def joint_points(self, readings: Mapping[str, float], shaft: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return named points [3] mm, instrument frame: the pivot of every joint (`pivot_` + the link that it moves)
        and the tip of every end link (`tip_` + its name). `shaft`: result of `shaft()`."""
        points = {}
        about, values = self.axes(), self.values(readings)
        pivots = about[0].flip(0)
        for name, group, pivot in zip(self._pivot_names[::-1], self.joint_groups[::-1], pivots, strict=True):
            carrier = self.link_of(group[0].parent)
            if group[0].type == PRISMATIC:  # its offset across the axis is not observable: placed on the shaft
                origin, direction = shaft
                pivot = origin + ((pivot - origin) @ direction) * direction
            points[f"pivot_{name}"] = self._placed(pivot[None], carrier, values, about)[0]
        for link in self._ends:
            if bool(self.tips[link].isfinite().all()):
                points[f"tip_{self.link_names[link]}"] = self._placed(self.tips[link][None], link, values, about)[0]
        return points

    def keypoints(self, readings: Mapping[str, float]) -> dict[str, Tensor]:
        """Return named points [3] mm, instrument frame: both ends of the shaft, pivots and tips."""
        origin, direction = self.shaft()
        rear, front = self.extent
        near = torch.maximum(self.wrist_start, rear) if self.jointed else front
        ends = {"shaft_far": origin + rear * direction, "shaft_near": origin + near * direction}
        return ends | self.joint_points(readings, (origin, direction))

    def rest_line(self) -> tuple[Tensor, Tensor] | None:
        """Return (point [3] mm, step [3] mm) of the line of the links at rest, from the first pivot to the next one;
        None with fewer than two pivots."""
        pivots, _ = self.axes()
        for joint in reversed(range(len(pivots))):
            inner = self.inner_joints[joint]
            if inner < 0 or self.slides[joint] or self.slides[inner]:
                continue
            step = pivots[joint] - pivots[inner]
            if float(step.norm()) > SETTINGS.min_step_mm:
                return pivots[inner], step
        return None

    @torch.no_grad()
    def out_of_reach(self, points: Tensor) -> Tensor:
        """Return bool [M]: points [M, 3] mm at rest that no part of the stated links can reach."""
        if self.rest_line() is None:
            return torch.zeros(len(points), dtype=torch.bool, device=points.device)
        origin, direction = self.shaft()
        along = self.along_shaft(points)
        aside = (points - origin - along[:, None] * direction).norm(dim=1)
        ahead = torch.cdist(points, self.axes()[0]).amin(1)
        behind = along < self.first_joint()
        return torch.where(behind, aside > SETTINGS.shaft_reach * self.radius, ahead > SETTINGS.end_reach * self.radius)

    def moved_by(self, reading: str, weights: Tensor) -> Tensor:
        """Return the share [M] of each Gaussian with link weights [M, link_count] that a reading moves."""
        moves = self.gains[:, :, self.reading_names.index(reading)].abs().amax(0) > 0  # [L - 1]
        return (weights[:, 1:] * moves).sum(1)

    def motion(self, weights: Tensor) -> tuple[list[JointMotion], Tensor]:
        """Return (axes in the order in which they move, values [M, axes, 2] rad or mm by which each moves each Gaussian
        of these link weights: at a reading of 0, and per unit of it)."""
        pivots, axes = self.axes()
        rest = self.values(dict.fromkeys(self.reading_names, 0.0))
        motions, columns = [], [weights.new_zeros(len(weights), 0, 2)]
        for joint, slides in enumerate(self.slides):
            constant = rest[joint]  # added to the first of the joint's readings
            for r, name in enumerate(self.reading_names):
                if bool(self.gains[joint, :, r].any()):
                    motions.append(JointMotion(pivots[joint], axes[joint], name, slides))
                    columns.append((weights[:, 1:] @ torch.stack([constant, self.per_unit[joint, :, r]], 1))[:, None])
                    constant = torch.zeros_like(constant)
        return motions, torch.cat(columns, 1)

    def link_shares(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return the shares [M, link_count] of links in Gaussians at points [M, 3] mm, by their link weights."""
        return weights

    def measure_tips(self, points: Tensor, weights: Tensor) -> None:
        """Set the tip of each end link to the mean of its Gaussians, at points [M, 3] mm with link weights [M,
        link_count], that are farthest from its pivot; with too few it stays unknown."""
        self.tips.fill_(torch.nan)
        pivots, _ = self.axes()
        shares = self.link_shares(points, weights)
        for link in self._ends:
            tip = points[shares[:, link] > SETTINGS.min_part_share]
            if len(tip) >= SETTINGS.min_tip_gaussians:
                away = (tip - pivots[self.joint_of(link)]).norm(dim=1)
                self.tips[link] = tip[away >= away.quantile(SETTINGS.tip_quantile)].mean(0)

    def describe(self, reading: str) -> dict[str, Any]:
        """Return axis and pivot at rest (instrument frame) of the outermost joint that the reading drives, their
        distance from the stated ones, and the reading's offset (None: not observable) and gain."""
        r = self.reading_names.index(reading)
        joint = next(j for j in range(len(self.points)) if bool(self.gains[j, :, r].any()))
        pivots, axes = self.axes()
        turned = torch.rad2deg(torch.arccos((axes[joint] @ self.directions[joint]).clamp(-1, 1)))
        shift = self.axis_shifts[joint]
        across = shift - (shift @ axes[joint]) * axes[joint]
        return {
            "moves": self._pivot_names[joint],
            "axis": [round(float(v), 5) for v in axes[joint]],
            "pivot_mm": [round(float(v), 3) for v in pivots[joint]],
            "axis_moved_deg": round(float(turned), 3),
            "pivot_moved_mm": round(float(across.norm()), 3),
            "offset": round(float(self.reading_offsets[r]), 5) if bool(self.observable[r]) else None,
            "gain": round(1 + float(self.reading_gains[r]), 5),
        }

    def prior(self) -> Tensor | None:
        """Return the squared deviation of the learned from the stated kinematics in units of its standard deviations, a
        scalar; None where nothing was stated."""
        sigma = self.reading_offsets.new_tensor(self.offset_sds)
        return (
            (self.axis_turns / SETTINGS.axis_sd).square().sum()
            + (self.axis_shifts / SETTINGS.pivot_sd).square().sum()
            + (self.reading_offsets / sigma).square().sum()
            + (self.reading_gains / SETTINGS.gain_sd).square().sum()
        )

    def moves(self, joint: int) -> Tensor:
        """Return the links that a joint moves, [L - 1] bool."""
        return (self.gains[joint].abs().amax(1) > 0) | (self.constants[joint] != 0)

    def joint_of(self, link: int) -> int:
        """Return the index of the outermost joint that moves a link other than the shaft."""
        return next(joint for joint in range(len(self.points)) if bool(self.moves(joint)[link - 1]))

    def link_of(self, name: str | None) -> int:
        """Return the index of the link that moves with frame `name`, or with its nearest ancestor."""
        numbers = {signature(self.tree, part): k for k, part in reversed(list(enumerate(self.link_names)))}
        parents = {link.name: link.parent for link in self.tree.links}
        while name is not None and signature(self.tree, name) not in numbers:
            name = parents[name]
        return 0 if name is None else numbers[signature(self.tree, name)]


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
        if logits is None or not any(articulation.stated for articulation in self.articulations):
            return logits
        rows = [logits[canonical.body(0)]]
        for index, articulation in enumerate(self.articulations):
            rows_of = canonical.body(index + 1)
            rows.append(articulation.positioned_logits(canonical.means[rows_of], logits[rows_of]))
        return torch.cat(rows)

    def link_weights(self, canonical: CanonicalGaussians, index: int) -> Tensor:
        """Return link weights [M, link_count] of one instrument's Gaussians."""
        rows = canonical.body(index + 1)
        return self.articulations[index].link_weights(canonical.means[rows], canonical.extras[LINK_LOGITS][rows])
