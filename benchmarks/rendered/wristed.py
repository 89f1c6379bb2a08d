"""Instruments of more joints than jaws: a wrist as robots carry, a clevis that pitches at the shaft's end and two jaws
that yaw on it; and a working end that slides out of the shaft.

Mechanical frame as `rendered.instrument` has it, the wrist straight: the pitch axis along y at (0, 0, `pitch_at`), the
yaw axis along x at (0, 0, `hinge`). Pitch and yaw are right-handed turns about those axes; extension is along z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from rendered.instrument import WRIST, Design, rounded
from rendered.motion import Array, Bend


@dataclass(frozen=True)
class WristedDesign(Design):
    """Geometry of the clevis: a ball in the shaft's end, then a block that narrows to two prongs."""

    wrist_joints: ClassVar[tuple[str, ...]] = ("wrist_pitch", "wrist_yaw")

    pitch_at: float = 1.5  # mm from the end of the shaft
    ball: float = 3.5  # radius

    @property
    def reach(self) -> float:
        """As `Design` has it, from where the hinge is while the wrist is straight, however far it pitches."""
        return super().reach + 2 * (self.hinge - self.pitch_at)

    def balls(self, bend: Bend) -> tuple[Tensor, Tensor]:
        """Centres [K, 3] and radii [K] of balls that together hold wrist and jaws."""
        end = self.hinge + self.prong_half_y
        middle = torch.zeros(5, 3)
        middle[:, 2] = torch.linspace(0.0, end, 5)
        centers, radii = self._jaw_balls(bend)
        wrist = torch.full((5,), end / 8 + self.wrist_radius + 1.5)
        return self._about_pitch(torch.cat([middle, centers]), bend.pitch), torch.cat([wrist, radii])

    def tips(self, bend: Bend) -> Tensor:
        """Middles [2, 3] of the ends of both jaws, mechanical frame."""
        return self._about_pitch(super().tips(bend), bend.pitch)

    def jaw_angles(self, bend: Bend) -> tuple[float, float]:
        """rad about +x by which the jaws stand from the clevis."""
        first, second = self.shares
        return bend.yaw - first * bend.opening, bend.yaw + second * bend.opening

    def distances(self, points: Tensor, bend: Bend) -> Tensor:
        """Lower bounds [M, 3] mm of the distances of points [M, 3] to wrist, first jaw and second jaw."""
        return super().distances(self._about_pitch(points, -bend.pitch), bend)

    def _wrist(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        across = (x.square() + y.square()).sqrt()
        ball = (points - torch.tensor([0.0, 0.0, self.pitch_at])).norm(dim=-1) - self.ball
        start, end = self.pitch_at, self.pitch_at + self.collar
        neck = rounded(
            torch.stack([across - self.wrist_radius, (z - (start + end) / 2).abs() - (end - start) / 2], -1), 0.3
        )
        return torch.minimum(torch.minimum(ball, neck), self._prongs(points, end - 1.0))

    def on_link(self, bend: Bend, points: Tensor, parts: Tensor) -> Tensor:
        """Points [M, 3] on the given parts [M] as they lie with the wrist straight and the jaws closed, from the
        hinge."""
        straight = torch.where((parts >= WRIST)[:, None], self._about_pitch(points, -bend.pitch), points)
        return super().turn_to_link(bend, straight - torch.tensor([0.0, 0.0, self.hinge]), parts)

    def turn_to_link(self, bend: Bend, vectors: Tensor, parts: Tensor, sense: int = 1) -> Tensor:
        """Vectors [M, 3] as they are with the wrist straight and the jaws closed; sense -1: the other way round."""
        moves = (parts >= WRIST)[:, None]
        if sense < 0:
            turned = super().turn_to_link(bend, vectors, parts, sense)
            return torch.where(moves, _turn_y(turned, bend.pitch), vectors)
        return super().turn_to_link(bend, torch.where(moves, _turn_y(vectors, -bend.pitch), vectors), parts)

    def _about_pitch(self, points: Tensor, angle: float) -> Tensor:
        center = torch.tensor([0.0, 0.0, self.pitch_at])
        return _turn_y(points - center, angle) + center


@dataclass(frozen=True)
class Encoders:
    """What the encoders of a wrist's joints say: the angle (rad) plus an offset, play that lags behind
    the motion, and noise."""

    offsets: tuple[float, float]
    play: float  # half of it, either way
    noise: float

    def readings(self, values: Array, generator: np.random.Generator) -> Array:
        """Readings [F, J] of values [F, J], in the order of the frames."""
        found = []
        for column, offset in zip(values.T, self.offsets, strict=True):
            lag = self.play * np.tanh(np.gradient(column) / max(1e-6, float(np.abs(np.gradient(column)).mean())))
            found.append(column + offset - lag + generator.normal(0, self.noise, len(column)))
        return np.stack(found, 1)


def _turn_y(points: Tensor, angle: float) -> Tensor:
    """Points [M, 3] turned about y by `angle` rad."""
    cosine, sine = torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle))
    x, y, z = points.unbind(-1)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], -1)
