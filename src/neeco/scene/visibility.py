"""Which Gaussians the training frames observed, from where, and tissue extrapolated beyond what they observed.

A frame observes a Gaussian by as many pixels as its alpha and the transmittance before it leave of it. That is summed
over the frames, separately for twelve directions in the frame that the Gaussian's colours turn with. A view that was
never recorded also looks past the border of the recorded tissue: there, tissue is extrapolated smoothly from what lies
beside it, and marked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor
from torch.nn.functional import normalize

from neeco.capture.model import REFERENCE_PIXELS, State, evenly_spaced
from neeco.geometry.camera import Camera
from neeco.geometry.projection import in_image, pixel_centers, project_world, unproject_world
from neeco.geometry.rotations import quat_to_matrix
from neeco.raster import rasterize
from neeco.raster.devices import constant
from neeco.raster.types import Gaussians
from neeco.scene.canonical import TISSUE, CanonicalGaussians, seed_gaussians
from neeco.scene.drawable import Recorded

# per-Gaussian extras, under the names they have in files
VISIBILITY = "seen"  # [N, 12], what `measure_visibility` finds
EXTRAPOLATED = "made_up"  # [N], 1 where the Gaussian stands for tissue that no frame observed

GOLDEN = (1 + 5**0.5) / 2
DIRECTIONS = tuple(  # the corners of an icosahedron, unit
    tuple(value / (1 + GOLDEN**2) ** 0.5 for value in corner)
    for a in (-1.0, 1.0)
    for b in (-GOLDEN, GOLDEN)
    for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
)
SHARPNESS = 4  # power of the cosine by which a view counts for a direction: half at 33 degrees
HALF_OBSERVED = 0.002  # share of the average Gaussian's visibility at which one is half unobserved
MIN_PIXELS = 1e-6  # visibility of the average Gaussian where frames show nothing
MAX_FRAMES = 128  # frames looked at, evenly spaced and reduced to REFERENCE_PIXELS; neighbours observe the same

CELL = 1 / 40  # of the image's width: spacing of extrapolated Gaussians
REACH = 0.4  # of the image's width: how far tissue is extrapolated beyond the recorded border
EXTENT = 1.5  # of the image's size, to each side of the middle camera's image: where tissue is extrapolated
BEHIND = 1.1  # times the depth: what was observed stays in front
SPREAD = 0.7  # of a cell: standard deviation of an extrapolated Gaussian
OPACITY = 0.98  # of an extrapolated Gaussian
WELL_OBSERVED = 0.05  # share of the frames that must observe what tissue is extrapolated from
SMOOTHING = (1.5, 3.0, 6.0, 12.0, 24.0)  # cells: tried in order until MIN_KNOWN cells are in reach
MIN_KNOWN = 0.05  # share of known cells around one


def measure_visibility(canonical: CanonicalGaussians, recorded: Recorded, at: Callable[[State], Gaussians]) -> Tensor:
    """[N, 12] how many pixels the recorded frames observed of each Gaussian, as `at` poses it, from about each of
    `DIRECTIONS`; as a share of what they observed of the average one. Zero for extrapolated tissue."""
    pixels = canonical.means.new_zeros((), dtype=torch.float64)
    visibility = canonical.means.new_zeros(len(canonical), len(DIRECTIONS))
    for index in evenly_spaced(len(recorded.cameras), MAX_FRAMES):
        camera = recorded.cameras[index].within(REFERENCE_PIXELS)
        with torch.no_grad():
            posed = at(recorded.states[index])
            toward = _toward(posed, camera)
        observed = visible_pixels(posed, camera)
        pixels += observed.sum()
        visibility += observed[:, None] * toward
    visibility = visibility / max(float(pixels) / len(visibility), MIN_PIXELS)
    if EXTRAPOLATED in canonical.extras:  # its border reaches into recorded images
        visibility *= 1 - canonical.extras[EXTRAPOLATED][:, None]
    return visibility


def unobserved_share(visibility: Tensor, posed: Gaussians, camera: Camera) -> Tensor:
    """[N] in [0, 1]: how far each posed Gaussian, as `camera` sees it, is unobserved, from what `measure_visibility`
    found: 1 where no frame saw it from about there."""
    toward = _toward(posed, camera)
    share = (visibility * toward).sum(1) / toward.sum(1)
    return HALF_OBSERVED / (share + HALF_OBSERVED)


def _toward(posed: Gaussians, camera: Camera) -> Tensor:
    """[N, 12] in [0, 1] how near the direction from each Gaussian to the camera is to each of `DIRECTIONS`."""
    means = posed.means
    outward = normalize(camera.world_from_camera[:3, 3].to(means) - means, dim=1)  # [N, 3]
    if posed.sh_frames is not None:
        outward = torch.einsum("nji,nj->ni", quat_to_matrix(posed.sh_frames), outward)
    directions = constant(tuple(value for corner in DIRECTIONS for value in corner), outward.device).view(-1, 3)
    return (outward @ directions.T).clamp_min(0) ** SHARPNESS


def visible_pixels(posed: Gaussians, camera: Camera, weight: Tensor | None = None) -> Tensor:
    """[N] how many of the camera's pixels, of `weight` [H, W] each, every posed Gaussian takes up: the gradient of a
    drawn channel of 1."""
    channel = torch.ones_like(posed.opacities)[:, None].requires_grad_()
    with torch.enable_grad():
        unlit = replace(posed, sh=posed.sh[:, :1], headlight=None)
        composited = rasterize(unlit, camera, channels=channel).channels
        assert composited is not None
        seen = composited.sum() if weight is None else (composited[..., 0] * weight).sum()
        (pixels,) = torch.autograd.grad(seen, channel)
    return pixels[:, 0]


def count_views(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """How many [P] of the cameras' images points [P, 3] mm of the world fall into, whatever stands before them."""
    count = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    for camera in cameras:
        count += in_image(points, camera)
    return count


def outside_all_views(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """[P] bool: which points [P, 3] mm of the world fall into none of the cameras' images."""
    left = torch.arange(len(points), device=points.device)
    for camera in cameras:
        left = left[~in_image(points[left], camera)]
    outside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    outside[left] = True
    return outside


@torch.no_grad()
def extrapolate_tissue(canonical: CanonicalGaussians, cameras: Sequence[Camera], tissue: int = 0) -> CanonicalGaussians:
    """Canonical Gaussians with tissue (body 0; of several the one so numbered, which `cameras` saw) extrapolated by
    REACH beyond what `cameras` observed, in the mean depth and colour of its neighbourhood; unchanged where no observed
    tissue is in reach."""
    grid = _Grid(_middle_camera(cameras))
    rows = canonical.body(0)
    means, colors = canonical.means[rows], canonical.sh_dc[rows][:, 0]  # [T, 3] both
    cells, depths = grid.cells(means)
    weights = torch.sigmoid(canonical.opacity_logits[rows]).double() * grid.holds(cells)
    weights *= canonical.of_tissue(tissue)[rows]
    weights *= (depths > grid.camera.near) & (count_views(means, cameras) >= WELL_OBSERVED * len(cameras))
    known = grid.sums(cells, weights, torch.cat([1 / depths[:, None], colors], 1).double())  # [rows, columns, 1 + 4]
    if not known[..., 0].any():
        return canonical
    filled = torch.from_numpy(_filled(known)).to(means)  # [rows, columns, 4] inverse depth, colour
    positions = grid.positions(1 / filled[..., 0])  # [rows, columns, 3]
    outside = outside_all_views(positions.reshape(-1, 3), cameras).reshape(positions.shape[:2]).cpu()
    distance = distance_transform_edt(outside.numpy()) * grid.cell
    chosen = outside & torch.from_numpy(distance < REACH * grid.camera.width)
    points, colors = positions[chosen], filled[chosen][:, 1:]
    added = seed_gaussians(points, colors, grid.spacing(points), opacity=OPACITY)
    return _append_tissue(canonical, replace(added, sh_dc=colors[:, None].clone()), tissue)


@dataclass(frozen=True)
class _Grid:
    """Cells of the middle camera's image, extended by EXTENT to each side."""

    camera: Camera

    @property
    def cell(self) -> float:
        """Side of a cell, px."""
        return CELL * self.camera.width

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        extended = (1 + 2 * EXTENT) / self.cell
        return round(extended * self.camera.height), round(extended * self.camera.width)

    def _corner(self, like: Tensor) -> Tensor:
        return like.new_tensor([self.camera.width, self.camera.height]) * -EXTENT

    def cells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(row, column) [P, 2] and depth [P] mm of points [P, 3] mm of the world; also cells outside the grid."""
        pixels, depths = project_world(points, self.camera)
        return ((pixels - self._corner(pixels)) / self.cell).floor().flip(1), depths

    def holds(self, cells: Tensor) -> Tensor:
        """[P] bool: which of the cells [P, 2] lie in the grid."""
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
        """Points [rows, columns, 3] mm of the world behind the cells' centres, at depths [rows, columns] mm."""
        pixels = pixel_centers(*self.shape).to(depths) * self.cell + self._corner(depths)
        return unproject_world(pixels, BEHIND * depths, self.camera)

    def spacing(self, points: Tensor) -> Tensor:
        """Standard deviation [P] mm of Gaussians at points [P, 3] mm of the world that fill their cells."""
        return SPREAD * self.cell * project_world(points, self.camera)[1] / self.camera.fx


def _middle_camera(cameras: Sequence[Camera]) -> Camera:
    """The camera whose place and direction are nearest to the mean of all."""
    poses = torch.stack([camera.world_from_camera.double().cpu() for camera in cameras])  # [C, 4, 4]
    places, directions = poses[:, :3, 3], poses[:, :3, 2]
    spread = places.std(0, correction=0).norm().clamp_min(1e-6)
    turned = directions.std(0, correction=0).norm().clamp_min(1e-6)
    deviation = (places - places.mean(0)).norm(dim=1) / spread + (directions - directions.mean(0)).norm(dim=1) / turned
    return cameras[int(deviation.argmin())]


def _filled(known: np.ndarray) -> np.ndarray:
    """[rows, columns, V] means of the known cells around every cell, from sums [rows, columns, 1 + V]: over the
    smallest neighbourhood that holds enough of them, then smoothed."""
    found = np.zeros((*known.shape[:2], known.shape[2] - 1))
    left = np.ones(known.shape[:2], dtype=bool)
    is_known = (known[..., 0] > 0).astype(float)
    for sigma in SMOOTHING:
        blurred = gaussian_filter(known, (sigma, sigma, 0), mode="constant")
        here = left & (gaussian_filter(is_known, sigma, mode="constant") > MIN_KNOWN)
        found[here] = blurred[here][:, 1:] / blurred[here][:, :1]
        left &= ~here
    mean = known.sum((0, 1))
    found[left] = mean[1:] / mean[0]
    return gaussian_filter(found, (2.0, 2.0, 0), mode="nearest")


def _append_tissue(canonical: CanonicalGaussians, added: CanonicalGaussians, tissue: int) -> CanonicalGaussians:
    """`canonical` with `added` at the end of body 0, marked as extrapolated, and as of that tissue of several."""
    unmarked = canonical.means.new_zeros(len(canonical))
    marked = canonical.with_extras(**{EXTRAPOLATED: canonical.extras.get(EXTRAPOLATED, unmarked)})
    blank = {name: tensor.new_zeros(len(added), *tensor.shape[1:]) for name, tensor in marked.extras.items()}
    if TISSUE in blank:
        blank[TISSUE] += tissue
    added = added.with_extras(**(blank | {EXTRAPOLATED: added.means.new_ones(len(added))}))
    split, new = canonical.counts[0], added.tensors()
    joined = {n: torch.cat([tensor[:split], new[n], tensor[split:]]) for n, tensor in marked.tensors().items()}
    return CanonicalGaussians.from_tensors(joined, (split + len(added), *canonical.counts[1:]))
