"""Planes over pairs of place and time (Wu et al. 2024, "4D Gaussian Splatting"), method `4dgs`.

Six planes, xy xz yz and xt yt zt, in several resolutions of space (64, 128, ...) and one of time. A Gaussian's features
are, in each resolution, the product of what it meets in the six, and all resolutions side by side; a small network with
a head for each attribute makes (d_mu, d_r, d_s) of them, added before activation. L1 alone is the image loss; planes
are kept smooth in space and time, and those with time near 1, where they change nothing.

Departures from the source:
- The static stage (3,000 of 17,000 iterations) and the fall of the learning rates (1.6e-3 to 1.6e-4 for planes, a tenth
  of both for the network) are shares of the run, which is shorter here.
- The heads end in zeros, so that the end of the warm-up changes nothing. The source starts them at random.
- The planes span a cube around the sparse points, a fifth wider than their longest side: instruments move in front of
  the tissue, where no points lie. The source takes the box of the points. The unit of d_mu is the points' half extent.
- `rate_scale`, 5 as in Deformable-3DGS, replaces the source's factor, the spread of its cameras (4 to 5 for D-NeRF).
- Time runs over its whole axis, from the first to the last training frame.
- 16 channels, the smaller of the source's settings, for speed on a CPU.
- With the dynamic training adjustment, the compensation is added to the rows of the planes xt yt zt at the state's
  time, one normal number per plane and channel.
- The number of Gaussians is limited (`max_tissue_gaussians`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, State
from neeco.methods.networks import RecordedTimes, check_warm_up, robust_bounds
from neeco.raster.devices import tf32_products
from neeco.raster.types import Rendering
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, LabelledByMotion, Perturbation, Posed, log_linear
from neeco.scene.method import PLAIN_TRAINING

MARGIN = 1.2  # side of the planes' cube relative to the longest side of the points' bounding box


@dataclass(frozen=True, kw_only=True)
class HexPlaneSettings:
    """Settings of the method."""

    channels: int = 16  # feature channels per plane and resolution
    resolution: int = 64  # lowest spatial resolution
    levels: int = 2  # number of spatial resolutions, each twice the previous
    time_resolution: int = 25  # temporal resolution
    width: int = 64  # width of the network
    warm_up: float = 3 / 17  # share of the run before the deformation starts
    rate_scale: float = 5.0  # factor on the learning rates
    space_smoothness: float = 1e-4  # weight in the loss
    time_smoothness: float = 1e-2  # weight in the loss
    time_l1: float = 1e-4  # weight in the loss

    def __post_init__(self) -> None:
        for name, least in (("resolution", 3), ("time_resolution", 3), ("levels", 1)):
            if getattr(self, name) < least:
                raise NeecoError(f"deformation.{name}: {getattr(self, name)} is too small; give at least {least}")
        check_warm_up(self.warm_up)


class HexPlane(LabelledByMotion):
    """Six planes in several resolutions, a trunk and a head for each of mean, rotation and scale."""

    method = "4dgs"
    Settings = HexPlaneSettings
    training_defaults: ClassVar[Mapping[str, Any]] = {**PLAIN_TRAINING, "ssim_weight": 0.0}
    needs_times = True
    large_operations = True

    center: Tensor
    half_extent: Tensor

    def __init__(self, instruments: tuple[Instrument, ...], settings: HexPlaneSettings | None = None) -> None:
        super().__init__(instruments, settings)
        sizes: HexPlaneSettings = self.settings
        channels, steps, width = sizes.channels, sizes.time_resolution, sizes.width
        self.warm_up = sizes.warm_up
        self.times = RecordedTimes()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("half_extent", torch.ones(()))
        sides = [sizes.resolution * 2**level for level in range(sizes.levels)]
        self.space = nn.ParameterList(torch.empty(3, channels, side, side).uniform_(0.1, 0.5) for side in sides)
        self.time = nn.ParameterList(torch.ones(3, channels, steps, side) for side in sides)
        self.trunk = nn.Linear(channels * sizes.levels, width)
        self.heads = nn.ModuleList(_head(width, size) for size in (3, 4, 3))
        nn.init.xavier_uniform_(self.trunk.weight)

    def fit_ranges(self, states: list[State], means: Tensor) -> None:
        """Normalise time to [0, 1] over the recording, and set the cube around the points [P, 3]."""
        self.times.fit(states)
        self.center, self.half_extent = robust_bounds(means)

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        if self.warming_up:
            return Posed(canonical.means, canonical.quats, canonical.log_scales.exp())
        positions = (canonical.means - self.center) / (MARGIN * self.half_extent)
        rows = self.rows_at(self.times.share(state), perturbation.state_noise)
        features = self.features(positions, rows)
        with tf32_products(positions.device):
            hidden = self.trunk(features)
            d_means, d_quats, d_scales = (head(hidden) for head in self.heads)
        scales = (canonical.log_scales + d_scales).exp()
        return Posed(canonical.means + self.half_extent * d_means, canonical.quats + d_quats, scales)

    def rows_at(self, time: Tensor, noise: float = 0.0) -> list[Tensor]:
        """Return the planes xt, yt, zt at `time`, a scalar in [0, 1]: [3, C, side] per resolution. `noise`: standard
        deviation of the compensation."""
        rows = []
        for plane in self.time:
            last = plane.shape[2] - 1
            place = time.to(plane.dtype).clamp(0, 1) * last
            below = place.detach().long().clamp(max=last - 1)  # stays a tensor: no waiting for a GPU
            lower, upper = plane.index_select(2, torch.stack([below, below + 1])).unbind(2)
            row = torch.lerp(lower, upper, place - below)
            rows.append(row + noise * torch.randn(*row.shape[:2], 1, device=row.device) if noise > 0 else row)
        return rows

    def features(self, positions: Tensor, rows: list[Tensor]) -> Tensor:
        """Return features [N, levels * C] of positions [N, 3] in [-1, 1] (clamped) and the time's `rows`."""
        pairs = torch.stack([positions[:, [0, 1]], positions[:, [0, 2]], positions[:, [1, 2]]])[:, None]  # [3, 1, N, 2]
        across = positions.T[:, None, :, None]
        lines = torch.cat([across, torch.zeros_like(across)], -1)  # [3, 1, N, 2]
        products = []
        for plane, row in zip(self.space, rows, strict=True):
            space, time = _sample(plane, pairs), _sample(row[:, :, None], lines)  # [3, C, N]
            products.append(space[0] * space[1] * space[2] * time[0] * time[1] * time[2])
        return torch.cat(products).T

    def regularisation(self, canonical: CanonicalGaussians, rendering: Rendering, iteration: int) -> Tensor:
        """Return squared second differences in space and time, and the distance of the temporal planes from 1."""
        weights: HexPlaneSettings = self.settings
        total = canonical.means.new_zeros(())
        for space, time in zip(self.space, self.time, strict=True):
            smooth, steady = _curvature(space), _curvature(time)
            near_one = 3 * (1 - time).abs().mean()
            total = (
                total
                + weights.space_smoothness * smooth
                + weights.time_smoothness * steady
                + weights.time_l1 * near_one
            )
        return total

    def learning_rates(self, progress: float) -> dict[str, float]:
        network = self.settings.rate_scale * log_linear(1.6e-4, 1.6e-5, progress)
        planes = 10 * network
        return {
            name: planes if name.startswith(("space.", "time.")) else network for name, _ in self.named_parameters()
        }


def _head(width: int, size: int) -> nn.Sequential:
    """Return two layers from [N, width] to [N, size], the last one initialised to zero."""
    inner, last = nn.Linear(width, width), nn.Linear(width, size)
    nn.init.xavier_uniform_(inner.weight)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.ReLU(), inner, nn.ReLU(), last)


def _sample(planes: Tensor, positions: Tensor) -> Tensor:
    """Sample planes [3, C, H, W] bilinearly at positions [3, 1, N, 2] (along W, along H; -1 and 1 at the outer
    centres): [3, C, N]."""
    return nn.functional.grid_sample(planes, positions, align_corners=True, padding_mode="border")[:, :, 0]


def _curvature(planes: Tensor) -> Tensor:
    """Return the mean squared second difference of planes [3, C, H, W] along H, summed over the three."""
    return 3 * planes.diff(n=2, dim=2).square().mean()
