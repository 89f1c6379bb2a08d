"""Density control (Kerbl et al. 2023): clone, split and prune, within a hard budget per body."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neeco.geometry.rotations import quat_to_matrix
from neeco.raster.devices import constant
from neeco.raster.optimizer import Adam
from neeco.scene.canonical import CanonicalGaussians
from neeco.training.config import DensityConfig


class GradientStatistics:
    """Mean norm of the projected centre's gradient per Gaussian (NDC units), over the images that show it."""

    def __init__(self, count: int, device: torch.device) -> None:
        self.total = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, device=device)

    def record(self, center_gradients: Tensor, width: int, height: int) -> None:
        """center_gradients [N, 2], d loss / d px."""
        norm = (center_gradients * constant((width / 2, height / 2), center_gradients.device)).norm(dim=1)
        self.total += norm
        self.seen += norm > 0

    def mean(self) -> Tensor:
        """Return the mean [N]."""
        return self.total / self.seen.clamp_min(1)


@torch.no_grad()
def control_density(
    canonical: CanonicalGaussians,
    adam: Adam,
    statistics: GradientStatistics,
    *,
    max_gaussians: Sequence[int],
    dense_size: float,
    threshold: float,
    generator: torch.Generator,
    config: DensityConfig,
    unsupported: Tensor | None = None,
) -> CanonicalGaussians:
    """Prune transparent and `unsupported` [N] bool Gaussians, clone small and split large ones whose gradient exceeds
    `threshold`, strongest first. Each body has at most its `max_gaussians`.

    Gaussians up to `dense_size` mm are cloned, larger ones split. `threshold` = inf only prunes. Adam's moments follow
    their rows; new rows start at zero.
    """
    gradients, bodies = statistics.mean(), canonical.bodies
    size = canonical.log_scales.max(1).values.exp()
    small = size <= size.new_tensor(dense_size)
    keep = torch.sigmoid(canonical.opacity_logits) > config.min_opacity
    if unsupported is not None:
        keep &= ~unsupported
    grow = keep & (gradients > threshold)
    for body, limit in enumerate(max_gaussians):
        rows = bodies == body
        room = max(0, limit - int((keep & rows).sum()))
        wanted = torch.nonzero(grow & rows)[:, 0]
        if len(wanted) > room:
            strongest = gradients[wanted].argsort(descending=True, stable=True)
            grow[wanted[strongest[room:]]] = False
    clone, split = grow & small, grow & ~small
    remaining, cloned, halves = (torch.nonzero(mask)[:, 0] for mask in (keep & ~split, clone, split))
    index = torch.cat([remaining, cloned, halves, halves])
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    fresh[len(remaining) :] = True
    is_half = torch.zeros_like(fresh)
    is_half[len(remaining) + len(cloned) :] = True
    order = bodies[index].argsort(stable=True)  # bodies stay contiguous
    index, fresh, is_half = index[order], fresh[order], is_half[order]
    counts = tuple(int((bodies[index] == body).sum()) for body in range(len(max_gaussians)))
    adam.select_rows(list(canonical.tensors()), index, fresh)
    changed = canonical.map(lambda tensor: tensor[index].contiguous(), counts)
    # halves are smaller, at random positions inside their parent
    rotation = quat_to_matrix(torch.nn.functional.normalize(changed.quats[is_half], dim=-1))
    scales = changed.log_scales[is_half].exp()
    offset = torch.randn(scales.shape, generator=generator, device=scales.device) * scales
    changed.means[is_half] += (rotation @ offset[..., None])[..., 0]
    changed.log_scales[is_half] -= math.log(config.split_shrink)
    return changed


@torch.no_grad()
def reset_opacity(canonical: CanonicalGaussians, adam: Adam, ceiling: float) -> None:
    """Clamp every opacity to `ceiling` and forget its momentum (3DGS)."""
    canonical.opacity_logits.clamp_(max=math.log(ceiling / (1 - ceiling)))
    adam.forget("opacity_logits")
