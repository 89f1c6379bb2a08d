"""The canonical Gaussians: learned parameters before any deformation poses them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neeco.raster.reference import SH_C0

SH_COEFFICIENTS = 16  # degree 3


@dataclass(frozen=True)
class CanonicalGaussians:
    """Raw (unactivated) parameters, ordered by body: tissue first, then instrument 1, 2, ...

    `extras` holds the per-Gaussian parameters that a deformation adds ([N, ...] each), which density control carries
    along.
    """

    means: Tensor  # [N, 3] mm; tissue in the world frame, an instrument in the frame of its deformation
    quats: Tensor  # [N, 4] wxyz, any length
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh_dc: Tensor  # [N, 1, 3]
    sh_rest: Tensor  # [N, 15, 3]
    _: KW_ONLY
    counts: tuple[int, ...]  # Gaussians per body; sums to N
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    _joined: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)  # see spherical_harmonics

    def __len__(self) -> int:
        return self.means.shape[0]

    def body(self, index: int) -> slice:
        """Return the rows of one body."""
        start = sum(self.counts[:index])
        return slice(start, start + self.counts[index])

    @cached_property
    def bodies(self) -> Tensor:
        """Body [N] int64 of each row; do not modify."""
        like = self.means
        rows = [like.new_full((count,), body, dtype=torch.int64) for body, count in enumerate(self.counts)]
        return torch.cat(rows)  # filled on the device: copying the counts would synchronise

    @cached_property
    def of_instruments(self) -> Tensor:
        """Rows of any instrument, [N] bool; do not modify."""
        return self.bodies > 0

    def tensors(self) -> dict[str, Tensor]:
        """Return every learned tensor by name; extras as `extras.NAME`."""
        named = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("counts", "extras", "_joined")}
        return named | {f"extras.{name}": tensor for name, tensor in self.extras.items()}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], counts: tuple[int, ...]) -> CanonicalGaussians:
        """Return the Gaussians of `tensors`."""
        plain = {name: tensor for name, tensor in tensors.items() if not name.startswith("extras.")}
        extras = {
            name.removeprefix("extras."): tensor for name, tensor in tensors.items() if name.startswith("extras.")
        }
        return CanonicalGaussians(**plain, counts=counts, extras=extras)

    def map(self, function: Callable[[Tensor], Tensor], counts: tuple[int, ...] | None = None) -> CanonicalGaussians:
        """Return the Gaussians with `function` applied to every learned tensor."""
        mapped = {name: function(tensor) for name, tensor in self.tensors().items()}
        return CanonicalGaussians.from_tensors(mapped, self.counts if counts is None else counts)

    def with_extras(self, **extras: Tensor) -> CanonicalGaussians:
        """Return the Gaussians with further per-Gaussian parameters."""
        return replace(self, extras={**self.extras, **extras})

    def spherical_harmonics(self, degree: int) -> Tensor:
        """Return the harmonics [N, (degree + 1)^2, 3]; do not modify. Cached without gradients."""
        if degree == 0:
            return self.sh_dc
        parts = self.sh_dc, self.sh_rest
        if any(part.requires_grad for part in parts):
            return self._join(degree)
        versions = [degree, *(part._version for part in parts)]
        if not self._joined or self._joined[0] != versions:
            self._joined[:] = versions, self._join(degree)
        return self._joined[1]

    def _join(self, degree: int) -> Tensor:
        return torch.cat([self.sh_dc, self.sh_rest[:, : (degree + 1) ** 2 - 1]], 1)


def seed_gaussians(positions: Tensor, colors: Tensor, spacing: Tensor, *, opacity: float = 0.1) -> CanonicalGaussians:
    """Return isotropic Gaussians of one body at `positions` [N, 3] mm with `colors` [N, 3] and standard deviation
    `spacing` [N] mm (3DGS)."""
    count = positions.shape[0]
    return CanonicalGaussians(
        means=positions.float().clone(),
        quats=positions.new_tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float32).repeat(count, 1),
        log_scales=spacing.float().clamp_min(1e-4).log()[:, None].repeat(1, 3),
        opacity_logits=positions.new_full((count,), math.log(opacity / (1 - opacity)), dtype=torch.float32),
        sh_dc=((colors.float() - 0.5) / SH_C0)[:, None, :].clone(),
        sh_rest=positions.new_zeros(count, SH_COEFFICIENTS - 1, 3, dtype=torch.float32),
        counts=(count,),
    )


def seed_instrument(points: Tensor, radius: float) -> CanonicalGaussians:
    """Return grey Gaussians of one body at `points` [P, 3] mm on an instrument whose shaft has this `radius`, mm."""
    count = len(points)
    return seed_gaussians(points, points.new_full((count, 3), 0.4), points.new_full((count,), 0.4 * radius))


def neighbour_spacing(positions: np.ndarray) -> Tensor:
    """Return the mean distance [N] mm to the three nearest neighbours, the initial size of 3DGS, at most the 99th
    percentile."""
    if len(positions) < 4:
        return torch.full((len(positions),), 1.0)
    distance, _ = cKDTree(positions).query(positions, k=4, workers=1)
    spacing = np.sqrt((distance[:, 1:] ** 2).mean(1))
    return torch.from_numpy(np.clip(spacing, 1e-4, np.percentile(spacing, 99))).float()


def join_bodies(bodies: list[CanonicalGaussians]) -> CanonicalGaussians:
    """Join single bodies, in order. All must have the same extras."""
    tensors = {name: torch.cat([body.tensors()[name] for body in bodies]) for name in bodies[0].tensors()}
    return CanonicalGaussians.from_tensors(tensors, tuple(len(body) for body in bodies))
