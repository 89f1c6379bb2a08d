"""Breathing tissue: a periodic displacement, smooth in space, and the estimate of its period from training frames."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pad

from neeco.capture.images import area_averaged
from neeco.geometry.camera import Camera
from neeco.raster import rasterize
from neeco.scene.deformation import floored_decay
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_views import TrainingViews


@dataclass(frozen=True, kw_only=True)
class BreathingSettings:
    """Settings of the search for breathing."""

    n_harmonics: int = 2  # number of harmonics; the pause after exhalation makes breathing deviate from a sine
    n_control_points: int = 24  # of the tissue's motion
    max_frames: int = 240  # frames in which displacements are measured, at most
    n_pixels: int = 96 * 77  # pixels of the images used for measuring; the motion is one or two px at this size
    robust_scale: float = 0.04  # fraction of white; larger residuals (instruments, highlights) get little weight
    n_reweightings: int = 4  # iterations of the robust fit
    periods_s: tuple[float, float] = (1.5, 10.0)  # search range of the breathing period
    min_breaths: float = 2.0  # minimum number of breaths in the recording
    oversampling: int = 8  # candidate periods per independent frequency
    n_folds: int = 4  # contiguous time intervals for cross-validation
    min_explained: float = 0.5  # minimum share of variance explained on held-out intervals
    min_amplitude: float = 0.2  # mm, RMS over time; smaller motion causes no visible blur


BREATHING = BreathingSettings()

RATES = {"period": 5e-4, "swings": 2e-2}  # s and mm, Adam's at the start


class Breathing(nn.Module):
    """Displacement, mm, of tissue at rest position x: Fourier series in time at control points, interpolated by
    normalised radial basis functions w,

        u(x, t) = sum_k w_k(x) sum_h (a_hk cos(2 pi h t / T) + b_hk sin(2 pi h t / T)).

    t is 0 in the middle of the recording. u averages to zero over one breath. No gradient reaches the weights.
    """

    points: Tensor  # [K, 3] mm, world frame
    reach: Tensor  # [] mm, standard deviation of the basis functions
    origin: Tensor  # [] s, float64: when t is 0

    def __init__(self, count: int = BREATHING.n_control_points) -> None:
        super().__init__()
        self.register_buffer("points", torch.zeros(count, 3))
        self.register_buffer("reach", torch.ones(()))
        self.register_buffer("origin", torch.zeros((), dtype=torch.float64))
        self.period = nn.Parameter(torch.ones(()))  # T, s
        self.swings = nn.Parameter(torch.zeros(2 * BREATHING.n_harmonics, count, 3))  # a_1, b_1, a_2, … in mm

    @classmethod
    def of(cls, tissue: Tensor, period: float, swing: Tensor, origin: float) -> Breathing:
        """Return a breathing motion of the tissue, points [P, 3] mm, that starts with `swing` [2 `n_harmonics`, 3] mm
        (a_1, b_1, …) everywhere."""
        from scipy.cluster.vq import kmeans2  # slow to import

        places, _ = kmeans2(
            tissue.detach().cpu().double().numpy(), min(BREATHING.n_control_points, len(tissue)), minit="++", seed=0
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
        """Return u [N, 3] mm at resting positions `means` [N, 3] mm, at `time` in s."""
        with torch.no_grad():
            weights = torch.softmax(-0.5 * torch.cdist(means, self.points).square() / self.reach**2, 1)
        breaths = ((time - self.origin) / self.period).to(self.period)
        return weights @ torch.einsum("w,wkd->kd", _waves(breaths), self.swings)

    @torch.no_grad()
    def describe(self, cameras: Sequence[Camera]) -> dict[str, float]:
        """Return the period and the largest amplitude over control points; if all cameras share one position, only the
        component across the line of sight, as motion along it is not observable."""
        shares = torch.linspace(0, 1, 33).to(self.swings)
        moved = torch.stack([torch.einsum("w,wkd->kd", _waves(share), self.swings) for share in shares])  # [33, K, 3]
        centres = torch.stack([camera.world_from_camera[:3, 3] for camera in cameras]).to(self.points)
        name, along = "amplitude_mm", torch.zeros_like(self.points)
        if bool((centres == centres[0]).all()):
            name, along = "amplitude_across_mm", nn.functional.normalize(self.points - centres[0], dim=1)
        across = moved - (moved * along).sum(-1, keepdim=True) * along
        return {"period_s": round(float(self.period), 3), name: round(float(across.norm(dim=-1).max()), 2)}


def _waves(breaths: Tensor) -> Tensor:
    """Return cosine and sine [2 `n_harmonics`] of every harmonic after `breaths` [] periods."""
    angles = 2 * math.pi * breaths * torch.arange(1, BREATHING.n_harmonics + 1, device=breaths.device)
    return torch.stack([angles.cos(), angles.sin()], 1).flatten()


class BreathingTissue(nn.Module):
    """Mixin of deformations whose tissue may breathe. Without a `breathing` module the tissue is static."""

    breathing: Breathing | None
    may_breathe: bool = False  # whether training searches for breathing

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.breathing = None

    def breathed(self, means: Tensor, tissue: int, time: float) -> Tensor:
        """Return `means` [N, 3] mm with the first `tissue` rows displaced to `time`."""
        if self.breathing is None:
            return means
        moved = means[:tissue] + self.breathing(means[:tissue].detach(), time)
        return torch.cat([moved, means[tissue:]])

    def start_breathing(self, breathing: Breathing) -> None:
        """Start the tissue's motion from a copy of `breathing`."""
        self.breathing = copy.deepcopy(breathing)

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Return the rates of the breathing alone; a deformation with more parameters overrides this."""
        return {name: RATES[name.rsplit(".", 1)[-1]] * floored_decay(progress) for name, _ in self.named_parameters()}

    def _load_from_state_dict(self, state_dict: Mapping[str, Tensor], prefix: str, *others: Any) -> None:
        """Create the stored breathing, whose parameters are then loaded."""
        places, period = (state_dict.get(f"{prefix}breathing.{name}") for name in ("points", "period"))
        if places is not None and period is not None and self.breathing is None:
            if not (period > 0).all():
                raise ValueError(f"the tissue breathes with a period of {period} s")
            self.breathing = Breathing(len(places))
        super()._load_from_state_dict(state_dict, prefix, *others)


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """Estimated period, s; Fourier series [2 `n_harmonics`, 3] mm of the displacement, from its time `origin` on (see
    `Breathing`); and the share of variance explained on held-out times."""

    period: float
    swing: Array
    origin: float
    explained: float


def find_period(times: Array, shifts: Array) -> Found | None:
    """Return the period of displacements `shifts` [F, 3] mm at `times` [F] s (unsorted, irregular); None where no
    period predicts them."""
    duration = float(np.ptp(times)) if len(times) else 0.0
    longest = min(BREATHING.periods_s[1], duration / BREATHING.min_breaths)
    if len(times) < 8 * BREATHING.n_folds or longest <= BREATHING.periods_s[0]:
        return None
    origin = float(times.min() + times.max()) / 2
    times, shifts = times - origin, shifts - shifts.mean(0)
    frequencies = np.arange(1 / longest, 1 / BREATHING.periods_s[0], 1 / (BREATHING.oversampling * duration))
    best = max(frequencies, key=lambda frequency: _explained(times, shifts, frequency, 1))
    near = best + np.linspace(-1, 1, 2 * BREATHING.oversampling + 1) / (BREATHING.oversampling * duration)
    best = max(near, key=lambda frequency: _explained(times, shifts, frequency, BREATHING.n_harmonics))
    explained = _explained(times, shifts, best, BREATHING.n_harmonics)
    design = _design(times, best, BREATHING.n_harmonics)
    swing: Array = np.linalg.lstsq(design, shifts, rcond=None)[0][1:].astype(np.float64)
    amplitude = float(np.sqrt((design[:, 1:] @ swing).var(0).sum()))
    if explained < BREATHING.min_explained or amplitude < BREATHING.min_amplitude:
        return None
    return Found(float(1 / best), swing, origin, explained)


def _design(times: Array, frequency: float, harmonics: int) -> Array:
    """Return the design matrix [F, 1 + 2 harmonics]: a constant, then cosine and sine of every harmonic."""
    angles = 2 * np.pi * frequency * times[:, None] * np.arange(1, harmonics + 1)
    return np.column_stack(
        [np.ones(len(times)), np.stack([np.cos(angles), np.sin(angles)], -1).reshape(len(times), -1)]
    )


def _explained(times: Array, shifts: Array, frequency: float, harmonics: int) -> float:
    """Return the share of variance explained on each interval by a fit to the others (cross-validation)."""
    design = _design(times, frequency, harmonics)
    fold = np.minimum(BREATHING.n_folds * (times - times.min()) / np.ptp(times), BREATHING.n_folds - 1).astype(int)
    error = 0.0
    for left_out in range(BREATHING.n_folds):
        in_fold = fold == left_out
        fitted = np.linalg.lstsq(design[~in_fold], shifts[~in_fold], rcond=1e-6)[0]
        error += float(((shifts[in_fold] - design[in_fold] @ fitted) ** 2).sum())
    return 1 - error / max(float((shifts**2).sum()), 1e-12)


@torch.no_grad()
def find_breathing(tissue: GaussianScene, views: TrainingViews) -> tuple[Breathing, Found] | None:
    """Estimate the breathing from one global displacement of the tissue per frame; None without a period. `tissue`: a
    static scene of the tissue alone, learned from these views."""
    picked = range(0, len(views), max(1, -(-len(views) // BREATHING.max_frames)))
    times = np.array([views.frames[index].state.time for index in picked], np.float64)
    if np.ptp(times) < BREATHING.min_breaths * BREATHING.periods_s[0]:
        return None
    shifts = torch.stack([tissue_shift(tissue, views, index) for index in picked])
    periodic_motion = find_period(times, shifts.double().cpu().numpy())
    if periodic_motion is None:
        return None
    swing = torch.from_numpy(periodic_motion.swing).to(tissue.canonical.means)
    return Breathing.of(tissue.canonical.means, periodic_motion.period, swing, periodic_motion.origin), periodic_motion


def tissue_shift(tissue: GaussianScene, views: TrainingViews, index: int) -> Tensor:
    """Return the displacement [3] mm, world frame, of the whole tissue that best explains frame `index` to first order,
    jointly with a gain per colour channel; outlier pixels are down-weighted."""
    frame, target, mask = views.frames[index], views.target(index), views.mask(index)
    camera = frame.camera.within(BREATHING.n_pixels)
    width, height = camera.width, camera.height
    rendering = rasterize(tissue.at(frame.state), camera)
    target, color = area_averaged(target, width, height), rendering.color
    counts = (rendering.alpha > 0.5) & (rendering.depth > 0)
    if mask is not None:
        counts &= area_averaged(mask[..., None].float(), width, height)[..., 0] > 0.99
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (columns.to(color) - camera.cx) / camera.fx, (rows.to(color) - camera.cy) / camera.fy
    across, down = _slopes((color + target) / 2)  # [H, W, 3] per px
    along = -(across * camera.fx * x[..., None] + down * camera.fy * y[..., None])
    # of the colours, by a displacement in the camera's frame: the image moves against its slope
    jacobian = -torch.stack([across * camera.fx, down * camera.fy, along], -1) / rendering.depth[..., None, None]
    gains = color[..., None] * torch.eye(3, device=color.device, dtype=color.dtype)  # [H, W, 3, 3]
    design, residual = torch.cat([jacobian, gains], -1)[counts], (target - color)[counts]  # [P, 3, 6], [P, 3]
    fitted = design.new_zeros(6)
    if not len(design):
        return fitted[:3]
    for _ in range(BREATHING.n_reweightings):
        unexplained = (residual - design @ fitted).square().mean(-1, keepdim=True)
        weight = (1 + unexplained / BREATHING.robust_scale**2) ** -2  # Geman and McClure
        weighted = (design * weight[..., None]).reshape(-1, 6)
        flat = design.reshape(-1, 6)
        normal = weighted.T @ flat
        normal = normal + torch.diag(1e-4 * normal.diagonal() + 1e-9)
        fitted = torch.linalg.solve(normal, weighted.T @ residual.reshape(-1))
    rotation = frame.camera.world_from_camera[:3, :3].to(fitted)
    return rotation @ fitted[:3]


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the central differences of `image` [H, W, C] per px to the right and downwards; 0 at the border."""
    planes = image.permute(2, 0, 1)
    across = pad((planes[:, :, 2:] - planes[:, :, :-2]) / 2, (1, 1))
    down = pad((planes[:, 2:] - planes[:, :-2]) / 2, (0, 0, 1, 1))
    return across.permute(1, 2, 0), down.permute(1, 2, 0)
