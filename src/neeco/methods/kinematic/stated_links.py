"""Links whose kinematic tree was stated with the capture: what encoders and drawings get wrong is learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import takewhile
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.kinematics import PRISMATIC, KinematicTree, Link
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.methods.kinematic.hinges import MIN_PART_SHARE, farthest
from neeco.scene.drawable import JointMotion

# standard deviations of what is stated against what is so
AXIS_SIGMA = 0.09  # rad
PIVOT_SIGMA = 2.0  # mm
# wide: what an offset is, is seen only by how it carries the axes beyond it along, and those are stated no better
OFFSET_SIGMA = {False: 0.1, True: 2.0}  # rad where the joint turns, mm where it slides
GAIN_SIGMA = 0.03
SIDE_LOGITS = 2.0  # for each link of a joint, per radius by which a Gaussian lies on the wrong side of it
# radii beyond the pivot where sides change, and how much farther at the ends of its axis: a link holds the next one
# between its prongs
SIDE_AT, PRONGS, PRONGS_FROM, PRONGS_TO = 0.4, 0.7, 0.3, 0.7  # the ends: radii along the axis
MOST_SIDE = 4.0  # of the logits that count in a penalty
MIN_STEP = 1.0  # mm between two pivots that tell a direction
WRIST_WITHIN = 1.5  # radii behind the first joint in which the shaft's end is believed


class StatedLinks(Articulation):
    """The links of a kinematic tree, with corrections of what was stated.

    Joint j, of those of the tree that share an axis, turns about that axis (or slides along it): `axis_turns[j]` (rad)
    turns the stated axis and `axis_shifts[j]` (mm) shifts its pivot, in the root's frame at rest. A reading r counts as
    `(1 + reading_gains[r]) * (reading - reading_offsets[r])`, offsets in rad or mm. Of readings that move no other axis
    no offset is learned: it would be the same as links of another shape. Links that do not move against each other are
    one, called like the first of them.
    """

    points: Tensor  # [J, 3] mm, on the stated axes at rest, outermost first
    directions: Tensor  # [J, 3] unit
    gains: Tensor  # [J, L - 1, R] value of joint j for link l per unit of reading r
    constants: Tensor  # [J, L - 1] value at readings of 0
    observable: Tensor  # [R] 1 where a reading's offset shows in axes that it moves, else 0
    outer: Tensor  # [J, L] 1 for links beyond a joint that turns, else 0
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
        # of every joint, that which moves its axis; -1: none
        self.inner_joints = tuple(
            next((j for j, group in enumerate(self.joint_groups) if any(one.name == parent for one in group)), -1)
            for parent in parents
        )
        moving = set(self.inner_joints)
        carries = [any(bool(gains[j, :, r].any()) for j in moving if j >= 0) for r in range(len(tree.readings))]
        self.register_buffer("observable", torch.tensor(carries, dtype=torch.float32), persistent=False)
        turns = torch.tensor([not slides for slides in self.slides], dtype=torch.float32)[:, None]
        moved = torch.stack([self._moves(j) for j in range(len(first))]) if first else torch.zeros(0, len(links) - 1)
        carrier = torch.tensor([self.link_of(parent) for parent in parents], dtype=torch.long)
        self.register_buffer("outer", turns * nn.functional.pad(moved.float(), (1, 0)), persistent=False)
        self.register_buffer("inner", turns * nn.functional.one_hot(carrier, len(links)), persistent=False)
        self._pivot_names = [_common_name([link.name for link in group]) for group in self.joint_groups]
        self._ends = [k for k, link in enumerate(links) if k and not any(o.parent == link.name for o in links)]
        self.skeleton = (("shaft_far", "shaft_near"), *self._bones())

    weighs_places: ClassVar[bool] = True

    def placed_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        """Near a joint motion hardly tells links apart; there a Gaussian is rather of the link on whose side of the
        joint it lies: of a plane across the links at rest."""
        return nn.functional.pad(self._sides(points), (0, logits.shape[1] - self.link_count)) + logits

    def misplaced(self, points: Tensor, weights: Tensor) -> Tensor:
        return -(weights * self._sides(points).clamp_min(-MOST_SIDE)).sum(1)

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """What follows the shaft turns about a ball or pin that looks like its end, or slides out of it."""
        return weights[:, 0] + weights[:, self._following], self._latest_end() + self.radius

    def _latest_end(self) -> Tensor:
        """[] mm along the shaft: its end lies at the first joint, or where that slides, by a radius of it."""
        return self.first_joint() + self.slides[-1] * self.radius

    @torch.no_grad()
    def round_until(self) -> Tensor:
        """The shaft's end, short of what moves with the first joint: spun with the shaft, that would turn its axis
        off."""
        return torch.minimum(self.wrist_start, self.first_joint() - self.radius)

    @torch.no_grad()
    def _sides(self, points: Tensor) -> Tensor:
        """[M, L] logits, at most 0, of Gaussians at points [M, 3] mm."""
        pivots, axes = self.axes()
        directions = self._link_directions(pivots)
        along = (points @ directions.T - (pivots * directions).sum(1)) / self.radius  # [M, J]
        aside = (points @ axes.T - (pivots * axes).sum(1)).abs() / self.radius  # [M, J]
        prongs = PRONGS * ((aside - PRONGS_FROM) / (PRONGS_TO - PRONGS_FROM)).clamp(0, 1)
        beyond = SIDE_LOGITS * (along - SIDE_AT - prongs)
        return beyond.clamp_max(0) @ self.outer - beyond.clamp_min(0) @ self.inner

    def _link_directions(self, pivots: Tensor) -> Tensor:
        """[J, 3] unit: of the links at every joint at rest, from the joint's own carrier's pivot; else the shaft's."""
        directions = [self.shaft()[1]] * len(pivots)
        for joint in reversed(range(len(pivots))):  # the innermost first
            inner = self.inner_joints[joint]
            if inner >= 0 and not self.slides[joint]:
                step = pivots[joint] - pivots[inner]
                far = float(step.norm()) > MIN_STEP
                directions[joint] = nn.functional.normalize(step, dim=0) if far else directions[inner]
        return torch.stack(directions)

    @property
    def _following(self) -> int:
        """The link that follows the shaft."""
        return next(k for k in range(1, self.link_count) if bool(self._moves(len(self.points) - 1)[k - 1]))

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
        """Points [M, 3] mm of one link at rest, as they stand at these readings, instrument frame."""
        if link == 0:
            return points
        pivots, axes = self.axes()
        for joint, value in enumerate(self.values(readings)[:, link - 1]):
            if self.slides[joint]:
                points = points + value * axes[joint]
            else:
                points = rotate_about(points, axes[joint], pivots[joint], value.expand(len(points)))
        return points

    def where(self, link: int, reach: float, beside: float) -> tuple[Tensor, Tensor]:
        """(centres [K, 3] mm, half sizes [K] mm) of cubes at rest that hold a link: about its pivot, as far as `reach`
        where no link follows it, else as far as the pivots beyond and `beside` those."""
        pivots, _ = self.axes()
        own = next(j for j in range(len(pivots)) if bool(self._moves(j)[link - 1]))
        beyond = [j for j, group in enumerate(self.joint_groups) if self.link_of(group[0].parent) == link]
        if not beyond:
            return pivots[own][None], pivots.new_tensor([reach])
        middle = torch.stack([(pivots[own] + pivots[j]) / 2 for j in beyond])
        half = torch.stack([(pivots[own] - pivots[j]).norm() / 2 + beside for j in beyond])
        return middle, half

    def opened_by(self, reading: str) -> dict[int, tuple[int, float]]:
        """{link: (joint, sense)} of links that a reading turns about one axis, some one way, some the other."""
        found: dict[int, tuple[int, float]] = {}
        for joint, own in enumerate(self.gains[:, :, self.reading_names.index(reading)]):  # [L - 1]
            if bool((own > 0).any()) and bool((own < 0).any()) and not self.slides[joint]:
                found |= {k + 1: (joint, 1.0 if gain > 0 else -1.0) for k, gain in enumerate(own.tolist()) if gain}
        return found

    @torch.no_grad()
    def plane_between(self, joint: int, heading: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
        """(the pivot [3] mm, unit directions [3] of the links beyond and of positive turns) at rest, of links that lie
        turned by `heading` (rad) about the joint's axis from the line of those before."""
        pivots, axes = self.axes()
        line = self.rest_line()
        along = self.shaft()[1] if line is None else line[1]
        turn = along.new_tensor([heading])
        ahead = rotate_about(along[None], axes[joint], torch.zeros_like(along), turn)[0]
        towards = torch.linalg.cross(axes[joint], ahead)
        return pivots[joint], nn.functional.normalize(ahead, dim=0), nn.functional.normalize(towards, dim=0)

    def joint_points(self, readings: Mapping[str, float]) -> dict[str, Tensor]:
        """The pivot of every joint, `pivot_` and the name of what it moves, and the tip of every link that none
        follows, `tip_` and its name."""
        found = {}
        pivots, _ = self.axes()
        for name, group, pivot in zip(self._pivot_names[::-1], self.joint_groups[::-1], pivots.flip(0), strict=True):
            carrier = self.link_of(group[0].parent)
            if group[0].type == PRISMATIC:  # where across the axis it lies, no image shows: on the shaft's
                origin, direction = self.shaft()
                pivot = origin + ((pivot - origin) @ direction) * direction
            found[f"pivot_{name}"] = self.place(pivot[None], carrier, readings)[0]
        for link in self._ends:
            if bool(self.tips[link].isfinite().all()):
                found[f"tip_{self.part_names[link]}"] = self.place(self.tips[link][None], link, readings)[0]
        return found

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        """What turns about a ball or pin looks the same on either side of it, and a rod that slides as it did before:
        of what moves with the shaft, all beyond the shaft's end (where its colour or its symmetry ends) is labelled as
        the link that follows."""
        first = self.first_joint()
        found = (self.wrist_start > first - WRIST_WITHIN * self.radius) & (self.wrist_start <= self._latest_end())
        end = torch.where(found, self.wrist_start, torch.full_like(first, torch.inf))
        beyond = weights[:, 0] * (self.along_shaft(points) > end)
        moved = nn.functional.one_hot(torch.tensor([0, self._following]), self.link_count).to(weights)
        return weights + beyond[:, None] * (moved[1] - moved[0])

    def rest_line(self) -> tuple[Tensor, Tensor] | None:
        """(point [3] mm, step [3] mm) of the line along which the links lie at rest: from the first pivot to the one
        that it carries; None where there are not two."""
        pivots, _ = self.axes()
        for joint in reversed(range(len(pivots))):
            inner = self.inner_joints[joint]
            if inner < 0 or self.slides[joint] or self.slides[inner]:
                continue
            step = pivots[joint] - pivots[inner]
            if float(step.norm()) > MIN_STEP:
                return pivots[inner], step
        return None

    def moved_by(self, reading: str, weights: Tensor) -> Tensor:
        moves = self.gains[:, :, self.reading_names.index(reading)].abs().amax(0) > 0  # [L - 1]
        return (weights[:, 1:] * moves).sum(1)

    def motion(self, weights: Tensor) -> tuple[list[JointMotion], Tensor]:
        pivots, axes = self.axes()
        rest = self.values(dict.fromkeys(self.reading_names, 0.0))  # [J, L - 1]
        per_unit = self.gains * (1 + self.reading_gains)  # [J, L - 1, R]
        found, columns = [], []
        for joint, slides in enumerate(self.slides):
            constant = rest[joint]  # moved by the first of the joint's readings
            for r, name in enumerate(self.reading_names):
                if bool(self.gains[joint, :, r].any()):
                    found.append(JointMotion(pivots[joint], axes[joint], name, slides))
                    columns.append(weights[:, 1:] @ torch.stack([constant, per_unit[joint, :, r]], 1))
                    constant = torch.zeros_like(constant)
        return found, torch.stack(columns, 1)

    def measure_tips(self, points: Tensor, weights: Tensor) -> None:
        """The tip of a link that none follows is where its Gaussians lie farthest from its pivot."""
        self.tips.fill_(torch.nan)
        pivots, _ = self.axes()
        for link in self._ends:
            joint = next(j for j in range(len(pivots)) if bool(self._moves(j)[link - 1]))
            tip = farthest(points[weights[:, link] > MIN_PART_SHARE], pivots[joint])
            if tip is not None:
                self.tips[link] = tip

    def describe(self, reading: str) -> dict[str, Any]:
        """Of the outermost joint that the reading drives: axis and pivot at rest in the instrument's frame, and how far
        they are from those stated; the reading's offset (None: nothing shows it) and gain."""
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
        sigma = self.reading_offsets.new_tensor([OFFSET_SIGMA[s] for s in slide])
        return (
            (self.axis_turns / AXIS_SIGMA).square().sum()
            + (self.axis_shifts / PIVOT_SIGMA).square().sum()
            + (self.reading_offsets / sigma).square().sum()
            + (self.reading_gains / GAIN_SIGMA).square().sum()
        )

    def _moves(self, joint: int) -> Tensor:
        """[L - 1] bool: which links a joint moves."""
        return (self.gains[joint].abs().amax(1) > 0) | (self.constants[joint] != 0)

    def link_of(self, name: str | None) -> int:
        """Index of the link that moves as `name` does; of a frame that none does, as what carries it."""
        numbers = {_signature(self.tree, part): k for k, part in reversed(list(enumerate(self.part_names)))}
        parents = {link.name: link.parent for link in self.tree.links}
        while name is not None and _signature(self.tree, name) not in numbers:
            name = parents[name]
        return 0 if name is None else numbers[_signature(self.tree, name)]

    def _bones(self) -> list[tuple[str, str]]:
        """Lines from every pivot to those it carries and to the tips beyond."""
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
    """Names of the joints that move a link."""
    link = next((link for link in tree.links if link.name == name), tree.links[0])
    return frozenset(joint.name for joint in tree.joints if tree.carries(joint, link))


def _moving_apart(tree: KinematicTree) -> list[Link]:
    """Links with a body that move against each other, one of each kind; first what no joint moves."""
    chosen = {_signature(tree, link.name): link for link in reversed(tree.bodies)}
    still = chosen.pop(frozenset(), tree.links[0])
    return [still, *sorted(chosen.values(), key=tree.links.index)]


def _sharing_axes(tree: KinematicTree) -> list[list[Link]]:
    """Joints that move a body, those about the same axis of the same parent together, outermost first."""
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
    """What the names begin with alike, without a separator at its end: jaw for jaw_left and jaw_right."""
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in alike).rstrip("_- ") or "+".join(sorted(names))
