"""Tissue that moves as the patient breathes: a periodic displacement, smooth in space, that any method can add."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn

from neeco.geometry.camera import Camera
from neeco.scene.deformation import floored_decay

HARMONICS = 2  # breath is no pure sine: the pause after breathing out is longer
CONTROL_POINTS = 24
RATES = {"period": 5e-4, "swings": 2e-2}  # s and mm, Adam's at the start


class Breathing(nn.Module):
    """A displacement, mm, of tissue that rests at x: Fourier series in time at control points, between which weights w
    (normalised radial basis functions, of sum 1) interpolate,

        u(x, t) = sum_k w_k(x) sum_h (a_hk cos(2 pi h t / T) + b_hk sin(2 pi h t / T)).

    t is counted from the middle of the recording, where a change of the period moves least. At rest, its mean over a
    breath, u is zero. No gradient reaches the weights: they change slowly in space.
    """

    points: Tensor  # [K, 3] mm, world frame
    reach: Tensor  # [] mm, standard deviation of the basis functions
    origin: Tensor  # [] s, float64: when t is 0

    def __init__(self, count: int = CONTROL_POINTS) -> None:
        super().__init__()
        self.register_buffer("points", torch.zeros(count, 3))
        self.register_buffer("reach", torch.ones(()))
        self.register_buffer("origin", torch.zeros((), dtype=torch.float64))
        self.period = nn.Parameter(torch.ones(()))  # T, s
        self.swings = nn.Parameter(torch.zeros(2 * HARMONICS, count, 3))  # a_1, b_1, a_2, … in mm

    @classmethod
    def of(cls, tissue: Tensor, period: float, swing: Tensor, origin: float) -> Breathing:
        """One that moves all of the tissue, points [P, 3] mm, alike, by `swing` [2 HARMONICS, 3] mm (a_1, b_1, …)."""
        places, _ = kmeans2(
            tissue.detach().cpu().double().numpy(), min(CONTROL_POINTS, len(tissue)), minit="++", seed=0
        )
        made = cls(len(places))
        apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(len(places), np.inf))
        nearest = float(np.median(apart.min(1))) if len(places) > 1 else 1.0
        made.points.copy_(torch.from_numpy(places))
        made.reach.fill_(max(nearest, 1e-3))
        with torch.no_grad():
            made.origin.fill_(origin)
            made.period.fill_(period)
            made.swings.copy_(swing[:, None].expand_as(made.swings))
        return made.to(tissue.device)

    def forward(self, means: Tensor, time: float) -> Tensor:
        """u [N, 3] mm at `means` [N, 3] mm, where tissue rests, at `time` in s."""
        with torch.no_grad():
            weights = torch.softmax(-0.5 * torch.cdist(means, self.points).square() / self.reach**2, 1)
        breaths = ((time - self.origin) / self.period).to(self.period)
        return weights @ torch.einsum("w,wkd->kd", _waves(breaths), self.swings)

    @torch.no_grad()
    def describe(self, cameras: Sequence[Camera]) -> dict[str, float]:
        """The period, and how far the control point that moves most is from rest at most; where all the cameras that
        recorded it stood in one place, only across the view from there: motion along it does not show."""
        shares = torch.linspace(0, 1, 33).to(self.swings)
        moved = torch.stack([torch.einsum("w,wkd->kd", _waves(share), self.swings) for share in shares])  # [33, K, 3]
        centres = torch.stack([camera.world_from_camera[:3, 3] for camera in cameras]).to(self.points)
        name, along = "amplitude_mm", torch.zeros_like(self.points)
        if bool((centres == centres[0]).all()):
            name, along = "amplitude_across_mm", nn.functional.normalize(self.points - centres[0], dim=1)
        across = moved - (moved * along).sum(-1, keepdim=True) * along
        return {"period_s": round(float(self.period), 3), name: round(float(across.norm(dim=-1).max()), 2)}


def _waves(breaths: Tensor) -> Tensor:
    """[2 HARMONICS] cosine and sine of the fundamental after so many breaths [], then of every harmonic."""
    angles = 2 * math.pi * breaths * torch.arange(1, HARMONICS + 1, device=breaths.device)
    return torch.stack([angles.cos(), angles.sin()], 1).flatten()


class BreathingTissue(nn.Module):
    """Mixed into a deformation whose tissue may breathe; without a `breathing` the tissue keeps still, and nothing of
    it is stored."""

    breathing: Breathing | None
    may_breathe: bool = False  # whether training looks for it

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.breathing = None

    def breathed(self, means: Tensor, tissue: int, time: float) -> Tensor:
        """`means` [N, 3] mm, of which the first `tissue` rows have moved to where they are at `time`."""
        if self.breathing is None:
            return means
        moved = means[:tissue] + self.breathing(means[:tissue].detach(), time)
        return torch.cat([moved, means[tissue:]])

    def start_breathing(self, breathing: Breathing) -> None:
        """Let the tissue move like a copy of `breathing`."""
        self.breathing = copy.deepcopy(breathing)

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Those of the breathing alone; a deformation with more parameters has a method of its own."""
        return {name: RATES[name.rsplit(".", 1)[-1]] * floored_decay(progress) for name, _ in self.named_parameters()}

    def _load_from_state_dict(self, state_dict: Mapping[str, Tensor], prefix: str, *others: Any) -> None:
        """Make the breathing that is stored, which is loaded then."""
        places, period = (state_dict.get(f"{prefix}breathing.{name}") for name in ("points", "period"))
        if places is not None and period is not None and self.breathing is None:
            if not (period > 0).all():
                raise ValueError(f"the tissue breathes with a period of {period} s")
            self.breathing = Breathing(len(places))
        super()._load_from_state_dict(state_dict, prefix, *others)
