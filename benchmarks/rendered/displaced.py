"""Tissue that gives way: its displacement under an instrument, and the height field that it makes of an organ.

Displacements belong to points at rest, at the nodes of the organ's height field; scene frame, mm.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rendered.frames import Shot, image_name
from rendered.motion import FRAME_RATE, Array, Moment
from rendered.tissue import HALF_SIZE, Tissue, blur
from rendered.touch import HELD, RELEASED, Contact, TouchedTrajectory, ease, sunk

LAG_S = 0.08  # tissue stays so long before it returns, and follows so late far from jaws that pull
AROUND = 24.0  # mm about the tips in which the instrument presses
FOLD = (3.0, 5.0)  # mm, radius of a fold between jaws: least, most
COVER = 2.0  # mm of tissue over the tips that hold it
TIP = 5.0  # mm from a tip's middle that count as the tip
TOUCHING = 0.05  # mm
STILL = 0.004  # mm; a smaller displacement is none
POINTS = 200


@dataclass(frozen=True)
class Displaced:
    """One frame's displacement [3, R, C] of the nodes from `corner` (row, column) on, and the contact."""

    corner: tuple[int, int]
    values: Tensor
    contact: str
    depth: float  # mm, of the tips below the surface at rest

    @property
    def most(self) -> float:
        """The largest displacement, mm."""
        return float(self.values.norm(dim=0).max())

    def whole(self, size: int) -> Tensor:
        """The displacement [3, size, size] of all nodes, 0 beyond those that move."""
        (top, left), (_, high, wide) = self.corner, self.values.shape
        whole = torch.zeros(3, size, size)
        whole[:, top : top + high, left : left + wide] = self.values
        return whole


def displacements(trajectory: TouchedTrajectory, shots: list[Shot]) -> dict[int, Displaced]:
    """What the tissue does in each frame of a motion, by the frame's number.

    Whatever is below the surface presses a dent, which spreads by the touch's radius and comes back exponentially;
    between jaws it stands up as a fold, which is moved by them, and comes back alike.
    """
    touch = trajectory.touch
    nodes = _Nodes.around(trajectory)
    dent = torch.zeros(nodes.shape)
    recent: deque[Tensor] = deque(maxlen=1 + round(LAG_S * FRAME_RATE))
    wanted, found = {shot.number for shot in shots}, {}
    decay = math.exp(-1 / (FRAME_RATE * touch.return_s))
    for number, time in enumerate(trajectory.times):
        time = float(time)
        moment, own = trajectory.at(time), _contact_at(trajectory, time)
        pressed, depth = _pressed(trajectory, nodes, moment, own, time) if own else (torch.zeros(nodes.shape), 0.0)
        recent.append(pressed)
        most = torch.stack(tuple(recent)).amax(0)
        dent = torch.maximum(dent * decay, _spread(most, touch.radius / nodes.spacing))
        if number not in wanted:
            continue
        values = torch.stack([torch.zeros_like(dent), torch.zeros_like(dent), -blur(dent, 1.0)])
        contact = "touching" if depth > TOUCHING or float(pressed.max()) > TOUCHING else "none"
        for grasp in trajectory.contacts if touch.grasps else ():
            values = _with_fold(trajectory, nodes, values, grasp, time)
            if _held(grasp)[0] <= time <= _held(grasp)[1]:
                contact = "grasping"
        found[number] = Displaced(nodes.corner, values, contact, depth)
    return found


def displaced(tissue: Tissue, change: Displaced) -> Tissue:
    """The tissue with its surface moved; what is not near stays as it is, bit for bit."""
    moved = torch.nonzero(change.values.norm(dim=0) > STILL)
    if not len(moved):
        return tissue
    size, texels = tissue.height.shape[0], tissue.surface.shape[-1]
    margin = math.ceil(22 / _spacing(size))  # light and lateral shifts reach farther than the displacement
    first = (moved.amin(0) - margin).clamp_min(0) + torch.tensor(change.corner)
    last = (moved.amax(0) + margin + 1 + torch.tensor(change.corner)).clamp_max(size)
    rows, columns = (slice(int(a), int(b)) for a, b in zip(first, last, strict=True))
    whole = change.whole(size)
    # where what lies at a place has come from: x with x + shift(x) the place
    y, x = torch.meshgrid(_axis(size)[rows], _axis(size)[columns], indexing="ij")
    place = torch.stack([x, y])
    origin = place
    for _ in range(12):
        origin = place - _sampled(whole, origin)[:2]
    rise = _sampled(whole, origin)[2]
    height = tissue.height.clone()
    height[rows, columns] = tissue.height_at(*(plane.reshape(-1) for plane in origin)).view_as(rise) + rise

    sigma = 5.0 / _spacing(size)  # as `tissue.finish` darkens creases
    deeper = (blur(height, sigma) - height).clamp_min(0) - (blur(tissue.height, sigma) - tissue.height).clamp_min(0)
    shift = torch.zeros(4, size, size)
    shift[:2, rows, columns], shift[2, rows, columns], shift[3] = origin - place, rise, deeper
    fine_rows, fine_columns = (_texels(part, size, texels) for part in (rows, columns))
    y, x = torch.meshgrid(_axis(texels)[fine_rows], _axis(texels)[fine_columns], indexing="ij")
    fine = _sampled(shift, torch.stack([x, y]), "bicubic")
    from_x, from_y = x + fine[0], y + fine[1]
    surface = tissue.look_up(torch.stack([from_x, from_y], -1).reshape(-1, 2)).T.reshape(8, *x.shape)
    slope_x, slope_y = (-surface[axis] / surface[5].clamp_min(0.05) for axis in (3, 4))
    step = _spacing(texels)
    (xy, xx), (yy, yx), (up_y, up_x) = (torch.gradient(plane, spacing=step) for plane in (from_x, from_y, fine[2]))
    surface[3] = -(xx * slope_x + yx * slope_y + up_x)
    surface[4] = -(xy * slope_x + yy * slope_y + up_y)
    surface[5] = 1.0
    surface[3:6] = F.normalize(surface[3:6], dim=0)
    surface[7] = (surface[7] * torch.exp(-0.28 * fine[3])).clamp_max(1)
    whole_surface = tissue.surface.clone()
    changed = (fine.abs().amax(0) > STILL)[None]
    here = whole_surface[:, fine_rows, fine_columns]
    whole_surface[:, fine_rows, fine_columns] = torch.where(changed, surface, here)
    return replace(tissue, height=height, surface=whole_surface)


def describe_contact(shots: list[Shot], found: dict[int, Displaced]) -> dict[str, Any]:
    """truth/contact.json: by image."""
    return {
        image_name(shot).split("/")[-1]: {
            "contact": found[shot.number].contact,
            "depth_mm": round(found[shot.number].depth, 3),
            "displacement_mm": round(found[shot.number].most, 3),
        }
        for shot in shots
    }


def describe_points(
    trajectory: TouchedTrajectory, shots: list[Shot], found: dict[int, Displaced], world_from_scene: Array
) -> dict[str, Any]:
    """truth/points.json: points [P, 3] of the surface at rest about where it is touched, and their displacement
    [F, P, 3] in every frame; mm, the world of truth/transforms.json."""
    tissue, radius = trajectory.place.tissue, trajectory.touch.radius
    rng = np.random.default_rng(int(1e6 * radius))
    about = np.array([contact.point for contact in trajectory.contacts])
    away, turn = 2.5 * radius * np.sqrt(rng.uniform(0, 1, POINTS)), rng.uniform(-np.pi, np.pi, POINTS)
    flat = about[np.arange(POINTS) % len(about)] + away[:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    x, y = torch.from_numpy(flat).float().unbind(-1)
    rest = torch.stack([x, y, tissue.height_at(x, y)], -1).double().numpy()
    rotation, size = world_from_scene[:3, :3], tissue.height.shape[0]
    moved = []
    for shot in shots:
        own = _sampled(found[shot.number].whole(size), torch.stack([x, y])[:, None])[:, 0].T.double().numpy()
        moved.append((own @ rotation.T).round(4).tolist())
    return {
        "units": "mm",
        "file_names": [image_name(shot).split("/")[-1] for shot in shots],
        "rest": (rest @ rotation.T + world_from_scene[:3, 3]).round(4).tolist(),
        "displacement": moved,
    }


@dataclass(frozen=True)
class _Nodes:
    """The nodes of a height field in which tissue can move."""

    corner: tuple[int, int]
    x: Tensor  # [C] mm
    y: Tensor  # [R]
    rest: Tensor  # [R, C] height at rest
    spacing: float

    @property
    def shape(self) -> torch.Size:
        return self.rest.shape

    @staticmethod
    def around(trajectory: TouchedTrajectory) -> _Nodes:
        """Those that any contact can reach."""
        height = trajectory.place.tissue.height
        points = np.array([contact.point for contact in trajectory.contacts])
        reach = AROUND + trajectory.touch.moved + 2.6 * trajectory.touch.radius
        axis = _axis(len(height))
        inside = [
            torch.nonzero((axis > points[:, k].min() - reach) & (axis < points[:, k].max() + reach))[:, 0]
            for k in (1, 0)
        ]
        rows, columns = (slice(int(part[0]), int(part[-1]) + 1) for part in inside)
        corner = (rows.start, columns.start)
        return _Nodes(corner, axis[columns], axis[rows], height[rows, columns], _spacing(len(height)))


def _contact_at(trajectory: TouchedTrajectory, time: float) -> Contact | None:
    return next((contact for contact in trajectory.contacts if contact.weight(time) > 0.5), None)


def _pressed(
    trajectory: TouchedTrajectory, nodes: _Nodes, moment: Moment, contact: Contact, time: float
) -> tuple[Tensor, float]:
    """How far [R, C] the instrument is below the surface at rest at every node, and the depth of its tips, mm."""
    tips = trajectory.tips(moment)
    carried = trajectory.shift(contact, time)[:2] if trajectory.touch.kind == "pull" else np.zeros(2)
    middle = tips[:, :2].mean(0) - carried  # among points at rest
    rows = torch.nonzero((nodes.y - middle[1]).abs() < AROUND)[:, 0]
    columns = torch.nonzero((nodes.x - middle[0]).abs() < AROUND)[:, 0]
    y, x = torch.meshgrid(nodes.y[rows] + carried[1], nodes.x[columns] + carried[0], indexing="ij")
    area = (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
    points = torch.stack([x, y, nodes.rest[area].double()], -1).reshape(-1, 3)
    below = np.c_[tips[:, :2], trajectory.rest(tips[:, :2] - carried)]  # tips may lie between nodes
    deep, own = sunk(trajectory.place, moment, torch.cat([points, torch.from_numpy(below)]).float()).split(
        (len(points), len(tips))
    )
    deep = deep.view_as(x)
    depth = float(own.max())
    for tip, depth_of_tip in zip(tips, own, strict=True):
        squared = (x - tip[0]).square() + (y - tip[1]).square()
        deep = torch.where(squared == squared.min(), deep.clamp_min(float(depth_of_tip)), deep)
        depth = max(depth, float(torch.where(squared < TIP**2, deep, 0.0).max()))
    pressed = torch.zeros(nodes.shape)
    pressed[area] = deep
    return pressed, depth


def _spread(pressed: Tensor, radius: float) -> Tensor:
    """[R, C] the least surface of bells exp(-(d / radius)^2) of the pressed depths [R, C]; radius in nodes."""
    deep = torch.nonzero(pressed > 0)
    if not len(deep):
        return torch.zeros_like(pressed)
    rows, columns = (torch.arange(int(deep[:, k].min()), int(deep[:, k].max()) + 1) for k in (0, 1))
    bell_rows, bell_columns = (
        torch.exp(-(((torch.arange(count)[:, None] - part) / radius) ** 2))
        for count, part in zip(pressed.shape, (rows, columns), strict=True)
    )
    small = pressed[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    along = (bell_rows[:, :, None] * small[None]).amax(1)  # [R, c]
    return torch.stack([(row * bell_columns).amax(1) for row in along])


def _held(contact: Contact) -> tuple[float, float]:
    """When jaws hold tissue."""
    length = contact.end - contact.begin
    return contact.begin + HELD * length, contact.begin + RELEASED * length


def _with_fold(trajectory: TouchedTrajectory, nodes: _Nodes, values: Tensor, contact: Contact, time: float) -> Tensor:
    """Displacement [3, R, C] with a grasp's fold: the tissue that jaws hold, moved by them or on its way back."""
    first, last = _held(contact)
    if time <= contact.begin:
        return values
    touch = trajectory.touch
    left = math.exp(-max(0.0, time - last - LAG_S) / touch.return_s)
    grip = left * ease((time - contact.begin) / (contact.end - contact.begin) / HELD * 2 - 1)
    at_grip = trajectory.tips(trajectory.at(first)).mean(0)

    def carried(when: float) -> Array:
        when = min(max(when, first), last)
        return trajectory.tips(trajectory.at(when)).mean(0) - at_grip

    x, y = nodes.x - float(at_grip[0]), nodes.y[:, None] - float(at_grip[1])
    squared = x.square() + y.square()
    wide = torch.exp(-squared / touch.radius**2)
    narrow = torch.exp(-squared / min(max(0.5 * touch.radius, FOLD[0]), FOLD[1]) ** 2)
    rest = float(trajectory.rest(at_grip[None, :2])[0])
    above = float(at_grip[2]) + trajectory.thickness + COVER - rest  # of the fold over the surface at rest
    now, before = (torch.from_numpy(left * carried(when)).float()[:, None, None] for when in (time, time - LAG_S))
    moved = (now * wide + before * (1 - wide)) * wide
    values = values * (1 - grip * narrow) + moved
    values[2] += grip * above * narrow
    return values


def _spacing(count: int) -> float:
    return 2 * HALF_SIZE / (count - 1)


def _axis(count: int) -> Tensor:
    return torch.linspace(-HALF_SIZE, HALF_SIZE, count)


def _texels(nodes: slice, size: int, texels: int) -> slice:
    """The texels between the first and the last of some nodes."""
    share = (texels - 1) / (size - 1)
    return slice(math.ceil(nodes.start * share), math.floor((nodes.stop - 1) * share) + 1)


def _sampled(planes: Tensor, points: Tensor, mode: str = "bilinear") -> Tensor:
    """Planes [K, S, S] over the whole tissue at points [2, R, C] (x, y): [K, R, C]."""
    grid = (points.permute(1, 2, 0) / HALF_SIZE)[None]
    return F.grid_sample(planes[None], grid, mode=mode, padding_mode="border", align_corners=True)[0]
