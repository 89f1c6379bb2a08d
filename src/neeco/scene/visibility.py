"""Visibility of Gaussians in the training frames, by direction, and extrapolation of tissue beyond the observed border.

A frame observes a Gaussian by the pixels that its alpha and the transmittance in front of it leave of it. They are
summed over the frames, separately for twelve directions in the frame of the Gaussian's harmonics. An unrecorded view
also shows the area beyond the recorded tissue: there, tissue is extrapolated smoothly from its neighbourhood, and
marked.
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
from neeco.raster.native import all_run_native, native
from neeco.raster.types import Gaussians
from neeco.scene.canonical import CanonicalGaussians, seed_gaussians
from neeco.scene.drawable import Recorded

# per-Gaussian extras, under the names they have in files
VISIBILITY = "seen"  # [N, 12], by `measure_visibility`
EXTRAPOLATED = "made_up"  # [N], 1 where the Gaussian is extrapolated tissue

GOLDEN_RATIO = (1 + 5**0.5) / 2
DIRECTIONS = tuple(  # the corners of an icosahedron, unit
    tuple(value / (1 + GOLDEN_RATIO**2) ** 0.5 for value in corner)
    for a in (-1.0, 1.0)
    for b in (-GOLDEN_RATIO, GOLDEN_RATIO)
    for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
)


@dataclass(frozen=True, kw_only=True)
class VisibilitySettings:
    """Thresholds of observation, and settings of extrapolated tissue."""

    sharpness: int = 4  # power of the cosine that weights a view for a direction: half at 33 degrees
    half_visibility: float = 0.002  # share of the mean visibility at which a Gaussian is half unobserved
    min_pixels: float = 1e-6  # minimum of the mean visibility
    max_frames: int = 128  # evenly spaced, reduced to REFERENCE_PIXELS; adjacent frames observe the same
    # extrapolation
    cell: float = 1 / 40  # spacing of extrapolated Gaussians, in image widths
    max_distance: float = 0.4  # from the observed border, in image widths
    grid_margin: float = 1.5  # margin on each side of the middle camera's image, relative to its size
    depth_factor: float = 1.1  # factor on extrapolated depths, so that observed tissue stays in front
    cell_sd: float = 0.7  # standard deviation of an extrapolated Gaussian, in cells
    opacity: float = 0.98  # of an extrapolated Gaussian
    min_frame_share: float = 0.05  # minimum share of frames that observe the source tissue
    # standard deviations, tried until `min_known_share` is reached
    smoothing_cells: tuple[float, ...] = (1.5, 3.0, 6.0, 12.0, 24.0)
    min_known_share: float = 0.05  # minimum share of known cells in a neighbourhood


SETTINGS = VisibilitySettings()


def measure_visibility(canonical: CanonicalGaussians, recorded: Recorded, at: Callable[[State], Gaussians]) -> Tensor:
    """Return the pixels [N, 12] by which the recorded frames observed each Gaussian, posed by `at`, from each of
    `DIRECTIONS`, relative to the mean Gaussian; zero for extrapolated tissue."""
    pixels = canonical.means.new_zeros((), dtype=torch.float64)
    visibility = canonical.means.new_zeros(len(canonical), len(DIRECTIONS))
    for index in evenly_spaced(len(recorded.cameras), SETTINGS.max_frames):
        camera = recorded.cameras[index].within(REFERENCE_PIXELS)
        with torch.no_grad():
            posed = at(recorded.states[index])
            toward = _toward(posed, camera)
        observed = visible_pixels(posed, camera)
        pixels += observed.sum()
        visibility += observed[:, None] * toward
    visibility = visibility / max(float(pixels) / len(visibility), SETTINGS.min_pixels)
    if EXTRAPOLATED in canonical.extras:  # its border extends into recorded images
        visibility *= 1 - canonical.extras[EXTRAPOLATED][:, None]
    return visibility


def unobserved_share(visibility: Tensor, posed: Gaussians, camera: Camera) -> Tensor:
    """Return the unobserved share [N] in [0, 1] of each posed Gaussian, viewed by `camera`: 1 if no frame observed it
    from a similar direction. `visibility`: by `measure_visibility`. float32 on the CPU uses the native kernel."""
    if all_run_native(visibility, posed.means) and not torch.is_grad_enabled():
        frames = None if posed.sh_frames is None else posed.sh_frames.contiguous()
        centre = camera.world_from_camera[:3, 3].cpu().float()
        numbers = torch.cat([centre, torch.tensor([SETTINGS.half_visibility])])
        share = torch.empty(len(visibility))
        native().unobserved(
            posed.means.contiguous(), frames, visibility.contiguous(), _directions("cpu"), numbers, share
        )
        return share
    toward = _toward(posed, camera)
    share = (visibility * toward).sum(1) / toward.sum(1)
    return SETTINGS.half_visibility / (share + SETTINGS.half_visibility)


def _toward(posed: Gaussians, camera: Camera) -> Tensor:
    """Return weights [N, 12] in [0, 1] of `DIRECTIONS` by their angle to the direction from each Gaussian to the
    camera."""
    means = posed.means
    outward = normalize(camera.world_from_camera[:3, 3].to(means) - means, dim=1)  # [N, 3]
    if posed.sh_frames is not None:
        outward = torch.einsum("nji,nj->ni", quat_to_matrix(posed.sh_frames), outward)
    return (outward @ _directions(outward.device).T).clamp_min(0) ** SETTINGS.sharpness


def _directions(device: torch.device | str) -> Tensor:
    """Return `DIRECTIONS` [12, 3] on a device."""
    return constant(tuple(value for corner in DIRECTIONS for value in corner), torch.device(device)).view(-1, 3)


def visible_pixels(posed: Gaussians, camera: Camera) -> Tensor:
    """Return the number [N] of pixels that every posed Gaussian covers: the gradient of a rendered channel of ones."""
    channel = torch.ones_like(posed.opacities)[:, None].requires_grad_()
    with torch.enable_grad():
        unlit = replace(posed, sh=posed.sh[:, :1], headlight=None)
        composited = rasterize(unlit, camera, channels=channel).channels
        assert composited is not None
        (pixels,) = torch.autograd.grad(composited.sum(), channel)
    return pixels[:, 0]


def count_views(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Count the images [P] that points [P, 3] mm of the world project into, ignoring occlusion."""
    count = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    for camera in cameras:
        count += in_image(points, camera)
    return count


def outside_all_views(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return which points [P, 3] mm of the world project into none of the images, [P] bool."""
    unseen = torch.arange(len(points), device=points.device)
    for camera in cameras:
        unseen = unseen[~in_image(points[unseen], camera)]
    outside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    outside[unseen] = True
    return outside


@torch.no_grad()
def extrapolate_tissue(canonical: CanonicalGaussians, cameras: Sequence[Camera]) -> CanonicalGaussians:
    """Return canonical Gaussians with tissue (body 0) extrapolated by `max_distance` beyond the border of what
    `cameras` observed, in the mean depth and colour of its neighbourhood; unchanged without observed tissue."""
    camera = _middle_camera(cameras)
    cell = SETTINGS.cell * camera.width  # side of a cell, px; cells lie in its image and `grid_margin` to each side
    extended = (1 + 2 * SETTINGS.grid_margin) / cell
    shape = round(extended * camera.height), round(extended * camera.width)  # rows, columns
    corner = canonical.means.new_tensor([camera.width, camera.height]) * -SETTINGS.grid_margin  # px
    rows = canonical.body(0)
    means, colors = canonical.means[rows], canonical.sh_dc[rows][:, 0]  # [T, 3] both
    pixels, depths = project_world(means, camera)
    cells = ((pixels - corner) / cell).floor().flip(1)  # [T, 2] row and column, also outside the grid
    weights = torch.sigmoid(canonical.opacity_logits[rows]).double()
    weights = weights * ((cells >= 0) & (cells < cells.new_tensor(shape))).all(1)
    weights *= (depths > camera.near) & (count_views(means, cameras) >= SETTINGS.min_frame_share * len(cameras))
    values = torch.cat([torch.ones_like(depths)[:, None], 1 / depths[:, None], colors], 1).double()  # [T, 1 + 4]
    chosen = weights > 0
    index = (cells[chosen] @ cells.new_tensor([shape[1], 1.0])).long()
    weighted = weights[chosen, None] * values[chosen]
    total = weighted.new_zeros(shape[0] * shape[1], values.shape[1]).index_add(0, index, weighted)
    sums = total.reshape(*shape, -1).cpu().numpy()  # of weights and weighted values, by cell
    if not sums[..., 0].any():
        return canonical
    filled = torch.from_numpy(_filled(sums)).to(means)  # [rows, columns, 4] inverse depth, colour
    centers = pixel_centers(*shape).to(filled) * cell + corner
    positions = unproject_world(centers, SETTINGS.depth_factor * (1 / filled[..., 0]), camera)  # [rows, columns, 3]
    outside = outside_all_views(positions.reshape(-1, 3), cameras).reshape(shape).cpu()
    distance = distance_transform_edt(outside.numpy()) * cell
    added_cells = outside & torch.from_numpy(distance < SETTINGS.max_distance * camera.width)
    points, colors = positions[added_cells], filled[added_cells][:, 1:]
    spacing = SETTINGS.cell_sd * cell * project_world(points, camera)[1] / camera.fx  # mm, which fills the cells
    added = replace(seed_gaussians(points, colors, spacing, opacity=SETTINGS.opacity), sh_dc=colors[:, None].clone())
    marked = canonical.with_extras(**{EXTRAPOLATED: canonical.means.new_zeros(len(canonical))})
    blank = {name: tensor.new_zeros(len(added), *tensor.shape[1:]) for name, tensor in marked.extras.items()}
    added = added.with_extras(**(blank | {EXTRAPOLATED: added.means.new_ones(len(added))}))
    split, new = canonical.counts[0], added.tensors()  # at the end of body 0
    joined = {n: torch.cat([tensor[:split], new[n], tensor[split:]]) for n, tensor in marked.tensors().items()}
    return CanonicalGaussians.from_tensors(joined, (split + len(added), *canonical.counts[1:]))


def _middle_camera(cameras: Sequence[Camera]) -> Camera:
    """Return the camera whose position and direction are closest to the mean of all."""
    poses = torch.stack([camera.world_from_camera.double().cpu() for camera in cameras])  # [C, 4, 4]
    places, directions = poses[:, :3, 3], poses[:, :3, 2]
    spread = places.std(0, correction=0).norm().clamp_min(1e-6)
    turned = directions.std(0, correction=0).norm().clamp_min(1e-6)
    deviation = (places - places.mean(0)).norm(dim=1) / spread + (directions - directions.mean(0)).norm(dim=1) / turned
    return cameras[int(deviation.argmin())]


def _filled(sums: np.ndarray) -> np.ndarray:
    """Return means [rows, columns, V] of the known cells around every cell, from sums [rows, columns, 1 + V]: over the
    smallest sufficient neighbourhood, then smoothed."""
    means = np.zeros((*sums.shape[:2], sums.shape[2] - 1))
    unfilled = np.ones(sums.shape[:2], dtype=bool)
    is_known = (sums[..., 0] > 0).astype(float)
    for sigma in SETTINGS.smoothing_cells:
        blurred = gaussian_filter(sums, (sigma, sigma, 0), mode="constant")
        fillable = unfilled & (gaussian_filter(is_known, sigma, mode="constant") > SETTINGS.min_known_share)
        means[fillable] = blurred[fillable][:, 1:] / blurred[fillable][:, :1]
        unfilled &= ~fillable
    mean = sums.sum((0, 1))
    means[unfilled] = mean[1:] / mean[0]
    return gaussian_filter(means, (2.0, 2.0, 0), mode="nearest")
