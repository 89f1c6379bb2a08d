"""Where is a joint's hinge? A global search over stick figures against the evidence, before anything is trained.

A joint moves two parts symmetrically or one alone. Its parts are sticks: the instrument's centre line beyond the pivot,
turned about the hinge by the reading. The right hinge keeps both sticks on evidence in every frame, above all where the
reading is large, and leaves tissue to be seen between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neeco.training.instruments.carving import CarvedShape, camera_from_instrument, center_line
from neeco.training.instruments.evidence import Evidence

ANGLES = 36  # hinge directions tried over half a turn
DEPTHS = 10  # pivots tried along the front half
GAINS = ((0.5, -0.5), (1.0, 0.0))  # part angle per reading: two jaws share the opening, or one takes it all
CAUTIOUS = 0.3  # a smaller turn, which rough evidence bears better
STICK_POINTS = 16


@dataclass(frozen=True)
class HingeGuess:
    """One hypothesis: angle rad around and depth mm along the carved shaft, gains of the two parts, and its score in
    [0, 1]."""

    angle: float
    depth: float
    gains: tuple[float, float]
    score: float  # mean evidence on the sticks, in [0, 1]
    opened: float  # what the turned sticks have more than still ones, times the share of the length they cover


def search_hinge(evidence: Evidence, name: str, joint: str, shape: CarvedShape) -> list[HingeGuess]:
    """All hypotheses on the grid, best first. Empty when the reading hardly varies (less than 0.05 rad)."""
    recorded = [frame.state.instruments[name].joints[joint] for frame in evidence.frames]
    readings = torch.tensor(recorded, dtype=torch.float32, device=evidence.device)
    opening = readings - readings.min()
    if float(opening.max()) < 0.05:
        return []
    closed = evidence.subset(torch.nonzero(readings <= readings.quantile(0.35))[:, 0])
    line = center_line(closed, name, shape)
    if len(line) < 2:
        line = shape.center_line
    camera_from_shaft = camera_from_instrument(evidence, name) @ shape.instrument_from_shaft  # [F, 4, 4]
    angles = torch.arange(ANGLES, device=evidence.device) * (math.pi / ANGLES)
    length = shape.tip - shape.near
    guesses = []
    for depth in np.linspace(shape.near + 0.4 * length, shape.tip - 0.15 * length, DEPTHS):
        stick = _stick(line, float(depth), shape.tip)
        needed = {gain for pair in GAINS for gain in pair} | {CAUTIOUS, -CAUTIOUS, 0.0}
        scores = {
            gain: _stick_scores(evidence, camera_from_shaft, stick, float(depth), angles, gain * opening, opening)
            for gain in sorted(needed)
        }
        share = (shape.tip - float(depth)) / length
        caution = (scores[CAUTIOUS] + scores[-CAUTIOUS]) / 2
        for gains in GAINS:
            evident = torch.maximum((scores[gains[0]] + scores[gains[1]]) / 2, caution)
            opened = ((scores[gains[0]] + scores[gains[1]]) / 2 - scores[0.0]) * share
            guesses += [
                HingeGuess(a, float(depth), gains, s, o)
                for a, s, o in zip(angles.tolist(), evident.tolist(), opened.tolist(), strict=True)
            ]
    return sorted(guesses, key=lambda guess: -guess.score)


def balanced_depth(guesses: list[HingeGuess]) -> float:
    """Pivot mm along the shaft: half way between the best by evidence on the sticks and the best by what they open.

    The first prefers pivots too far back (short turns stay on the body), the second pivots too far forward.
    """
    opened = max(guesses, key=lambda guess: guess.opened)
    return (guesses[0].depth + opened.depth) / 2


def dominant_angle(guesses: list[HingeGuess]) -> float:
    """Phase of the score's second harmonic over the hinge angle, rad in [0, pi): uses the whole landscape, not its peak
    alone."""
    best: dict[float, float] = {}
    for guess in guesses:
        best[guess.angle] = max(best.get(guess.angle, -1.0), guess.score)
    wave = sum(score * complex(math.cos(2 * angle), math.sin(2 * angle)) for angle, score in best.items())
    return (math.atan2(wave.imag, wave.real) / 2) % math.pi


def _stick(line: Tensor, depth: float, tip: float) -> Tensor:
    """[Q, 3] shaft-frame points of the centre line [Z, 3] from just beyond the pivot at `depth` to just before the
    tip."""
    known = line.cpu().numpy()
    along = np.linspace(depth + 0.15 * (tip - depth), tip - 0.1 * (tip - depth), STICK_POINTS)
    across = [np.interp(along, known[:, 0], known[:, k]) for k in (1, 2)]
    return torch.from_numpy(np.stack([*across, along], -1)).to(line)


def _stick_scores(
    evidence: Evidence,
    camera_from_shaft: Tensor,
    stick: Tensor,
    depth: float,
    angles: Tensor,
    turns: Tensor,
    weight: Tensor,
) -> Tensor:
    """[A] mean evidence on `stick` [Q, 3] for hinges at `angles` [A], turned by `turns` [F] rad, frames weighted by
    `weight` [F]."""
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
