"""Links of a kinematic tree that the capture states; corrections of axes, pivots and readings are learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.kinematics import PRISMATIC, KinematicTree, Link
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.hinges import HINGES, farthest
from neeco.scene.drawable import JointMotion


@dataclass(frozen=True, kw_only=True)
class StatedLinksSettings:
    """Priors on stated kinematics, and places of links about a joint."""

    # standard deviations of the stated kinematics
    axis_sd: float = 0.09  # rad
    pivot_sd: float = 2.0  # mm
    gain_sd: float = 0.03  # share of a reading's gain
    side_logits: float = 2.0  # per shaft radius by which a Gaussian lies on the wrong side of a joint
    # shaft radii beyond the pivot where sides change, and how much farther at the ends of its axis, since a link
    # holds the next one between its prongs
    side_start: float = 0.4  # shaft radii beyond the pivot where sides change
    prongs: float = 0.7  # shaft radii by which they change farther out at the ends of the axis
    prongs_from: float = 0.3  # shaft radii along the axis, where that begins
    prongs_to: float = 0.7  # shaft radii along the axis, where it is reached
    min_step_mm: float = 1.0  # between two pivots that define a direction
    shaft_reach: float = 3.0  # shaft radii from the axis, behind the first pivot
    end_reach: float = 8.0  # shaft radii from any pivot, before the first one
    max_wrist_radii: float = 1.5  # behind the first joint within which a found shaft end is accepted


STATED = StatedLinksSettings()

# wide: an offset is observed only by how it moves the axes beyond it, and those are stated no better
OFFSET_SD = {False: 0.1, True: 2.0}  # rad of a revolute joint, mm of a prismatic one


class StatedLinks(Articulation):
    """The links of a kinematic tree, with learned corrections.

    Joint j, of those of the tree that share an axis, turns about that axis (or slides along it): `axis_turns[j]` (rad)
    turns the stated axis and `axis_shifts[j]` (mm) shifts its pivot, in the root's frame at rest. A reading r counts as
    `(1 + reading_gains[r]) * (reading - reading_offsets[r])`, offsets in rad or mm. No offset is
    learned of readings that move no other axis: links of another shape would have the same effect. Links that do not
    move relative to each other are one, named after the first of them.
    """

    points: Tensor  # [J, 3] mm, on the stated axes at rest, outermost first
    directions: Tensor  # [J, 3] unit
    gains: Tensor  # [J, L - 1, R] value of joint j for link l per unit of reading r
    constants: Tensor  # [J, L - 1] value at readings of 0
    observable: Tensor  # [R] 1 where a reading's offset moves another axis, else 0
    outer: Tensor  # [J, L] 1 for links beyond a revolute joint, else 0
    inner: Tensor  # [J, L] 1 for the link that carries it, else 0
    tips: Tensor  # [L, 3] mm, at rest; nan: not measured, or another link follows
    rates: ClassVar[Mapping[str, float]] = {
        **Articulation.rates,
        "axis_turns": 3e-3,
        "axis_shifts": 3e-2,
        "reading_offsets": 2e-3,
        "reading_gains": 2e-4,
    }

    def __init__(self, tree: KinematicTree) -> None:
        super().__init__()
        self.tree = tree
        self.reading_names = tree.readings
        links = _moving_apart(tree)
        self.part_names = tuple(link.name for link in links)
        self.link_count = len(links)
        self.joint_groups = _sharing_axes(tree)
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
        self.axis_turns = nn.Parameter(torch.zeros(len(first), 3))
        self.axis_shifts = nn.Parameter(torch.zeros(len(first), 3))
        self.reading_offsets = nn.Parameter(torch.zeros(len(tree.readings)))
        self.reading_gains = nn.Parameter(torch.zeros(len(tree.readings)))
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
        self._pivot_names = [_common_name([link.name for link in group]) for group in self.joint_groups]
        self._ends = [k for k, link in enumerate(links) if k and not any(o.parent == link.name for o in links)]
        self.skeleton = (("shaft_far", "shaft_near"), *self._bones())

    weighs_positions: ClassVar[bool] = True

    def positioned_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        """Near a joint motion hardly separates links; there a Gaussian rather belongs to the link on whose side of the
        joint it lies, divided by a plane across the links at rest."""
        return nn.functional.pad(self._sides(points), (0, logits.shape[1] - self.link_count)) + logits

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """The link after the shaft turns about a ball or pin that looks like the shaft's end, or slides out of it."""
        return weights[:, 0] + weights[:, self._following], self._latest_end() + self.radius

    def _latest_end(self) -> Tensor:
        """Return the last position [] mm of the shaft's end: the first joint, one radius beyond it if prismatic."""
        return self.first_joint() + self.slides[-1] * self.radius

    @torch.no_grad()
    def round_until(self) -> Tensor:
        """The shaft's end, without links of the first joint: spun with the shaft, they would turn its axis."""
        return torch.minimum(self.wrist_start, self.first_joint() - self.radius)

    @torch.no_grad()
    def _sides(self, points: Tensor) -> Tensor:
        """Return logits [M, L] <= 0 of the links by the position [M, 3] mm of Gaussians."""
        pivots, axes = self.axes()
        directions = self._link_directions(pivots)
        along = (points @ directions.T - (pivots * directions).sum(1)) / self.radius  # [M, J]
        aside = (points @ axes.T - (pivots * axes).sum(1)).abs() / self.radius  # [M, J]
        prongs = STATED.prongs * ((aside - STATED.prongs_from) / (STATED.prongs_to - STATED.prongs_from)).clamp(0, 1)
        beyond = STATED.side_logits * (along - STATED.side_start - prongs)
        return beyond.clamp_max(0) @ self.outer - beyond.clamp_min(0) @ self.inner

    def _link_directions(self, pivots: Tensor) -> Tensor:
        """Return unit directions [J, 3] of the links at every joint at rest, from the pivot that carries it; else the
        shaft's."""
        directions = [self.shaft()[1]] * len(pivots)
        for joint in reversed(range(len(pivots))):  # the innermost first
            inner = self.inner_joints[joint]
            if inner >= 0 and not self.slides[joint]:
                step = pivots[joint] - pivots[inner]
                far = float(step.norm()) > STATED.min_step_mm
                directions[joint] = nn.functional.normalize(step, dim=0) if far else directions[inner]
        return torch.stack(directions)

    @property
    def _following(self) -> int:
        """Index of the link after the shaft."""
        return next(k for k in range(1, self.link_count) if bool(self.moves(len(self.points) - 1)[k - 1]))

    @property
    def slides(self) -> tuple[bool, ...]:
        return tuple(group[0].type == PRISMATIC for group in self.joint_groups)

    def axes(self, shaft: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        turned = self.directions + torch.linalg.cross(self.axis_turns, self.directions)
        return self.points + self.axis_shifts, nn.functional.normalize(turned, dim=1)

    def first_joint(self) -> Tensor:
        return self.along_shaft(self.axes()[0]).detach().min()

    def values(self, readings: Mapping[str, float]) -> Tensor:
        given = torch.stack([torch.as_tensor(readings[name]).to(self.gains) for name in self.reading_names])
        return self.constants + self.gains @ (
            (1 + self.reading_gains) * (given - self.observable * self.reading_offsets)
        )

    def place(self, points: Tensor, link: int, readings: Mapping[str, float]) -> Tensor:
        """Return points [M, 3] mm of one link at rest moved to these readings, instrument frame."""
        return points if link == 0 else self._placed(points, link, self.values(readings), self.axes())

    def _placed(self, points: Tensor, link: int, values: Tensor, about: tuple[Tensor, Tensor]) -> Tensor:
        """`place` for the joints' `values` and axes."""
        if link == 0:
            return points
        pivots, axes = about
        for joint, value in enumerate(values[:, link - 1]):
            if self.slides[joint]:
                points = points + value * axes[joint]
            else:
                points = rotate_about(points, axes[joint], pivots[joint], value.expand(len(points)))
        return points

    def extent_of(self, link: int, reach: float, margin: float) -> tuple[Tensor, Tensor]:
        """Return cubes at rest that contain a link: centres [K, 3] mm, half sizes [K] mm. They reach `reach` from its
        pivot where no link follows, else to the pivots beyond plus `margin`."""
        pivots, _ = self.axes()
        own = next(j for j in range(len(pivots)) if bool(self.moves(j)[link - 1]))
        beyond = [j for j, group in enumerate(self.joint_groups) if self.link_of(group[0].parent) == link]
        if not beyond:
            return pivots[own][None], pivots.new_tensor([reach])
        middle = torch.stack([(pivots[own] + pivots[j]) / 2 for j in beyond])
        half = torch.stack([(pivots[own] - pivots[j]).norm() / 2 + margin for j in beyond])
        return middle, half

    def opened_by(self, reading: str) -> dict[int, tuple[int, float]]:
        """Return {link: (joint, sense)} of links that a reading turns about one axis in opposite directions."""
        found: dict[int, tuple[int, float]] = {}
        for joint, own in enumerate(self.gains[:, :, self.reading_names.index(reading)]):  # [L - 1]
            if bool((own > 0).any()) and bool((own < 0).any()) and not self.slides[joint]:
                found |= {k + 1: (joint, 1.0 if gain > 0 else -1.0) for k, gain in enumerate(own.tolist()) if gain}
        return found

    @torch.no_grad()
    def plane_between(self, joint: int, heading: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
        """Return (pivot [3] mm, unit directions [3] of the links beyond and of positive rotation) at rest, for links
        turned by `heading` (rad) about the joint's axis from the line of those before."""
        pivots, axes = self.axes()
        line = self.rest_line()
        along = self.shaft()[1] if line is None else line[1]
        turn = along.new_tensor([heading])
        ahead = rotate_about(along[None], axes[joint], torch.zeros_like(along), turn)[0]
        towards = torch.linalg.cross(axes[joint], ahead)
        return pivots[joint], nn.functional.normalize(ahead, dim=0), nn.functional.normalize(towards, dim=0)

    def joint_points(self, readings: Mapping[str, float], shaft: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return the pivot of every joint, `pivot_` + the link that it moves, and the tip of every end link, `tip_` +
        its name."""
        found = {}
        about, values = self.axes(), self.values(readings)
        pivots = about[0].flip(0)
        for name, group, pivot in zip(self._pivot_names[::-1], self.joint_groups[::-1], pivots, strict=True):
            carrier = self.link_of(group[0].parent)
            if group[0].type == PRISMATIC:  # its offset across the axis is not observable: put on the shaft
                origin, direction = shaft
                pivot = origin + ((pivot - origin) @ direction) * direction
            found[f"pivot_{name}"] = self._placed(pivot[None], carrier, values, about)[0]
        for link in self._ends:
            if bool(self.tips[link].isfinite().all()):
                found[f"tip_{self.part_names[link]}"] = self._placed(self.tips[link][None], link, values, about)[0]
        return found

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """A ball or pin looks the same on either side, and so does a sliding rod: everything that moves with the shaft
        but lies beyond its end (where its colour or symmetry ends) is labelled as the next link."""
        first = self.first_joint()
        found = (self.wrist_start > first - STATED.max_wrist_radii * self.radius) & (
            self.wrist_start <= self._latest_end()
        )
        end = torch.where(found, self.wrist_start, torch.full_like(first, torch.inf))
        beyond = weights[:, 0] * (self.along_shaft(points) > end)
        moved = nn.functional.one_hot(torch.tensor([0, self._following]), self.link_count).to(weights)
        return weights + beyond[:, None] * (moved[1] - moved[0])

    def rest_line(self) -> tuple[Tensor, Tensor] | None:
        """Return (point [3] mm, step [3] mm) of the line of the links at rest, from the first pivot to the one that it
        carries; None without two pivots."""
        pivots, _ = self.axes()
        for joint in reversed(range(len(pivots))):
            inner = self.inner_joints[joint]
            if inner < 0 or self.slides[joint] or self.slides[inner]:
                continue
            step = pivots[joint] - pivots[inner]
            if float(step.norm()) > STATED.min_step_mm:
                return pivots[inner], step
        return None

    @torch.no_grad()
    def out_of_reach(self, points: Tensor) -> Tensor:
        """Return bool [M]: points [M, 3] mm at rest that are farther from the stated links than any part of them."""
        if self.rest_line() is None:
            return torch.zeros(len(points), dtype=torch.bool, device=points.device)
        origin, direction = self.shaft()
        along = self.along_shaft(points)
        aside = (points - origin - along[:, None] * direction).norm(dim=1)
        ahead = torch.cdist(points, self.axes()[0]).amin(1)
        behind = along < self.first_joint()
        return torch.where(behind, aside > STATED.shaft_reach * self.radius, ahead > STATED.end_reach * self.radius)

    def moved_by(self, reading: str, weights: Tensor) -> Tensor:
        moves = self.gains[:, :, self.reading_names.index(reading)].abs().amax(0) > 0  # [L - 1]
        return (weights[:, 1:] * moves).sum(1)

    def motion(self, weights: Tensor) -> tuple[list[JointMotion], Tensor]:
        pivots, axes = self.axes()
        rest = self.values(dict.fromkeys(self.reading_names, 0.0))  # [J, L - 1]
        per_unit = self.gains * (1 + self.reading_gains)  # [J, L - 1, R]
        found, columns = [], []
        for joint, slides in enumerate(self.slides):
            constant = rest[joint]  # added to the first of the joint's readings
            for r, name in enumerate(self.reading_names):
                if bool(self.gains[joint, :, r].any()):
                    found.append(JointMotion(pivots[joint], axes[joint], name, slides))
                    columns.append(weights[:, 1:] @ torch.stack([constant, per_unit[joint, :, r]], 1))
                    constant = torch.zeros_like(constant)
        return found, torch.stack(columns, 1)

    def measure_tips(self, points: Tensor, weights: Tensor) -> None:
        """Set the tip of each end link to where its Gaussians lie farthest from its pivot."""
        self.tips.fill_(torch.nan)
        pivots, _ = self.axes()
        for link in self._ends:
            joint = next(j for j in range(len(pivots)) if bool(self.moves(j)[link - 1]))
            tip = farthest(points[weights[:, link] > HINGES.min_part_share], pivots[joint])
            if tip is not None:
                self.tips[link] = tip

    def describe(self, reading: str) -> dict[str, Any]:
        """Return, of the outermost joint that the reading drives, axis and pivot at rest in the instrument's frame and
        their distance from the stated ones; the reading's offset (None: not observable) and gain."""
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

    def prior(self) -> Tensor:
        slide = [any(self.slides[j] and bool(self.gains[j, :, r].any()) for j in range(len(self.points)))
                 for r in range(len(self.reading_names))]  # fmt: skip
        sigma = self.reading_offsets.new_tensor([OFFSET_SD[s] for s in slide])
        return (
            (self.axis_turns / STATED.axis_sd).square().sum()
            + (self.axis_shifts / STATED.pivot_sd).square().sum()
            + (self.reading_offsets / sigma).square().sum()
            + (self.reading_gains / STATED.gain_sd).square().sum()
        )

    def moves(self, joint: int) -> Tensor:
        """Return which links a joint moves, [L - 1] bool."""
        return (self.gains[joint].abs().amax(1) > 0) | (self.constants[joint] != 0)

    def link_of(self, name: str | None) -> int:
        """Return the index of the link that moves with frame `name`, or with the nearest frame that carries it."""
        numbers = {_signature(self.tree, part): k for k, part in reversed(list(enumerate(self.part_names)))}
        parents = {link.name: link.parent for link in self.tree.links}
        while name is not None and _signature(self.tree, name) not in numbers:
            name = parents[name]
        return 0 if name is None else numbers[_signature(self.tree, name)]

    def _bones(self) -> list[tuple[str, str]]:
        """Return lines from every pivot to those it carries and to the tips beyond."""
        bones = []
        for name, group in zip(self._pivot_names, self.joint_groups, strict=True):
            behind = [
                other
                for other, joints in zip(self._pivot_names, self.joint_groups, strict=True)
                if any(joint.name == group[0].parent for joint in joints)
            ]
            bones.append((f"pivot_{behind[0]}" if behind else "shaft_near", f"pivot_{name}"))
            ends = [self.part_names[k] for k in self._ends]
            bones += [(f"pivot_{name}", f"tip_{link.name}") for link in group if link.name in ends]
        return bones[::-1]


def _signature(tree: KinematicTree, name: str | None) -> frozenset[str]:
    """Return the names of the joints that move a link."""
    link = next((link for link in tree.links if link.name == name), tree.links[0])
    return frozenset(joint.name for joint in tree.joints if tree.carries(joint, link))


def _moving_apart(tree: KinematicTree) -> list[Link]:
    """Return links with a body that move relative to each other, one of each group; first the one that no joint
    moves."""
    chosen = {_signature(tree, link.name): link for link in reversed(tree.bodies)}
    still = chosen.pop(frozenset(), tree.links[0])
    return [still, *sorted(chosen.values(), key=tree.links.index)]


def _sharing_axes(tree: KinematicTree) -> list[list[Link]]:
    """Return joints that move a body, grouped by the axis and parent that they share, outermost first."""
    groups: list[list[Link]] = []
    for joint in tree.joints:
        if not any(tree.carries(joint, body) for body in tree.bodies):
            continue
        same = [group for group in groups if _same_axis(group[0], joint)]
        if same:
            same[0].append(joint)
        else:
            groups.append([joint])
    return groups


def _same_axis(one: Link, other: Link) -> bool:
    if (one.parent, one.type) != (other.parent, other.type) or not np.allclose(one.axis, other.axis, atol=1e-6):
        return False
    between = other.origin[:3, 3] - one.origin[:3, 3]
    return bool(np.linalg.norm(np.cross(between, one.axis)) < 1e-6)


def _common_name(names: Sequence[str]) -> str:
    """Return the common prefix of the names without a separator at its end: jaw for jaw_left and jaw_right."""
    common = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in common).rstrip("_- ") or "+".join(sorted(names))
