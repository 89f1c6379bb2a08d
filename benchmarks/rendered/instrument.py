"""Hinged instruments as distance functions, traced exactly.

Mechanical frame of an instrument: mm, z along the shaft towards the jaws, origin where the shaft meets the wrist, the
hinge at (0, 0, `hinge`) with its axis along x; the first jaw opens towards +y, the second towards -y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

SHAFT, WRIST, FIRST_JAW, SECOND_JAW = 1, 2, 3, 4  # what `trace` calls the parts; the truth's ids may swap the jaws
SHAFT_LENGTH = 320.0
ITERATIONS = 60
RING_EVERY, RING_WIDTH, RING_COLOR = 12.0, 1.6, 0.75  # mm from one painted ring to the next; linear grey
TOUCH = 0.004  # mm; a ray this near has met the surface


@dataclass(frozen=True)
class Blade:
    """A tapered, rounded, curved jaw. Lengths mm; half widths at heel and tip along x and y."""

    length: float  # from the hinge to the tip
    heel: float  # behind the hinge
    half_x: tuple[float, float]
    half_y: tuple[float, float]
    shift_x: float  # where the middle lies at the hinge
    shift_y: float
    bend_x: float  # mm sideways at the tip
    bend_y: float
    rounding: float

    def distance(self, points: Tensor) -> Tensor:
        """A lower bound [M] mm of the distance of points [M, 3] (closed jaw, hinge at the origin) to the surface."""
        x, y, z = points.unbind(-1)
        share = ((z + self.heel) / (self.length + self.heel)).clamp(0, 1)
        curve = (z / self.length).clamp(0, 1.2) ** 2
        half_x = self.half_x[0] + (self.half_x[1] - self.half_x[0]) * share
        half_y = self.half_y[0] + (self.half_y[1] - self.half_y[0]) * share
        # the inner face stays where the jaws meet while the blade thins towards the tip
        across_x = (x - self.shift_x * half_x / self.half_x[0] - self.bend_x * curve).abs() - half_x
        across_y = (y - self.shift_y * half_y / self.half_y[0] - self.bend_y * curve).abs() - half_y
        middle, half = (self.length - self.heel) / 2, (self.length + self.heel) / 2
        along = (z - middle).abs() - half
        # bending and taper stretch space a little; the factor keeps this a lower bound
        return 0.78 * rounded(torch.stack([across_x, across_y, along], -1), self.rounding)


@dataclass(frozen=True)
class Material:
    """How a part looks: linear colour, how much of it is diffuse, strength and sharpness of highlights."""

    color: tuple[float, float, float]
    diffuse: float
    shine: float
    sharpness: float


@dataclass(frozen=True)
class Design:
    """An instrument: geometry and materials (shaft, wrist, jaws). Jaw k turns by `shares[k]` of the opening."""

    name: str
    radius: float  # of the shaft
    hinge: float  # mm from the end of the shaft
    collar: float  # length of the round part of the wrist
    wrist_radius: float
    prong_half_x: tuple[float, float]  # inner and outer face of the two prongs that hold the hinge
    prong_half_y: float
    pin: float  # radius of the hinge pin
    jaws: tuple[Blade, Blade]
    shares: tuple[float, float]
    materials: tuple[Material, Material, Material]
    mirrors: bool = False  # metal that shows its surroundings instead of a haze of tissue
    rings: bool = False  # bright rings painted around the shaft, as depth marks

    wrist_joints: ClassVar[tuple[str, ...]] = ()  # readings beside the jaws'

    @property
    def reach(self) -> float:
        """How far the jaws and the wrist reach from the hinge, mm."""
        jaw = max(blade.length + abs(blade.bend_x) + abs(blade.bend_y) + 1.0 for blade in self.jaws)
        return max(jaw, self.hinge + self.radius)

    def balls(self, opening: float) -> tuple[Tensor, Tensor]:
        """Centres [K, 3] and radii [K] of balls that together hold wrist and jaws."""
        end = self.hinge + self.prong_half_y
        spacing = end / 4
        middle = torch.zeros(5, 3)
        middle[:, 2] = torch.arange(5) * spacing
        centers, radii = self._jaw_balls(opening)
        wrist = torch.full((5,), spacing / 2 + self.wrist_radius + 1.0)
        return torch.cat([middle, centers]), torch.cat([wrist, radii])

    def _jaw_balls(self, opening: float) -> tuple[Tensor, Tensor]:
        """Centres [18, 3] and radii [18] of balls that together hold the jaws."""
        centers, radii = [], []
        for blade, angle in zip(self.jaws, self.jaw_angles(opening), strict=True):
            z = torch.linspace(-blade.heel, blade.length, 9)
            curve = (z / blade.length) ** 2
            line = torch.stack([blade.shift_x + blade.bend_x * curve, blade.shift_y + blade.bend_y * curve, z], -1)
            centers.append(turn_x(line, angle) + torch.tensor([0.0, 0.0, self.hinge]))
            gap = (blade.length + blade.heel) / 8
            slack = 0.8 * (abs(blade.shift_x) + abs(blade.shift_y))  # the middle moves inwards as the blade thins
            radii.append(torch.full((9,), 0.6 * gap + max(blade.half_x) + max(blade.half_y) + slack))
        return torch.cat(centers), torch.cat(radii)

    def tips(self, opening: float) -> Tensor:
        """Middles [2, 3] of the ends of both jaws, mechanical frame."""
        ends = []
        for blade, angle in zip(self.jaws, self.jaw_angles(opening), strict=True):
            x = blade.shift_x * blade.half_x[1] / blade.half_x[0] + blade.bend_x
            y = blade.shift_y * blade.half_y[1] / blade.half_y[0] + blade.bend_y
            ends.append(turn_x(torch.tensor([[x, y, blade.length]]), angle) + torch.tensor([0.0, 0.0, self.hinge]))
        return torch.cat(ends)

    def jaw_angles(self, opening: float) -> tuple[float, float]:
        """rad about +x by which the jaws stand from the wrist: a positive turn takes z towards -y, so that the first
        turns by minus its share."""
        first, second = self.shares
        return -first * opening, second * opening

    def distances(self, points: Tensor, opening: float) -> Tensor:
        """Lower bounds [M, 3] mm of the distances of points [M, 3] to wrist, first jaw and second jaw."""
        arm = points - torch.tensor([0.0, 0.0, self.hinge])
        turned = [turn_x(arm, -angle) for angle in self.jaw_angles(opening)]
        return torch.stack(
            [self._wrist(points), *(blade.distance(t) for blade, t in zip(self.jaws, turned, strict=True))], -1
        )

    def _wrist(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        across = (x.square() + y.square()).sqrt()
        half = self.collar / 2
        collar = rounded(torch.stack([across - self.wrist_radius, (z - half).abs() - half], -1), 0.3)
        return torch.minimum(collar, self._prongs(points, self.collar - 1.0))

    def _prongs(self, points: Tensor, start: float) -> Tensor:
        """Lower bound [M] mm of the distance to the two prongs, from z = `start` on, and their pin."""
        x, y, z = points.unbind(-1)
        across = (x.square() + y.square()).sqrt()
        inner, outer = self.prong_half_x
        end = self.hinge + self.prong_half_y
        prong = torch.stack(
            [
                (x.abs() - (inner + outer) / 2).abs() - (outer - inner) / 2,
                y.abs() - self.prong_half_y,
                (z - (start + end) / 2).abs() - (end - start) / 2,
            ],
            -1,
        )
        prongs = torch.maximum(rounded(prong, 0.4), across - self.wrist_radius - 0.1)
        off_hinge = (y.square() + (z - self.hinge).square()).sqrt()
        pin = rounded(torch.stack([off_hinge - self.pin, x.abs() - outer - 0.2], -1), 0.15)
        return torch.minimum(prongs, pin)

    def on_link(self, opening: float, points: Tensor, parts: Tensor) -> Tensor:
        """Points [M, 3] on the given parts [M] as they lie with the jaws closed, from the hinge."""
        return self.turn_to_link(opening, points - torch.tensor([0.0, 0.0, self.hinge]), parts)

    def turn_to_link(self, opening: float, vectors: Tensor, parts: Tensor, sense: int = 1) -> Tensor:
        """Vectors [M, 3] as they are with the jaws closed; sense -1: the other way round."""
        for part, angle in zip((FIRST_JAW, SECOND_JAW), self.jaw_angles(opening), strict=True):
            vectors = torch.where((parts == part)[:, None], turn_x(vectors, -sense * angle), vectors)
        return vectors

    def everything(self, points: Tensor, opening: float) -> Tensor:
        """Lower bound [M] mm of the distance to the whole instrument, shaft included."""
        x, y, z = points.unbind(-1)
        shaft = torch.maximum((x.square() + y.square()).sqrt() - self.radius, z)
        return torch.minimum(shaft, self.distances(points, opening).amin(-1))


def trace(design: Design, opening: float, origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Meet rays from `origin` [3] along `directions` [M, 3] (any length), mechanical frame, with the instrument.

    Returns distances [M] in lengths of the direction (inf: missed) and parts [M] uint8 (0: missed).
    """
    distance = torch.full((len(directions),), torch.inf)
    part = torch.zeros(len(directions), dtype=torch.uint8)
    lengths = directions.norm(dim=-1)
    unit = directions / lengths[:, None]
    shaft = _meet_shaft(design.radius, origin, unit)
    struck = shaft.isfinite()
    distance[struck], part[struck] = shaft[struck], SHAFT
    # the head is looked for only inside balls along wrist and jaws
    centers, radii = design.balls(opening)
    nearest = unit @ (centers - origin).T  # [M, K]
    half = radii.square() - ((centers - origin).square().sum(-1) - nearest.square())
    chord = half.clamp_min(0).sqrt()
    inside = (half > 0) & (nearest > 0)
    entry = torch.where(inside, nearest - chord, torch.inf).amin(-1)
    leave = torch.where(inside, nearest + chord, -torch.inf).amax(-1)
    active = torch.nonzero(inside.any(-1))[:, 0]
    t, far = entry[active].clamp_min(0.1), torch.minimum(leave[active], distance[active])
    for _ in range(ITERATIONS):
        gaps, which = design.distances(origin + t[:, None] * unit[active], opening).min(-1)
        met = (gaps < TOUCH) & (t < far)
        distance[active[met]], part[active[met]] = t[met], (which[met] + WRIST).to(torch.uint8)
        t = t + gaps.clamp_min(TOUCH)
        going = ~met & (t < far)
        active, t, far = active[going], t[going], far[going]
        if not len(active):
            break
    return distance / lengths, part


def normals(design: Design, opening: float, points: Tensor, parts: Tensor) -> Tensor:
    """Unit outward normals [M, 3] at surface points [M, 3] of the given parts [M]."""
    around = F.normalize(points * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    corners = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
    column = (parts.long() - WRIST).clamp_min(0)[:, None]
    slope = torch.zeros_like(points)
    for corner in corners:
        slope += corner * design.distances(points + 0.02 * corner, opening).gather(1, column)
    return torch.where((parts == SHAFT)[:, None], around, F.normalize(slope, dim=-1))


def painted(design: Design, points: Tensor, parts: Tensor) -> Tensor:
    """Which points [M, 3] on the given parts [M] a painted ring covers."""
    if not design.rings:
        return torch.zeros_like(parts, dtype=torch.bool)
    return (parts == SHAFT) & (torch.remainder(points[:, 2], RING_EVERY) < RING_WIDTH)


def grain(design: Design, opening: float, points: Tensor, parts: Tensor) -> Tensor:
    """Worn metal, in [-1, 1]: a pattern [M] that stays where it is on each part; points [M, 3], parts [M]."""
    arm = design.on_link(opening, points, parts)
    wavy = arm + 0.8 * torch.sin(arm[:, [1, 2, 0]] * torch.tensor([1.3, 0.8, 1.9]))
    coarse = torch.sin(wavy @ torch.tensor([0.9, -0.7, 0.5])) * torch.sin(wavy @ torch.tensor([-0.4, 1.1, 0.8]))
    fine = torch.sin(wavy @ torch.tensor([2.1, 1.5, -1.1])) * torch.sin(wavy @ torch.tensor([1.2, -1.9, 1.7]))
    return 0.6 * coarse + 0.4 * fine


def shadow(design: Design, opening: float, points: Tensor, light: Tensor, sharpness: float) -> Tensor:
    """Share [M] of a light at `light` [3] that reaches points [M, 3] past the instrument; mechanical frame."""
    towards = light - points
    reach = towards.norm(dim=-1)
    unit = towards / reach[:, None]
    lit = torch.ones(len(points))
    active = torch.nonzero(_near_axis(points, unit, reach, design))[:, 0]
    t = torch.full((len(active),), 2.0)
    for _ in range(40):
        gap = design.everything(points[active] + t[:, None] * unit[active], opening)
        lit[active] = torch.minimum(lit[active], (0.5 + 0.5 * sharpness * gap / t).clamp(0, 1))
        t = t + gap.abs().clamp_min(0.5)
        going = (t < 0.9 * reach[active]) & (lit[active] > 0)
        active, t = active[going], t[going]
        if not len(active):
            break
    return lit * lit * (3 - 2 * lit)


def _near_axis(points: Tensor, unit: Tensor, reach: Tensor, design: Design) -> Tensor:
    """Which segments [M] pass near the shaft or the head."""
    margin = 6.0  # the penumbra's width
    center = torch.tensor([0.0, 0.0, design.hinge])
    along = ((center - points) * unit).sum(-1)
    near_head = (points + along[:, None] * unit - center).norm(dim=-1) < design.reach + margin
    flat, slope = points[:, :2], unit[:, :2]
    t = (-(flat * slope).sum(-1) / slope.square().sum(-1).clamp_min(1e-9)).clamp_min(0)
    t = torch.minimum(t, reach)
    near_shaft = (flat + t[:, None] * slope).norm(dim=-1) < design.radius + margin
    return near_head | near_shaft


def _meet_shaft(radius: float, origin: Tensor, unit: Tensor) -> Tensor:
    """Distance [M] to the cylinder -SHAFT_LENGTH < z < 0 with its front face, inf where missed."""
    a = unit[:, :2].square().sum(-1).clamp_min(1e-12)
    b = unit[:, :2] @ origin[:2]
    root = b.square() - a * (origin[:2].square().sum() - radius**2)
    side = (-b - root.clamp_min(0).sqrt()) / a
    z = origin[2] + side * unit[:, 2]
    side = torch.where((root > 0) & (side > 0.1) & (z < 0) & (z > -SHAFT_LENGTH), side, torch.inf)
    face = -origin[2] / torch.where(unit[:, 2].abs() < 1e-9, 1e-9, unit[:, 2])
    across = (origin[:2] + face[:, None] * unit[:, :2]).square().sum(-1)
    face = torch.where((face > 0.1) & (across < radius**2) & (origin[2] > 0), face, torch.inf)
    return torch.minimum(side, face)


def rounded(outside: Tensor, rounding: float) -> Tensor:
    """Distance to a box-like solid from how far outside its faces a point is [M, K], edges rounded."""
    beyond = outside + rounding
    return beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0) - rounding


def turn_x(points: Tensor, angle: float) -> Tensor:
    """Points [M, 3] turned about x by `angle` rad."""
    cosine, sine = torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle))
    x, y, z = points.unbind(-1)
    return torch.stack([x, cosine * y - sine * z, sine * y + cosine * z], -1)
