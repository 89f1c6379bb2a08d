"""Search for revolute joints across a shaft by stick figures, and seeds of the parts that turn about them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from neeco.capture.model import Frame, Instrument
from neeco.methods.kinematic.hinges import Hinges
from neeco.methods.space_carving import CarvedShape, CarvingSettings, Evidence, camera_from_instrument, center_line
from neeco.scene.training_session import Report
from neeco.training.session import GaussianSession


@dataclass(frozen=True, kw_only=True)
class HingeSearchSettings:
    """Settings of the search for hinges."""

    body_logit: float = 2.0  # initial link logit of seeds on the shaft's side of the hinge
    # jaw angle per reading: two jaws share the opening, or one takes it all
    gains: tuple[tuple[float, float], tuple[float, float]] = ((0.5, -0.5), (1.0, 0.0))
    small_gain: float = 0.3  # a smaller rotation, which tolerates rough evidence
    min_reading_range: float = 0.05  # rad: a joint that moves less is not searched
    n_stick_points: int = 16  # of a stick, whose evidence is averaged
    n_hinge_angles: int = 36  # axis directions tried over half a turn
    n_hinge_depths: int = 10  # pivots tried along the front half


STICKS = HingeSearchSettings()

STATE_LINKS = (
    "state its links (`kinematics`, from a ruler and a protractor, a dVRK tool file or a URDF: docs/capture.md)"
)


def hinge_joints(
    instrument: Instrument, joints: tuple[str, ...], frames: Sequence[Frame], report: Report
) -> tuple[str, ...]:
    """Return those of `joints` that are learned as hinges across the shaft: all revolute ones. Warn of prismatic
    joints, and of several moving ones, for which this is the wrong model."""
    for joint in joints:
        if instrument.slides(joint):
            report(f"warning: {instrument.name}: joint {joint} is prismatic and moves no part; {STATE_LINKS}")
    turning = tuple(joint for joint in joints if not instrument.slides(joint))
    states = [frame.state.instruments[instrument.name] for frame in frames]
    used = [joint for joint in turning if np.ptp([state.joints[joint] for state in states]) > STICKS.min_reading_range]
    if len(used) > 1:
        report(
            f"warning: {instrument.name}: {', '.join(used)}: several joints and no kinematics; each is learned as a "
            f"hinge across the shaft, which fits jaws but no wrist; {STATE_LINKS}"
        )
    return turning


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
    """Set each joint to the best hypothesis of the search, or to its axis as `learned` (see `Articulation.axes`).

    Returns seeds [M, 3] mm and their link logits [M, columns]."""
    find_hinges(session, hinges, evidence, name, shape, learned)
    seeds = shape.seeds.to(hinges.base.device)
    logits = seed_logits(hinges, seeds, columns, generator)
    return unbend_seeds(hinges, seeds, logits), logits


def find_hinges(
    session: GaussianSession,
    hinges: Hinges,
    evidence: Evidence,
    name: str,
    shape: CarvedShape,
    learned: tuple[Tensor, Tensor] | None = None,
) -> None:
    """Set each joint of `hinges`, whose shaft is in place, to the best hypothesis of the search, or to its axis as
    `learned`."""
    for index, joint in enumerate(hinges.reading_names):
        with torch.no_grad():
            if learned is not None:
                across = learned[1][index] @ hinges.base[:3, :2]
                hinges.hinge_angle[index] = torch.atan2(across[1], across[0])
                hinges.hinge_depth[index] = hinges.along_shaft(learned[0])[index]
            elif found := search_hinge(evidence, name, joint, shape, session.config.deformation.carving):
                hinges.hinge_angle[index] = found.angle
                hinges.hinge_depth[index] = found.depth
                hinges.share[index] = 1.0 if found.gains[1] == 0 else 0.5
            else:
                session.report(f"{name}: joint {joint} hardly moves in the training frames; its hinge cannot be found")
                continue
            readings = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
            hinges.middle[index] = sum(readings) / len(readings)
            hinges.closed[index] = min(readings)
            hinges.offsets[index] = (hinges.middle[index] - min(readings)) * hinges.gains[index]
    if hinges.reading_names:
        hinges.wrist_start.fill_(float(hinges.hinge_depth[0].detach()) - 5 * shape.radius)


@torch.no_grad()
def unbend_seeds(hinges: Hinges, seeds: Tensor, logits: Tensor) -> Tensor:
    """Return seeds [M, 3] mm, carved with the joints at their offsets, turned to zero offsets, to which the hinges are
    set: there a change of hinge or gains moves nothing."""
    weights = torch.softmax(logits[:, : hinges.link_count], -1)
    middle = {name: float(hinges.middle[joint]) for joint, name in enumerate(hinges.reading_names)}
    turned = hinges.bend(seeds, weights, middle)
    hinges.offsets.zero_()
    return turned


def seed_logits(hinges: Hinges, seeds: Tensor, columns: int, generator: torch.Generator) -> Tensor:
    """Return link logits [M, columns]: behind the first hinge the body, beyond it one of the moving parts at random."""
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


@dataclass(frozen=True)
class HingeScores:
    """Scores of hinges at A angles (rad around the carved shaft), D depths (mm along it) and all `gains`."""

    angles: list[float]
    depths: list[float]
    score: np.ndarray  # [D, gains, A] mean evidence on the turned sticks, in [0, 1]
    over_rigid: np.ndarray  # [D, gains, A] score less that of unturned sticks, times the share of the length they cover

    @property
    def depth(self) -> float:
        """Mean of the best depths by score and by score over rigid sticks, mm.

        The first prefers pivots too far back (short turns stay on the body), the second pivots too far forward.
        """
        best = [np.unravel_index(score.argmax(), score.shape)[0] for score in (self.score, self.over_rigid)]
        return (self.depths[best[0]] + self.depths[best[1]]) / 2

    @property
    def angle(self) -> float:
        """Phase of the score's second harmonic over the hinge angle, rad in [0, pi): uses all scores, not the peak
        alone."""
        best = self.score.max((0, 1)).tolist()
        wave = sum(s * complex(math.cos(2 * a), math.sin(2 * a)) for a, s in zip(self.angles, best, strict=True))
        return (math.atan2(wave.imag, wave.real) / 2) % math.pi

    @property
    def gains(self) -> tuple[float, float]:
        """Gains of the best score."""
        return STICKS.gains[np.unravel_index(self.score.argmax(), self.score.shape)[1]]


def search_hinge(
    evidence: Evidence, name: str, joint: str, shape: CarvedShape, settings: CarvingSettings
) -> HingeScores | None:
    """Score all hinges on a grid by stick figures; None when the reading hardly varies.

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
    score, over_rigid = [], []
    for depth in depths:
        stick = _stick(line, depth, shape.tip)
        scores = {
            gain: _stick_scores(evidence, camera_from_shaft, stick, depth, angles, turns=gain * opening, weight=opening)
            for gain in {0.0, STICKS.small_gain, -STICKS.small_gain, *STICKS.gains[0], *STICKS.gains[1]}
        }
        turned = torch.stack([(scores[first] + scores[second]) / 2 for first, second in STICKS.gains])
        score.append(torch.maximum(turned, (scores[STICKS.small_gain] + scores[-STICKS.small_gain]) / 2))
        over_rigid.append((turned - scores[0.0]) * ((shape.tip - depth) / length))
    return HingeScores(angles.tolist(), depths, *(torch.stack(s).cpu().numpy() for s in (score, over_rigid)))


def _stick(line: Tensor, depth: float, tip: float) -> Tensor:
    """Return points [Q, 3], shaft frame, of the centre line [Z, 3] from just beyond the pivot at `depth` to just before
    the tip."""
    known = line.cpu().numpy()
    along = np.linspace(depth + 0.15 * (tip - depth), tip - 0.1 * (tip - depth), STICKS.n_stick_points)
    across = [np.interp(along, known[:, 0], known[:, k]) for k in (1, 2)]
    return torch.from_numpy(np.stack([*across, along], -1)).to(line)


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
    """Return the mean evidence [A] on `stick` [Q, 3] for hinges at `angles` [A], turned by `turns` [F] rad, frames
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
