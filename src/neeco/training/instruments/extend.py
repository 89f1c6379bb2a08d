"""Prolong a shaft beyond what the training images showed of it.

The camera sees a shaft only up to the image's border; in a new state more of it comes into view. A shaft is the same
all along, so the rearmost well-seen slab is repeated towards the rear.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neeco.raster.pinhole import in_image
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import Recorded
from neeco.scene.instruments import Hinges

WELL_SEEN = 0.08  # share of training frames that must see a position of the shaft for it to be copied
ENDS_IN_VIEW = 0.3  # share above which the instrument's rear end is taken for real
SLAB_RADII = 1.5  # length of the repeated slab, in shaft radii


@torch.no_grad()
def extend_shaft(
    canonical: CanonicalGaussians, body: int, name: str, hinges: Hinges, recorded: Recorded, length: float
) -> CanonicalGaussians:
    """Canonical Gaussians with instrument `body` (row group index) prolonged by about `length` mm; unchanged when its
    end is real."""
    rows = canonical.body(body)
    along = hinges.along_shaft(canonical.means[rows])  # [M]
    solid = torch.sigmoid(canonical.opacity_logits[rows]) > 0.3
    if not hinges.joint_names or int(solid.sum()) < 50:
        return canonical
    rear, front = float(along[solid].quantile(0.01)), float(hinges.wrist_start)
    if not rear < front:
        return canonical
    device = canonical.means.device
    positions = torch.linspace(rear, front, 40, device=device)
    seen = shaft_coverage(positions, name, hinges, recorded)
    if float(seen[0]) > ENDS_IN_VIEW or not bool((seen >= WELL_SEEN).any()):
        return canonical
    start = float(positions[seen >= WELL_SEEN][0])
    slab = SLAB_RADII * _radius(canonical, rows, hinges, solid)
    copied = torch.nonzero((along >= start) & (along < start + slab))[:, 0]
    if start + slab > front or len(copied) < 10:
        return canonical
    kept = torch.nonzero(along >= start)[:, 0]
    repeats = math.ceil(length / slab)
    index = torch.cat([kept, copied.repeat(repeats)]) + rows.start
    shift = torch.zeros(len(index), device=device)
    shift[len(kept) :] = -slab * torch.arange(1, repeats + 1, device=device).repeat_interleave(len(copied)).float()
    whole = torch.arange(len(canonical), device=device)
    whole = torch.cat([whole[: rows.start], index, whole[rows.stop :]])
    counts = list(canonical.counts)
    counts[body] = len(index)
    extended = canonical.map(lambda tensor: tensor[whole].contiguous(), tuple(counts))
    _, direction = hinges.shaft()
    extended.means[extended.body(body)] += shift[:, None] * direction
    return extended


def shaft_coverage(positions: Tensor, name: str, hinges: Hinges, recorded: Recorded) -> Tensor:
    """Share [Q] of the training frames whose image holds the shaft's axis at `positions` [Q] mm."""
    origin, direction = hinges.shaft()
    points = origin + positions[:, None] * direction  # [Q, 3]
    counts = torch.zeros_like(positions)
    for state, camera in zip(recorded.states, recorded.cameras, strict=True):
        pose = state.instruments[name].pose.to(points)
        counts += in_image(points @ pose[:3, :3].T + pose[:3, 3], camera)
    return counts / max(1, len(recorded.states))


def _radius(canonical: CanonicalGaussians, rows: slice, hinges: Hinges, solid: Tensor) -> float:
    """Median distance mm of solid Gaussians behind the wrist from the axis."""
    origin, direction = hinges.shaft()
    arm = canonical.means[rows][solid] - origin
    across = arm - (arm @ direction)[:, None] * direction
    behind = (arm @ direction) < hinges.wrist_start
    return float((across[behind] if bool(behind.any()) else across).norm(dim=1).median())
