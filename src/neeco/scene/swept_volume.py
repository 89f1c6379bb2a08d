"""The volume that instruments sweep, outside which the paper's network need not be evaluated."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from neeco.raster.devices import CachedPredicate

CELLS = 64  # per side of a swept volume


class SweptVolume(nn.Module):
    """All of space until `cover` is called, then what lies within `margin_mm` of the points given to it.

    Its buffers are saved with its owner.
    """

    low: Tensor  # [3] mm, world frame: corner of the grid
    cell: Tensor  # [3] mm; 0 while nothing is covered
    occupied: Tensor  # [CELLS, CELLS, CELLS] bool

    def __init__(self, margin_mm: float) -> None:
        super().__init__()
        self.margin_mm = margin_mm
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("cell", torch.zeros(3))
        self.register_buffer("occupied", torch.zeros(CELLS, CELLS, CELLS, dtype=torch.bool))
        self._covered = CachedPredicate(lambda cell: cell.any())

    @property
    def bounded(self) -> bool:
        """Has a volume been covered?"""
        return self._covered(self.cell)

    def cover(self, points: Tensor) -> None:
        """Make it the cells whose centre lies within the margin of a cell that holds one of `points` [P, 3] mm."""
        margin = self.margin_mm
        low = points.min(0).values - margin
        size = (points.max(0).values + margin - low).clamp_min(1e-3)
        self.low.copy_(low)
        self.cell.copy_(size / CELLS)
        index = ((points - self.low) / self.cell).long().clamp(0, CELLS - 1)
        holds = np.zeros((CELLS,) * 3, bool)
        holds[tuple(index.T.cpu().numpy())] = True
        distance = distance_transform_edt(~holds, sampling=self.cell.tolist())
        self.occupied.copy_(torch.from_numpy(distance <= margin))

    def contains(self, points: Tensor) -> Tensor:
        """[N] bool for points [N, 3] mm, world frame."""
        if not self.bounded:
            return torch.ones(len(points), dtype=torch.bool, device=points.device)
        index = ((points - self.low) / self.cell).floor().long()
        inside = ((index >= 0) & (index < CELLS)).all(1)
        x, y, z = index.clamp(0, CELLS - 1).unbind(1)
        return inside & self.occupied[x, y, z]
