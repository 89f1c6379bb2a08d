"""The period with which the tissue moves, found from how far every frame is off a tissue that was learned as still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from neeco.capture.images import area_averaged
from neeco.methods.breathing import HARMONICS, Breathing
from neeco.raster import rasterize
from neeco.scene.gaussian_scene import GaussianScene
from neeco.scene.training_views import TrainingViews

FRAMES = 240  # at most, that displacements are measured in
PIXELS = 96 * 77  # of the images that they are measured in: the motion is a pixel or two there
ROBUST = 0.04  # of white: residuals beyond count little (instruments, highlights)
ROUNDS = 4  # of reweighting
PERIODS = (1.5, 10.0)  # s, of breath
MIN_BREATHS = 2.0  # in the recording, so that the second confirms the first
OVERSAMPLING = 8  # periods tried per independent frequency
FOLDS = 4  # stretches of time, each of which is predicted from the others
MIN_EXPLAINED = 0.5  # share of the displacement's variance in stretches that were left out
MIN_AMPLITUDE = 0.2  # mm, rms over time: less does not blur

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """A period, s, the Fourier series [2 HARMONICS, 3] mm of the displacement from its time `origin` on (see
    `Breathing`), and the share of the displacement's variance that it predicts in times that it was not fitted to."""

    period: float
    swing: Array
    origin: float
    explained: float


def find_period(times: Array, shifts: Array) -> Found | None:
    """The period of displacements `shifts` [F, 3] mm at `times` [F] s, in any order and at any intervals; None where
    none predicts clearly."""
    duration = float(np.ptp(times)) if len(times) else 0.0
    longest = min(PERIODS[1], duration / MIN_BREATHS)
    if len(times) < 8 * FOLDS or longest <= PERIODS[0]:
        return None
    origin = float(times.min() + times.max()) / 2
    times, shifts = times - origin, shifts - shifts.mean(0)
    frequencies = np.arange(1 / longest, 1 / PERIODS[0], 1 / (OVERSAMPLING * duration))
    best = max(frequencies, key=lambda frequency: _explained(times, shifts, frequency, 1))
    near = best + np.linspace(-1, 1, 2 * OVERSAMPLING + 1) / (OVERSAMPLING * duration)
    best = max(near, key=lambda frequency: _explained(times, shifts, frequency, HARMONICS))
    explained = _explained(times, shifts, best, HARMONICS)
    design = _design(times, best, HARMONICS)
    swing: Array = np.linalg.lstsq(design, shifts, rcond=None)[0][1:].astype(np.float64)
    amplitude = float(np.sqrt((design[:, 1:] @ swing).var(0).sum()))
    if explained < MIN_EXPLAINED or amplitude < MIN_AMPLITUDE:
        return None
    return Found(float(1 / best), swing, origin, explained)


def _design(times: Array, frequency: float, harmonics: int) -> Array:
    """[F, 1 + 2 harmonics]: a constant, then cosine and sine of every harmonic."""
    angles = 2 * np.pi * frequency * times[:, None] * np.arange(1, harmonics + 1)
    return np.column_stack(
        [np.ones(len(times)), np.stack([np.cos(angles), np.sin(angles)], -1).reshape(len(times), -1)]
    )


def _explained(times: Array, shifts: Array, frequency: float, harmonics: int) -> float:
    """Share of the variance that a fit to the other stretches of time predicts of each."""
    design = _design(times, frequency, harmonics)
    fold = np.minimum(FOLDS * (times - times.min()) / np.ptp(times), FOLDS - 1).astype(int)
    error = 0.0
    for left_out in range(FOLDS):
        held = fold == left_out
        fitted = np.linalg.lstsq(design[~held], shifts[~held], rcond=1e-6)[0]
        error += float(((shifts[held] - design[held] @ fitted) ** 2).sum())
    return 1 - error / max(float((shifts**2).sum()), 1e-12)


@torch.no_grad()
def find_breathing(tissue: GaussianScene, views: TrainingViews) -> tuple[Breathing, Found] | None:
    """How the tissue breathes, as far as one displacement of all of it tells, or None; `tissue`: a scene of still
    tissue alone, learned from these views."""
    picked = range(0, len(views), max(1, -(-len(views) // FRAMES)))
    times = np.array([views.frames[index].state.time for index in picked], np.float64)
    if np.ptp(times) < MIN_BREATHS * PERIODS[0]:
        return None
    shifts = torch.stack([tissue_shift(tissue, views, index) for index in picked])
    found = find_period(times, shifts.double().cpu().numpy())
    if found is None:
        return None
    swing = torch.from_numpy(found.swing).to(tissue.canonical.means)
    return Breathing.of(tissue.canonical.means, found.period, swing, found.origin), found


def tissue_shift(tissue: GaussianScene, views: TrainingViews, index: int) -> Tensor:
    """[3] mm, world frame: the displacement of all the tissue that best explains frame `index`, to first order, beside
    a change of each colour's gain; pixels that neither explains count little."""
    frame, target, mask = views.frames[index], views.target(index), views.mask(index)
    camera = frame.camera.within(PIXELS)
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
    for _ in range(ROUNDS):
        left = (residual - design @ fitted).square().mean(-1, keepdim=True)
        weight = (1 + left / ROBUST**2) ** -2  # Geman and McClure
        weighted = (design * weight[..., None]).reshape(-1, 6)
        flat = design.reshape(-1, 6)
        normal = weighted.T @ flat
        normal = normal + torch.diag(1e-4 * normal.diagonal() + 1e-9)
        fitted = torch.linalg.solve(normal, weighted.T @ residual.reshape(-1))
    rotation = frame.camera.world_from_camera[:3, :3].to(fitted)
    return rotation @ fitted[:3]


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    """Change of `image` [H, W, C] per px to the right and downwards, by central differences; 0 at the border."""
    planes = image.permute(2, 0, 1)
    across = pad((planes[:, :, 2:] - planes[:, :, :-2]) / 2, (1, 1))
    down = pad((planes[:, 2:] - planes[:, :-2]) / 2, (0, 0, 1, 1))
    return across.permute(1, 2, 0), down.permute(1, 2, 0)
