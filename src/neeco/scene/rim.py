"""Tissue that no frame saw: continued smoothly from what lies beside it, and marked as made up.

A view that was never recorded looks past the rim of the recorded tissue. What stands there is nothing (black), or the
inner end of a Gaussian of which frames saw the outer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from neeco.raster.pinhole import in_image, pixel_centers, project_world, unproject_world
from neeco.raster.types import Camera
from neeco.scene.canonical import CanonicalGaussians, seed_gaussians

MADE_UP = "made_up"  # the per-Gaussian extra [N], 1 where it stands for tissue that no frame saw
CELL = 1 / 40  # of the image's width: the pattern of made-up Gaussians
REACH = 0.4  # of the image's width: how far beyond the recorded rim tissue is continued
FIELD = 1.5  # of the image's size, to each side of the middle camera's image: where rims are looked for
BEHIND = 1.1  # times the depth: what was seen stays before what is made up
SPREAD = 0.7  # of a cell: standard deviation of a made-up Gaussian
OPACITY = 0.98
WELL_SEEN = 0.05  # share of the frames that must see what tissue is continued from
SMOOTHING = (1.5, 3.0, 6.0, 12.0, 24.0)  # cells: tried in order until enough known ones are in reach
ENOUGH = 0.05  # share of known cells about one


def views_of(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """How many [P] of the cameras' images points [P, 3] mm of the world fall into, whatever stands before them."""
    count = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    for camera in cameras:
        count += in_image(points, camera)
    return count


def never_in_view(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """[P] bool: which points [P, 3] mm of the world fall into none of the cameras' images."""
    left = torch.arange(len(points), device=points.device)
    for camera in cameras:
        left = left[~in_image(points[left], camera)]
    never = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    never[left] = True
    return never


@torch.no_grad()
def continue_tissue(canonical: CanonicalGaussians, cameras: Sequence[Camera]) -> CanonicalGaussians:
    """Canonical Gaussians with tissue (body 0) continued by REACH beyond what `cameras` saw, in the mean depth and look
    of its neighbourhood; unchanged where nothing is left to continue."""
    field = _Field(_middle_camera(cameras))
    rows = canonical.body(0)
    means, look = canonical.means[rows], canonical.sh_dc[rows][:, 0]  # [T, 3] both
    cells, depths = field.cells(means)
    weights = torch.sigmoid(canonical.opacity_logits[rows]).double() * field.holds(cells)
    weights *= (depths > field.camera.near) & (views_of(means, cameras) >= WELL_SEEN * len(cameras))
    known = field.sums(cells, weights, torch.cat([1 / depths[:, None], look], 1).double())  # [rows, columns, 1 + 4]
    if not known[..., 0].any():
        return canonical
    grid = torch.from_numpy(_continued(known)).to(means)  # [rows, columns, 4] inverse depth, colour
    positions = field.positions(1 / grid[..., 0])  # [rows, columns, 3]
    unseen = never_in_view(positions.reshape(-1, 3), cameras).reshape(positions.shape[:2]).cpu()
    distance = distance_transform_edt(unseen.numpy()) * field.cell
    chosen = unseen & torch.from_numpy(distance < REACH * field.camera.width)
    return _with_tissue(canonical, _made_up(positions[chosen], grid[chosen][:, 1:], field))


@dataclass(frozen=True)
class _Field:
    """Cells of the middle camera's image, extended by FIELD to each side."""

    camera: Camera

    @property
    def cell(self) -> float:
        """Side of a cell, px."""
        return CELL * self.camera.width

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        extended = (1 + 2 * FIELD) / self.cell
        return round(extended * self.camera.height), round(extended * self.camera.width)

    def cells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(row, column) [P, 2] and depth [P] mm of points [P, 3] mm of the world; cells outside the field, too."""
        pixels, depths = project_world(points, self.camera)
        low = pixels.new_tensor([self.camera.width, self.camera.height]) * -FIELD
        return ((pixels - low) / self.cell).floor().flip(1), depths

    def holds(self, cells: Tensor) -> Tensor:
        """[P] bool: which of the cells [P, 2] lie in the field."""
        return ((cells >= 0) & (cells < cells.new_tensor(self.shape))).all(1)

    def sums(self, cells: Tensor, weights: Tensor, values: Tensor) -> np.ndarray:
        """[rows, columns, 1 + V] float64: per cell the sum of weights [P] and of weighted values [P, V]."""
        rows, columns = self.shape
        chosen = weights > 0
        index = (cells[chosen] @ cells.new_tensor([columns, 1.0])).long()
        weighted = weights[chosen, None] * torch.cat([torch.ones_like(values[:, :1]), values], 1)[chosen]
        total = weighted.new_zeros(rows * columns, weighted.shape[1]).index_add(0, index, weighted)
        return total.reshape(rows, columns, -1).cpu().numpy()

    def positions(self, depths: Tensor) -> Tensor:
        """Points [rows, columns, 3] mm of the world behind the cells' middles, at depths [rows, columns] mm."""
        camera = self.camera
        low = depths.new_tensor([camera.width, camera.height]) * -FIELD
        return unproject_world(pixel_centers(*self.shape).to(depths) * self.cell + low, BEHIND * depths, camera)


def _middle_camera(cameras: Sequence[Camera]) -> Camera:
    """The camera whose place and direction are nearest to the mean of all."""
    poses = torch.stack([camera.world_from_camera.double().cpu() for camera in cameras])  # [C, 4, 4]
    places, directions = poses[:, :3, 3], poses[:, :3, 2]
    spread = places.std(0, correction=0).norm().clamp_min(1e-6)
    turned = directions.std(0, correction=0).norm().clamp_min(1e-6)
    off = (places - places.mean(0)).norm(dim=1) / spread + (directions - directions.mean(0)).norm(dim=1) / turned
    return cameras[int(off.argmin())]


def _continued(known: np.ndarray) -> np.ndarray:
    """[rows, columns, V] means of the known cells about every cell, from sums [rows, columns, 1 + V]: over as small a
    neighbourhood as holds enough of them, then smoothed."""
    found = np.zeros((*known.shape[:2], known.shape[2] - 1))
    left = np.ones(known.shape[:2], dtype=bool)
    is_known = (known[..., 0] > 0).astype(float)
    for sigma in SMOOTHING:
        blurred = gaussian_filter(known, (sigma, sigma, 0), mode="constant")
        here = left & (gaussian_filter(is_known, sigma, mode="constant") > ENOUGH)
        found[here] = blurred[here][:, 1:] / blurred[here][:, :1]
        left &= ~here
    mean = known.sum((0, 1))
    found[left] = mean[1:] / mean[0]
    return gaussian_filter(found, (2.0, 2.0, 0), mode="nearest")


def _made_up(positions: Tensor, look: Tensor, field: _Field) -> CanonicalGaussians:
    """Gaussians at positions [M, 3] mm of degree-0 colour [M, 3], as wide as their cells."""
    depths = project_world(positions, field.camera)[1]
    made_up = seed_gaussians(positions, look, SPREAD * field.cell * depths / field.camera.fx, opacity=OPACITY)
    return replace(made_up, sh_dc=look[:, None].clone())


def _with_tissue(canonical: CanonicalGaussians, added: CanonicalGaussians) -> CanonicalGaussians:
    """`canonical` with `added` at the end of body 0, marked as made up."""
    marked = canonical.with_extras(**{MADE_UP: canonical.means.new_zeros(len(canonical))})
    blank = {name: tensor.new_zeros(len(added), *tensor.shape[1:]) for name, tensor in marked.extras.items()}
    added = added.with_extras(**(blank | {MADE_UP: added.means.new_ones(len(added))}))
    split, new = canonical.counts[0], added.tensors()
    joined = {n: torch.cat([tensor[:split], new[n], tensor[split:]]) for n, tensor in marked.tensors().items()}
    return CanonicalGaussians.from_tensors(joined, (split + len(added), *canonical.counts[1:]))
