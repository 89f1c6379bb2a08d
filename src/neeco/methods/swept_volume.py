"""The volume that instruments sweep, outside which the paper's network need not be evaluated."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from neeco.errors import NeecoError
from neeco.methods.space_carving import carve, moves_with_pose
from neeco.methods.tissue_fit import tissue_evidence
from neeco.raster.devices import CachedPredicate
from neeco.training.session import GaussianSession

N_CELLS = 64  # per side of a swept volume
MIN_SHARE_INSIDE = 0.01  # of the Gaussians in a bounded volume: with fewer the network cannot form an instrument


class SweptVolume(nn.Module):
    """All of space until `cover` is called, then the volume within `margin_mm` of its points."""

    low: Tensor  # [3] mm, world frame: corner of the grid
    cell: Tensor  # [3] mm; 0 while nothing is covered
    occupied: Tensor  # [N_CELLS, N_CELLS, N_CELLS] bool

    def __init__(self, margin_mm: float) -> None:
        super().__init__()
        self.margin_mm = margin_mm
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("cell", torch.zeros(3))
        self.register_buffer("occupied", torch.zeros(N_CELLS, N_CELLS, N_CELLS, dtype=torch.bool))
        self._covered = CachedPredicate(lambda cell: cell.any())

    @property
    def bounded(self) -> bool:
        """Whether `cover` was called."""
        return self._covered(self.cell)

    def cover(self, points: Tensor) -> None:
        """Set the volume to the cells whose centre lies within the margin of a cell that contains one of `points` [P,
        3] mm."""
        margin = self.margin_mm
        low = points.min(0).values - margin
        size = (points.max(0).values + margin - low).clamp_min(1e-3)
        self.low.copy_(low)
        self.cell.copy_(size / N_CELLS)
        index = ((points - self.low) / self.cell).long().clamp(0, N_CELLS - 1)
        holds = np.zeros((N_CELLS,) * 3, bool)
        holds[tuple(index.T.cpu().numpy())] = True
        distance = distance_transform_edt(~holds, sampling=self.cell.tolist())
        self.occupied.copy_(torch.from_numpy(distance <= margin))

    def contains(self, points: Tensor) -> Tensor:
        """[N] bool for points [N, 3] mm, world frame."""
        if not self.bounded:
            return torch.ones(len(points), dtype=torch.bool, device=points.device)
        index = ((points - self.low) / self.cell).floor().long()
        inside = ((index >= 0) & (index < N_CELLS)).all(1)
        x, y, z = index.clamp(0, N_CELLS - 1).unbind(1)
        return inside & self.occupied[x, y, z]


def bound_volume(session: GaussianSession, volume: SweptVolume) -> None:
    """Bound `volume`, outside which the paper's network is not evaluated, by what the carved instruments sweep in the
    training frames.

    Where carving cannot be trusted the volume stays unbounded: slow, but never wrong. Raises NeecoError when hardly any
    Gaussian lies inside: the network moves tissue onto the instrument, so the volume has to reach the tissue.
    """
    scene, views, report = session.scene, session.views, session.report
    report("searching for the instruments, to bound where the network is evaluated")
    evidence = tissue_evidence(scene, views, session.config)
    generator = torch.Generator().manual_seed(session.config.seed)
    shapes = []
    for instrument in scene.instruments:
        shape = carve(evidence, instrument.name, generator, session.config.deformation.carving)
        if shape is None or not moves_with_pose(session, evidence, instrument.name, shape):
            report(f"warning: {instrument.name}: its shape cannot be carved; the network is evaluated everywhere")
            return
        shapes.append(shape)
    swept = []
    for instrument, shape in zip(scene.instruments, shapes, strict=True):
        recorded = [frame.state.instruments[instrument.name].pose.float() for frame in views.frames]
        poses = torch.stack(recorded).to(shape.seeds)  # [F, 4, 4]
        swept.append((shape.seeds @ poses[:, :3, :3].transpose(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3))
    volume.cover(torch.cat(swept).to(scene.canonical.means))
    inside = volume.contains(scene.canonical.means)
    if int(inside.sum()) < MIN_SHARE_INSIDE * len(inside):
        raise NeecoError(
            f"deformation.gate_mm: only {int(inside.sum())} of {len(inside)} Gaussians lie within {volume.margin_mm} "
            "mm of the instruments' path; give a greater distance"
        )
    report(f"the network is evaluated on {int(inside.sum())} of {len(inside)} Gaussians")
