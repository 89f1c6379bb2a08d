"""Instruments that touch the tissue: what is drawn of it, where they touch, and how they move meanwhile.

The motion is that of the world without contact, but for stretches in which the tips go down to a point of the tissue.
Scene frame: mm, z away from the tissue; angles rad, times s.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from rendered.motion import Array, Moment, Trajectory, aim
from rendered.render import Place

KINDS = ("press", "slide", "grasp", "pull")
CLOSED = 0.05  # rad between jaws that hold a fold
TILT = math.radians(55)  # of a pull against the horizontal plane
BLEND = 0.85  # of roll and wrist that a contact's posture takes, so that they keep moving a little
LEAST_FREE_S, MOST_RAMP_S = 1.0, 0.55  # between two contacts; of the ways to and from the tissue
MOST_UNEVEN = 3.0  # mm between the heights of both tips before they grasp
SEARCHED_MM = 8.0  # about where the tips pass without contact
MOST_SUNK = 12.0  # mm that anything is below the surface


@dataclass(frozen=True, kw_only=True)
class Touch:
    """What is drawn of contact."""

    kind: str
    depth: float  # of the tip below the resting surface
    moved: float  # mm along the tissue, or that it is pulled
    towards: float  # where to, about the scene's z
    radius: float  # of the tissue that follows, to 1 / e
    return_s: float  # time constant of the tissue's return
    contacts: int  # at most, while frames to train on are taken
    share: float  # of that time

    @property
    def grasps(self) -> bool:
        """Whether jaws close on the tissue."""
        return self.kind in ("grasp", "pull")

    @property
    def travel(self) -> Array:
        """[3] how far the tips move from where they came down."""
        if self.kind not in ("slide", "pull"):
            return np.zeros(3)
        aside, lift = self.moved, 0.0
        if self.kind == "pull":  # tissue that is shifted farther than that would fold over
            aside, lift = min(self.moved * math.cos(TILT), 0.5 * self.radius), self.moved * math.sin(TILT)
        return np.array([aside * math.cos(self.towards), aside * math.sin(self.towards), lift])


def draw_touch(seed: int, has_jaws: bool) -> Touch:
    """The touch of a world's seed, from random numbers of its own."""
    rng = np.random.default_rng((seed, 13))
    shares = (0.25, 0.2, 0.25, 0.3) if has_jaws else (0.5, 0.5, 0.0, 0.0)
    kind = KINDS[int(rng.choice(4, p=shares))]
    low, high = {"press": (2.0, 5.0)}.get(kind, (1.5, 4.0))
    near, far = {"slide": (6.0, 14.0)}.get(kind, (3.0, 8.0))
    return Touch(
        kind=kind,
        depth=float(rng.uniform(low, high)),
        moved=float(rng.uniform(near, far)),
        towards=float(rng.uniform(-math.pi, math.pi)),
        radius=float(rng.uniform(5, 14)),
        return_s=float(np.exp(rng.uniform(math.log(0.2), math.log(1.5)))),
        contacts=int(rng.integers(1, 5)),
        share=float(rng.uniform(0.48, 0.62)),
    )


@dataclass(frozen=True)
class Contact:
    """One contact: from `begin` to `end` the tips are where the touch wants them, `ramp` before and after under way."""

    begin: float
    end: float
    ramp: float
    point: tuple[float, float]  # x and y of where the tips' middle comes down
    posture: tuple[float, ...]  # roll about the middle, then pitch and yaw of a wrist
    opening: float  # of jaws that are about to grasp

    def progress(self, time: float) -> float:
        """0 at the begin, 1 at the end."""
        return float(np.clip((time - self.begin) / (self.end - self.begin), 0, 1))

    def weight(self, time: float) -> float:
        """0 in free motion, 1 in contact."""
        return ease((time - self.begin) / self.ramp + 1) * ease((self.end - time) / self.ramp + 1)


def ease(share: float) -> float:
    """From 0 to 1 as `share` does, speed and acceleration 0 at both ends."""
    share = min(max(share, 0.0), 1.0)
    return share**3 * (share * (6 * share - 15) + 10)


# of a contact's progress: when the tips are down, when they hold, and when they let go
DOWN = {"press": (0.35, 0.65), "slide": (0.2, 0.8), "grasp": (0.2, 0.88), "pull": (0.2, 0.88)}
HELD, RELEASED, MOVING = 0.4, 0.93, (0.4, 0.68)


@dataclass(frozen=True, kw_only=True)
class TouchedTrajectory(Trajectory):
    """A motion with contacts."""

    place: Place  # its tissue at rest
    touch: Touch
    contacts: tuple[Contact, ...] = ()

    def at(self, time: float) -> Moment:
        """As `Trajectory` has it, with the tips on the tissue in contacts."""
        moment = super().at(time)
        for contact in self.contacts:
            if contact.weight(time) > 0:
                return self._held(moment, contact, time)
        return moment

    def tips(self, moment: Moment) -> Array:
        """[2, 3] the jaws' tips."""
        tips: Array = self.place.design.tips(moment.joints).double().numpy()
        return tips @ moment.scene_from_mechanical[:3, :3].T + moment.scene_from_mechanical[:3, 3]

    def shift(self, contact: Contact, time: float) -> Array:
        """[3] how far the tips have moved from where they came down."""
        progress, travel = contact.progress(time), self.touch.travel
        if self.touch.kind == "slide":
            return travel * (ease((progress - 0.12) / 0.76) - 0.5)
        first, last = MOVING
        return travel * ease((progress - first) / (last - first))

    def grip(self, contact: Contact, time: float) -> float:
        """How far the jaws hold tissue, 0 to 1; at `RELEASED` of the contact they are half open."""
        if not self.touch.grasps:
            return 0.0
        progress = contact.progress(time)
        return ease((progress - 0.2) / (HELD - 0.2)) * (1 - ease((progress - RELEASED) / 0.1 + 0.5))

    def _held(self, free: Moment, contact: Contact, time: float) -> Moment:
        """The moment in or near a contact."""
        weight, progress, touch = contact.weight(time), contact.progress(time), self.touch
        down, up = DOWN[touch.kind]
        depth = touch.depth * ease(progress / down)
        if touch.kind != "pull":  # what pulls lets go where it is
            depth *= 1 - ease((progress - up) / (1 - up))
        roll, *wrist = (
            float(a + BLEND * weight * (b - a)) for a, b in zip((free.roll, *free.wrist), contact.posture, strict=True)
        )
        opening = free.opening
        if touch.grasps:
            wanted = contact.opening + self.grip(contact, time) * (CLOSED - contact.opening)
            opening += weight * (wanted - opening)
        moment = replace(free, opening=opening, roll=roll, wrist=tuple(wrist))
        goal = self.reach(moment, contact.point, depth, self.shift(contact, time))
        return self._with_hinge(moment, free.hinge + weight * (goal.hinge - free.hinge))

    def reach(self, moment: Moment, point: Sequence[float], depth: float, shift: Array) -> Moment:
        """The moment with its hinge where the tips' middle is above `point`, and the lower tip `depth` below the
        surface at rest, both moved by `shift` [3]."""
        target = np.array(point) + shift[:2]
        carried = shift[:2] if self.touch.kind == "pull" else np.zeros(2)
        moment = self._with_hinge(moment, moment.hinge)
        for _ in range(4):
            tips = self.tips(moment)
            over = tips[:, 2] - self.thickness - self.rest(tips[:, :2] - carried)
            step = np.r_[target - tips[:, :2].mean(0), shift[2] - depth - over.min()]
            moment = self._with_hinge(moment, moment.hinge + step)
        return moment

    def _with_hinge(self, moment: Moment, hinge: Array) -> Moment:
        pose = aim(np.array(self.path.trocar), hinge, self.path.roll_middle + moment.roll, self.hinge_mm)
        return replace(moment, hinge=hinge, scene_from_mechanical=pose)

    @property
    def thickness(self) -> float:
        """Half of a tip's."""
        blade = self.place.design.jaws[0]
        return min(blade.half_x[1], blade.half_y[1])

    def rest(self, points: Array) -> Array:
        """Height [M] of the tissue at rest at points [M, 2]."""
        x, y = torch.from_numpy(points).float().unbind(-1)
        return self.place.tissue.height_at(x, y).double().numpy()


def with_contacts(
    free: Trajectory, place: Place, touch: Touch, times: Mapping[str, Sequence[float]]
) -> TouchedTrajectory:
    """A motion with contacts: some while frames to train on are taken, and one about the middle half of the unseen
    ones. `times`: of the frames by split."""
    own = {field.name: getattr(free, field.name) for field in fields(free)}
    trajectory = TouchedTrajectory(**own, place=place, touch=touch)
    spans = _spans(touch, times["train"], times["test"])
    if len(times["unseen"]):
        begin, end = np.quantile(times["unseen"], (0.25, 0.75))
        begin, end = max(begin - 0.15, spans[-1][1] + 0.6), min(end + 0.15, free.times[-1])
        spans.append((float(begin), float(end)))
    gaps = [2 * MOST_RAMP_S, *(after - before for (_, before), (after, _) in itertools.pairwise(spans))]
    gaps.append(2 * MOST_RAMP_S)
    ramps = [min(MOST_RAMP_S, 0.49 * min(pair)) for pair in itertools.pairwise(gaps)]
    contacts = [_contact(trajectory, *span, ramp) for span, ramp in zip(spans, ramps, strict=True)]
    return replace(trajectory, contacts=tuple(contacts))


def _spans(touch: Touch, train: Sequence[float], test: Sequence[float]) -> list[tuple[float, float]]:
    """When contacts begin and end: at regular intervals, about as many as drawn, so placed that frames to train on and
    to test with see them in about half of their number."""
    first, last = min(train), max(train)
    most = max(1, int((1 - touch.share) * (last - first) / LEAST_FREE_S))

    def placed(count: int, shift: float) -> list[tuple[float, float]]:
        every, half = (last - first) / count, touch.share / 2
        middles = [first + (n + 0.5 + shift * (1 - touch.share)) * every for n in range(count)]
        return [(middle - half * every, middle + half * every) for middle in middles]

    def cost(plan: tuple[int, float]) -> float:
        spans = placed(*plan)
        seen = [
            np.mean([any(a + 0.08 * (b - a) < time < b - 0.08 * (b - a) for a, b in spans) for time in frames])
            for frames in (train, test)
        ]
        return abs(seen[0] - 0.48) + abs(seen[1] - 0.5) + 0.05 * abs(plan[0] - min(touch.contacts, most))

    return placed(*min(itertools.product(range(1, most + 1), (0.0, -0.15, 0.15, -0.3, 0.3)), key=cost))


def _contact(trajectory: TouchedTrajectory, begin: float, end: float, ramp: float) -> Contact:
    """A contact of that time: the posture that brings the tips down before all else, the point where little else of
    the instrument meets tissue, in view and near where the tips pass anyway."""
    path, touch = trajectory.path, trajectory.touch
    free = trajectory.at((begin + end) / 2)
    here = trajectory.tips(free)[:, :2].mean(0)
    seen = trajectory.splits[int(np.searchsorted(trajectory.times, begin))] != "unseen"
    most = 0.95 * (path.opening_train if seen else path.opening_most)
    rolls = path.roll_train * np.array([-0.95, -0.5, 0.0, 0.5, 0.95])
    wrists = [width * np.array([-0.8, 0.0, 0.8]) for width in path.wrist_train]
    openings = most * np.array([0.35, 0.6, 1.0]) if touch.grasps else [free.opening]
    if not seen and not touch.grasps:
        rolls = [free.roll]  # such frames are rolled farther than any that is learned from

    def cost(moment: Moment, point: Array) -> float:
        down = trajectory.reach(moment, point, touch.depth, np.zeros(3))
        tips = trajectory.tips(down)
        uneven = abs(tips[0, 2] - tips[1, 2])
        turned = abs(moment.roll - free.roll) + sum(abs(a - b) for a, b in zip(moment.wrist, free.wrist, strict=True))
        found = 2 * max(0.0, _buried(trajectory, down) - touch.depth) + turned
        if touch.grasps:
            found += 2 * max(0.0, uneven - MOST_UNEVEN) + 3 * (1 - moment.opening / most)
        return found + _out_of_view(trajectory, down, tips.mean(0)) + 0.1 * float(np.linalg.norm(point - here))

    postures = [
        replace(free, roll=float(roll), wrist=tuple(map(float, wrist)), opening=float(opening))
        for roll, *wrist, opening in itertools.product(rolls, *wrists, openings)
    ]
    posture = min(postures, key=lambda moment: cost(moment, here))
    middle = np.array(path.look_at[:2])
    points = [
        base + SEARCHED_MM * np.array(aside)
        for base in (here, (here + middle) / 2)
        for aside in itertools.product((-1, 0, 1), repeat=2)
    ]
    x, y = min(points, key=lambda point: cost(posture, point))
    return Contact(begin, end, ramp, (float(x), float(y)), (posture.roll, *posture.wrist), posture.opening)


def _buried(trajectory: TouchedTrajectory, moment: Moment) -> float:
    """How deep, mm, wrist, jaws and the shaft's end lie below the surface at rest, by balls along their middles."""
    design = trajectory.place.design
    shaft = torch.zeros(10, 3)
    shaft[:, 2] = torch.linspace(-50, 0, 10)
    centers = torch.cat([design.balls(moment.joints)[0], shaft]).double().numpy()
    jaws = [np.interp(np.arange(9), (0, 8), np.add(b.half_x, b.half_y) / 2) for b in design.jaws]
    radii = np.concatenate([[design.wrist_radius] * 5, *jaws, [design.radius] * 10])
    pose = moment.scene_from_mechanical
    x, y, z = (centers @ pose[:3, :3].T + pose[:3, 3]).T
    return float((trajectory.rest(np.stack([x, y], -1)) - z + radii).max())


def _out_of_view(trajectory: TouchedTrajectory, moment: Moment, point: Array) -> float:
    """How far, mm, a point [3] is out of the image's inner three quarters."""
    lens = trajectory.place.lens
    x, y, z = np.linalg.inv(moment.scene_from_camera)[:3] @ [*point, 1.0]
    across = abs(x) - 0.375 * lens.width / lens.focal * z
    return float(max(0.0, across) + max(0.0, abs(y) - 0.375 * lens.height / lens.focal * z))


def sunk(place: Place, moment: Moment, points: Tensor) -> Tensor:
    """How far [M] the instrument reaches below points [M, 3] of the surface, at most MOST_SUNK mm."""
    pose = torch.from_numpy(np.linalg.inv(moment.scene_from_mechanical)).float()
    origin, up = points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 2]
    depth = torch.full((len(points),), MOST_SUNK)
    found = torch.zeros(len(points))
    active = torch.arange(len(points))
    for _ in range(30):  # from below, as far as nothing is met
        gap = place.design.everything(origin[active] - depth[active, None] * up, moment.joints)
        met = gap < 0.01
        found[active[met]] = depth[active[met]]
        depth[active] -= gap
        active = active[~met & (depth[active] > 0)]
        if not len(active):
            break
    return found
