"""Revolute joints across the shaft, estimated from the images: each turns one or two jaws by one reading.

The search scores stick figures, and seeds the parts that turn about the estimated joints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.capture.model import Instrument
from neeco.evidence.carving import CarvedShape, CarvingSettings, Evidence, camera_from_instrument, center_line
from neeco.geometry.rotations import rotate_about
from neeco.methods.kinematic.articulation import Articulation
from neeco.scene.training_session import Report
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class HingeSettings:
    """Link assignment about a hinge, and thresholds of parts and tips."""

    jaw_start_radii: float = 0.75  # shaft radii beyond the hinge, from where there are only jaws
    # radii from the middle of the hinge's axis: short of that place are only the prongs that hold the jaws
    prongs_from: float = 0.55
    border_width_radii: float = 0.2  # width of either transition
    ruled_out_margin: float = 10.0  # logits by which links excluded by position are below all others
    max_fixed_jaw_gain: float = 0.25  # rad per rad of reading: a jaw with a smaller gain is fixed


HINGES = HingeSettings()


class Hinges(Articulation):
    """A straight shaft and revolute joints whose axes cross it at right angles, each of two links, its jaws.

    Joint j turns two jaws about the axis at `hinge_angle[j]` (rad, around the shaft) and `hinge_depth[j]` (mm, along
    it); jaw k turns by `offsets[j, k] + jaw_gains[j, k] * (reading - middle[j])`, `middle` being the mean of the
    recorded readings, or a change of the gains would turn everything. The reading is the angle between the two jaws, so
    the gains are `scale * (share, share - 1)`: `share` is learned freely, `scale` stays near 1.
    """

    middle: Tensor  # [J] rad or mm, as the readings
    closed: Tensor  # [J] the lowest recorded reading; nan: unknown
    rates: ClassVar[Mapping[str, float]] = {
        **Articulation.rates,
        "hinge_angle": 1e-2,
        "hinge_depth": 8e-2,
        "offsets": 6e-3,
        "share": 6e-3,
        "scale": 2e-4,
    }
    stated: ClassVar[bool] = False

    def __init__(self, joint_names: tuple[str, ...]) -> None:
        pairs = [
            [Link(f"{joint}_{jaw}", "shaft", REVOLUTE, value={joint: gain}) for jaw, gain in enumerate((0.5, -0.5))]
            for joint in joint_names
        ]
        super().__init__(KinematicTree((Link("shaft"), *chain(*pairs))), pairs)
        stems = [joint.removesuffix("_angle") for joint in joint_names]
        sides = [f"{stem}_{side}" for stem in stems for side in ("left", "right")]
        self.part_names = ("shaft", "wrist", *sides) if joint_names else ("instrument",)
        self.register_buffer("middle", torch.zeros(len(joint_names)))
        self.register_buffer("closed", torch.full((len(joint_names),), math.nan))
        ends = (("shaft_near", "hinge"), ("hinge", "tip_left"), ("hinge", "tip_right"))
        self.skeleton = (("shaft_far", "shaft_near"), *ends)

    def add_unknowns(self, joints: int, readings: int) -> None:
        self.hinge_angle = nn.Parameter(torch.zeros(joints))
        self.hinge_depth = nn.Parameter(torch.zeros(joints))
        self.offsets = nn.Parameter(torch.zeros(joints, 2))
        self.share = nn.Parameter(torch.full((joints,), 0.5))
        self.scale = nn.Parameter(torch.ones(joints))

    @property
    def jaw_gains(self) -> Tensor:
        """Return the gains [J, 2], rad of each jaw per rad of reading."""
        return self.scale[:, None] * torch.stack([self.share, self.share - 1], -1)

    @property
    def per_unit(self) -> Tensor:
        return torch.block_diag(*self.jaw_gains.split(1))[..., None] * (self.gains != 0)

    def first_joint(self) -> Tensor:
        return self.hinge_depth.detach().min() if self.jointed else torch.zeros_like(self.radius)

    def round_until(self) -> Tensor:
        return self.wrist_start

    def shaft_like(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        return weights[:, 0], self.first_joint()

    def positioned_logits(self, points: Tensor, logits: Tensor) -> Tensor:
        return logits

    def prior(self) -> None:
        return None

    def axes(self, shaft: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Return the axes without gradient of the shaft, which is learned by spinning alone."""
        origin, direction = (part.detach() for part in shaft or self.shaft())
        angle = self.hinge_angle
        around = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1) @ self.base[:3, :3].T
        axes = nn.functional.normalize(around - (around @ direction)[:, None] * direction, dim=1)
        return origin + self.hinge_depth[:, None] * direction, axes

    def values(self, readings: Mapping[str, float]) -> Tensor:
        turned = [readings[name] - self.middle[joint] for joint, name in enumerate(self.reading_names)]
        angles = self.offsets + self.jaw_gains * torch.stack(turned)[:, None] if turned else self.offsets
        return torch.block_diag(*angles.split(1)) if len(turned) > 1 else angles  # a joint moves its own two jaws

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        """Version 0.3 stored the tips of the jaws alone, by joint."""
        if (tips := state_dict.get(f"{prefix}tips")) is not None and tips.dim() == 3:
            state_dict[f"{prefix}tips"] = torch.cat([self.tips[:1].to(tips), tips.flatten(0, 1)])
        super()._load_from_state_dict(state_dict, prefix, *others)

    def hinge(self, joint: int) -> tuple[Tensor, Tensor]:
        """Return (pivot [3] mm, unit axis [3]) of one joint, instrument frame."""
        pivots, axes = self.axes()
        return pivots[joint], axes[joint]

    def joint_points(self, readings: Mapping[str, float], shaft: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return the first joint's hinge, and the tips of its left and right jaw. An unmeasured tip lies at the shaft's
        end when the joint is closed."""
        if not self.jointed:
            return {}
        pivots, axes = self.axes(shaft)
        turns, measured = self.values(readings)[0, :2], self.tips[1:3].isfinite().all(1)  # [2]
        points = torch.where(measured[:, None], self.tips[1:3], shaft[0] + self.extent[1] * shaft[1])  # [2, 3]
        opening = self.jaw_gains[0] * (readings[self.reading_names[0]] - self.closed[0])  # from where both meet
        angles = torch.where(measured | self.closed[0].isnan(), turns, opening)
        tips = rotate_about(points, axes[0], pivots[0], angles)
        left, right = tips.index_select(0, self.left_right_order(0, axes))
        return {"hinge": pivots[0], "tip_left": left, "tip_right": right}

    def link_shares(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return the link weights; a fixed jaw, learned as shaft, is assigned to the jaws beyond the hinge."""
        along, body, jaws = self.along_shaft(points), weights[:, 0], []
        for joint in range(len(self.reading_names)):
            beyond = along > self.hinge_depth[joint] + HINGES.jaw_start_radii * self.radius  # [M]
            fixed_jaw = body[:, None] * (beyond[:, None] & self._fixed(joint))
            jaws.append(weights[:, 1 + 2 * joint : 3 + 2 * joint] + fixed_jaw)
            body = body - fixed_jaw.sum(1)
        return torch.cat([body[:, None], *jaws], 1)

    def parts(self, points: Tensor, weights: Tensor) -> Tensor:
        if not self.jointed:
            return weights.new_ones(len(weights), 1)
        body, *jaws = self.link_shares(points, weights).unbind(1)
        order = [1 + 2 * joint + self.left_right_order(joint) for joint in range(len(self.reading_names))]
        wrist = (self.along_shaft(points) >= self.wrist_start).to(weights.dtype)
        links = torch.stack([body * (1 - wrist), *jaws], 1).index_select(1, torch.cat([order[0].new_zeros(1), *order]))
        return torch.cat([links[:, :1], (body * wrist)[:, None], links[:, 1:]], 1)

    @torch.no_grad()
    def settled(self, points: Tensor, logits: Tensor) -> Tensor:
        """Near a hinge all links move similarly, and images hardly discriminate between them. But jaws turn between the
        prongs of the clevis, and distal to these there are only jaws unless one is fixed."""
        if not self.jointed:
            return logits
        # how strongly the points exclude the shaft, and each jaw, [M] in [0, 1]
        along, beyond, columns = self.along_shaft(points), points.new_ones(len(points)), []
        for joint in range(len(self.reading_names)):
            pivot, axis = self.hinge(joint)
            aside = ((points - pivot) @ axis).abs() / self.radius
            past = (along - self.hinge_depth[joint]) / self.radius - HINGES.jaw_start_radii
            past = (0.5 + past / HINGES.border_width_radii).clamp(0, 1)
            prongs = (0.5 + (aside - HINGES.prongs_from) / HINGES.border_width_radii).clamp(0, 1) * (1 - past)
            columns += [prongs, prongs]
            beyond = beyond * past * ~self._fixed(joint).any()
        link_logits, ruled_out = logits[:, : self.link_count], torch.stack([beyond, *columns], 1) > 0.5
        lowest = link_logits.masked_fill(ruled_out, torch.inf).amin(1, keepdim=True)
        settled = torch.where(ruled_out, torch.minimum(link_logits, lowest - HINGES.ruled_out_margin), link_logits)
        return torch.cat([settled, logits[:, self.link_count :]], 1)

    def _fixed(self, joint: int) -> Tensor:
        """Return which of a joint's jaws is fixed, [2] bool."""
        gains = self.jaw_gains[joint].detach().abs()
        return (gains < HINGES.max_fixed_jaw_gain) & (gains == gains.min())

    def left_right_order(self, joint: int, axes: Tensor | None = None) -> Tensor:
        """Return a joint's two jaws (0 and 1) as indices [2], the left one first; `axes`: result of `axes()`, if
        computed.

        The largest component of the hinge axis is made positive; the left jaw opens towards (shaft direction x axis).
        """
        axis = (self.axes()[1] if axes is None else axes)[joint]
        sign = torch.sign(axis.gather(0, axis.abs().argmax()[None]))
        left = (sign * self.jaw_gains[joint]).argmin()
        return torch.stack([left, 1 - left])

    def describe(self, reading: str) -> dict[str, Any]:
        """Return axis and pivot in the instrument's frame, and the gains and offsets of the jaws."""
        joint = self.reading_names.index(reading)
        pivot, axis = self.hinge(joint)
        return {
            "axis": [round(float(v), 5) for v in axis],
            "pivot_mm": [round(float(v), 3) for v in pivot],
            "gains": [round(float(v), 4) for v in self.jaw_gains[joint]],
            "offsets_rad": [
                round(float(v), 4)
                for v in self.values(dict.fromkeys(self.reading_names, 0.0))[joint, 2 * joint : 2 * joint + 2]
            ],
        }


@dataclass(frozen=True, kw_only=True)
class HingeSearchSettings:
    """Settings of the search for hinges."""

    body_logit: float = 2.0  # initial link logit of seeds proximal to the hinge
    # jaw angle per reading: both jaws share the opening, or one has all of it
    gains: tuple[tuple[float, float], tuple[float, float]] = ((0.5, -0.5), (1.0, 0.0))
    small_gain: float = 0.3  # for smaller rotations, which tolerate rough evidence
    min_reading_range: float = 0.05  # rad: a joint with a smaller range is not searched
    n_stick_points: int = 16  # points per stick, over which evidence is averaged
    n_hinge_angles: int = 36  # axis directions per half turn
    n_hinge_depths: int = 10  # pivot positions along the front half


STICKS = HingeSearchSettings()

STATE_LINKS = (
    "state its links (`kinematics`, from a ruler and a protractor, a dVRK tool file or a URDF: docs/capture.md)"
)


def hinge_joints(instrument: Instrument, joints: tuple[str, ...], report: Report) -> tuple[str, ...]:
    """Return those of `joints` that are learned as hinges across the shaft, or as a wrist: all revolute ones. Warn of
    prismatic joints."""
    for joint in joints:
        if instrument.slides(joint):
            report(f"warning: {instrument.name}: joint {joint} is prismatic and moves no part; {STATE_LINKS}")
    return tuple(joint for joint in joints if not instrument.slides(joint))


def start_hinges(
    session: GaussianSession,
    hinges: Hinges,
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    learned: tuple[Tensor, Tensor] | None = None,
    *,
    columns: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Set each joint of `hinges`, whose shaft is in place, to the best hypothesis of the search, or to its axis as
    `learned` (see `Articulation.axes`).

    Returns seeds [M, 3] mm and their link logits [M, columns]."""
    for index, joint in enumerate(hinges.reading_names):
        with torch.no_grad():
            if learned is not None:
                across = learned[1][index] @ hinges.base[:3, :2]
                hinges.hinge_angle[index] = torch.atan2(across[1], across[0])
                hinges.hinge_depth[index] = hinges.along_shaft(learned[0])[index]
            elif hypothesis := search_hinge(evidence, name, joint, shape, session.config.deformation.carving):
                hinges.hinge_angle[index], hinges.hinge_depth[index], gains = hypothesis
                hinges.share[index] = 1.0 if gains[1] == 0 else 0.5
            else:
                session.report(f"{name}: joint {joint} hardly moves in the training frames; its hinge cannot be found")
                continue
            readings = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
            hinges.middle[index] = sum(readings) / len(readings)
            hinges.closed[index] = min(readings)
            hinges.offsets[index] = (hinges.middle[index] - min(readings)) * hinges.jaw_gains[index]
    if hinges.reading_names:
        hinges.wrist_start.fill_(float(hinges.hinge_depth[0].detach()) - 5 * shape.radius)
    seeds = shape.seeds.to(hinges.base.device)
    logits = seed_logits(hinges, seeds, columns, generator)
    return unbend_seeds(hinges, seeds, logits), logits


@torch.no_grad()
def unbend_seeds(hinges: Hinges, seeds: Tensor, logits: Tensor) -> Tensor:
    """Return seeds [M, 3] mm, carved with the joints at their offsets, rotated to zero offsets, at which the hinges are
    set: there, changes of hinge or gains have no effect."""
    weights = torch.softmax(logits[:, : hinges.link_count], -1)
    for joint, (pivot, axis) in enumerate(zip(*hinges.axes(), strict=True)):
        angles = weights[:, 1 + 2 * joint : 3 + 2 * joint] @ hinges.offsets[joint]
        seeds = rotate_about(seeds, axis, pivot, angles)
    hinges.offsets.zero_()
    return seeds


def seed_logits(hinges: Hinges, seeds: Tensor, columns: int, generator: torch.Generator) -> Tensor:
    """Return link logits [M, columns]: the body proximal to the first hinge, else a random moving part."""
    logits = 0.3 * torch.randn(len(seeds), columns, generator=generator).to(seeds)
    if not hinges.reading_names:
        return logits
    with torch.no_grad():
        along = hinges.along_shaft(seeds)
        beyond = along > hinges.hinge_depth[0]
        logits[:, 0] += torch.where(beyond, 0.0, STICKS.body_logit)
        side = torch.randint(1, hinges.link_count, (len(seeds),), generator=generator).to(seeds.device)
        lean = nn.functional.one_hot(side, columns) * (STICKS.body_logit / 2)
        return logits + torch.where(beyond[:, None], lean, lean.new_zeros(()))


def search_hinge(
    evidence: Evidence, name: str, joint: str, shape: CarvedShape, settings: CarvingSettings
) -> tuple[float, float, tuple[float, float]] | None:
    """Return the angle (rad around the carved shaft, in [0, pi)), depth (mm along it) and gains of the best of a grid
    of hinges, scored by stick figures; None when the reading hardly varies.

    A joint moves two parts symmetrically or one alone. Its parts are sticks: the instrument's centre line beyond the
    pivot, turned about the hinge by the reading. The right hinge keeps both sticks on evidence in every frame, above
    all where the reading is large, and leaves tissue visible between them.
    """
    recorded = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
    readings = torch.tensor(recorded, dtype=torch.float32, device=evidence.device)
    opening = readings - readings.min()
    if float(opening.max()) < STICKS.min_reading_range:
        return None
    closed = evidence.subset(torch.nonzero(readings <= readings.quantile(0.35))[:, 0])
    line = center_line(closed, name, shape, settings)
    if len(line) < 2:
        line = shape.center_line
    camera_from_shaft = camera_from_instrument(evidence, name) @ shape.instrument_from_shaft  # [F, 4, 4]
    angles = torch.arange(STICKS.n_hinge_angles, device=evidence.device) * (math.pi / STICKS.n_hinge_angles)
    length = shape.tip - shape.near
    depths = np.linspace(shape.near + 0.4 * length, shape.tip - 0.15 * length, STICKS.n_hinge_depths).tolist()
    score, over_rigid, centre_line = [], [], line.cpu().numpy()
    for depth in depths:
        # points [Q, 3] of the centre line, shaft frame, from just beyond the pivot to just before the tip
        along = np.linspace(
            depth + 0.15 * (shape.tip - depth), shape.tip - 0.1 * (shape.tip - depth), STICKS.n_stick_points
        )
        across = [np.interp(along, centre_line[:, 0], centre_line[:, k]) for k in (1, 2)]
        stick = torch.from_numpy(np.stack([*across, along], -1)).to(line)
        scores = {
            gain: _stick_scores(evidence, camera_from_shaft, stick, depth, angles, turns=gain * opening, weight=opening)
            for gain in {0.0, STICKS.small_gain, -STICKS.small_gain, *STICKS.gains[0], *STICKS.gains[1]}
        }
        turned = torch.stack([(scores[first] + scores[second]) / 2 for first, second in STICKS.gains])
        score.append(torch.maximum(turned, (scores[STICKS.small_gain] + scores[-STICKS.small_gain]) / 2))
        over_rigid.append((turned - scores[0.0]) * ((shape.tip - depth) / length))
    # [D, gains, A] mean evidence on the turned sticks, and that less the evidence on unturned ones, times the share of
    # the length they cover: the first prefers pivots too far back (short turns stay on the body), the second too far
    # forward
    score_grids = [torch.stack(each).cpu().numpy() for each in (score, over_rigid)]
    (back, gains, _), (forward, *_) = (np.unravel_index(each.argmax(), each.shape) for each in score_grids)
    # phase of the score's second harmonic over the hinge angle: uses all scores, not the peak alone
    best = score_grids[0].max((0, 1)).tolist()
    wave = sum(s * complex(math.cos(2 * a), math.sin(2 * a)) for a, s in zip(angles.tolist(), best, strict=True))
    angle = (math.atan2(wave.imag, wave.real) / 2) % math.pi
    return angle, (depths[back] + depths[forward]) / 2, STICKS.gains[gains]


def _stick_scores(
    evidence: Evidence,
    camera_from_shaft: Tensor,
    stick: Tensor,
    depth: float,
    angles: Tensor,
    *,
    turns: Tensor,
    weight: Tensor,
) -> Tensor:
    """Return the mean evidence [A] on `stick` [Q, 3] for hinges at `angles` [A], rotated by `turns` [F] rad, frames
    weighted by `weight` [F]."""
    axis = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], -1)[:, None, None]  # [A, 1, 1, 3]
    arm = (stick - stick.new_tensor([0.0, 0.0, depth]))[None, None]  # [1, 1, Q, 3]
    cosine, sine = turns.cos()[None, :, None, None], turns.sin()[None, :, None, None]
    along = (arm * axis).sum(-1, keepdim=True) * axis
    across = torch.linalg.cross(axis.expand(-1, 1, arm.shape[2], 3), arm.expand(len(angles), 1, -1, 3))
    turned = arm * cosine + across * sine + along * (1 - cosine)  # [A, F, Q, 3]
    turned[..., 2] += depth
    flat = turned.permute(1, 0, 2, 3).reshape(len(turns), -1, 3)  # [F, A * Q, 3]
    points = flat @ camera_from_shaft[:, :3, :3].transpose(1, 2) + camera_from_shaft[:, None, :3, 3]
    hits, inside = evidence.look_up_camera(points)
    weights = (inside * weight[:, None]).reshape(len(turns), len(angles), -1)
    total = (hits.reshape(weights.shape) * weights).sum((0, 2))
    return total / weights.sum((0, 2)).clamp_min(1e-6)
