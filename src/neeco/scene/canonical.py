"""The canonical Gaussians: what is learned, before any deformation poses it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neeco.raster.reference import SH_C0

SH_COEFFICIENTS = 16  # degree 3
TISSUE = "tissue"  # extra [N]: which of several tissues, counted from 0, a Gaussian of body 0 is of


@dataclass(frozen=True)
class CanonicalGaussians:
    """Raw (unactivated) parameters, ordered by body: tissue first, then instrument 1, 2, ...

    `extras` holds whatever per-Gaussian parameters a deformation adds ([N, ...] each); density control carries them
    along.
    """

    means: Tensor  # [N, 3] mm; tissue in the world frame, an instrument in the frame its deformation says
    quats: Tensor  # [N, 4] wxyz, any length
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh_dc: Tensor  # [N, 1, 3]
    sh_rest: Tensor  # [N, 15, 3]
    counts: tuple[int, ...]  # Gaussians per body; sums to N
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    _joined: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)  # see spherical_harmonics

    def __len__(self) -> int:
        return self.means.shape[0]

    def body(self, index: int) -> slice:
        """Rows of one body."""
        start = sum(self.counts[:index])
        return slice(start, start + self.counts[index])

    @cached_property
    def bodies(self) -> Tensor:
        """[N] int64, the body of each row; not to be changed."""
        like = self.means
        rows = [like.new_full((count,), body, dtype=torch.int64) for body, count in enumerate(self.counts)]
        return torch.cat(rows)  # filled there: a copy of the counts would wait for the device

    @cached_property
    def of_instruments(self) -> Tensor:
        """[N] bool, rows of any instrument; not to be changed."""
        return self.bodies > 0

    def of_tissue(self, index: int) -> Tensor:
        """[N] bool, rows of one of several tissues; of the tissue, where there is one."""
        tissue = self.bodies == 0
        return tissue & (self.extras[TISSUE] == index) if TISSUE in self.extras else tissue

    def tensors(self) -> dict[str, Tensor]:
        """Every learned tensor by name; extras as `extras.NAME`."""
        named = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("counts", "extras", "_joined")}
        return named | {f"extras.{name}": tensor for name, tensor in self.extras.items()}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], counts: tuple[int, ...]) -> CanonicalGaussians:
        """The inverse of `tensors`."""
        plain = {name: tensor for name, tensor in tensors.items() if not name.startswith("extras.")}
        extras = {
            name.removeprefix("extras."): tensor for name, tensor in tensors.items() if name.startswith("extras.")
        }
        return CanonicalGaussians(**plain, counts=counts, extras=extras)

    def map(self, function: Callable[[Tensor], Tensor], counts: tuple[int, ...] | None = None) -> CanonicalGaussians:
        """Apply `function` to every learned tensor."""
        mapped = {name: function(tensor) for name, tensor in self.tensors().items()}
        return CanonicalGaussians.from_tensors(mapped, self.counts if counts is None else counts)

    def with_extras(self, **extras: Tensor) -> CanonicalGaussians:
        """The same Gaussians with further per-Gaussian parameters."""
        return replace(self, extras={**self.extras, **extras})

    def spherical_harmonics(self, degree: int) -> Tensor:
        """[N, (degree + 1)^2, 3]; not to be changed. What nothing is learned of is joined once, for all drawings."""
        if degree == 0:
            return self.sh_dc
        parts = self.sh_dc, self.sh_rest
        if any(part.requires_grad for part in parts):
            return self._join(degree)
        made_of = [degree, *(part._version for part in parts)]
        if not self._joined or self._joined[0] != made_of:
            self._joined[:] = made_of, self._join(degree)
        return self._joined[1]

    def _join(self, degree: int) -> Tensor:
        return torch.cat([self.sh_dc, self.sh_rest[:, : (degree + 1) ** 2 - 1]], 1)


def seed_gaussians(positions: Tensor, colors: Tensor, spacing: Tensor, *, opacity: float = 0.1) -> CanonicalGaussians:
    """Round Gaussians of one body at `positions` [N, 3] mm with `colors` [N, 3] and standard deviation `spacing` [N] mm
    (3DGS)."""
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
    """Grey Gaussians of one body at `points` [P, 3] mm on an instrument whose shaft has this `radius`, mm."""
    count = len(points)
    return seed_gaussians(points, points.new_full((count, 3), 0.4), points.new_full((count,), 0.4 * radius))


def neighbour_spacing(positions: np.ndarray) -> Tensor:
    """Mean distance to the three nearest neighbours [N] mm, the initial size of 3DGS; at most the 99th percentile."""
    if len(positions) < 4:
        return torch.full((len(positions),), 1.0)
    distance, _ = cKDTree(positions).query(positions, k=4, workers=1)
    spacing = np.sqrt((distance[:, 1:] ** 2).mean(1))
    return torch.from_numpy(np.clip(spacing, 1e-4, np.percentile(spacing, 99))).float()


def join_bodies(bodies: list[CanonicalGaussians]) -> CanonicalGaussians:
    """One set out of several single bodies, in order. All must carry the same extras; `TISSUE` only the first."""
    if TISSUE in bodies[0].extras:
        bodies = [bodies[0], *(body.with_extras(**{TISSUE: body.means.new_zeros(len(body))}) for body in bodies[1:])]
    tensors = {name: torch.cat([body.tensors()[name] for body in bodies]) for name in bodies[0].tensors()}
    return CanonicalGaussians.from_tensors(tensors, tuple(len(body) for body in bodies))
