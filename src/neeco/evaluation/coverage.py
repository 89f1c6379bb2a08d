"""Tissue in test frames that no training frame observed: no model can render it, so it is scored apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from neeco.capture.model import Frame, evenly_spaced
from neeco.evaluation.image_metrics import resize_mask
from neeco.geometry.camera import Camera
from neeco.geometry.projection import pixel_centers, project, unproject_world
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.raster.types import Rendering

if TYPE_CHECKING:
    from neeco.scene import DrawableScene


@dataclass(frozen=True, kw_only=True)
class CoverageSettings:
    """Settings of the depth maps for occlusion tests."""

    max_views: int = 96  # training views, evenly spaced over the recording; adjacent ones show the same tissue
    scale: float = 0.25  # of the image's resolution
    min_side_px: int = 48  # below which images are not reduced
    tolerance: float = 0.02  # share of the depth
    tolerance_mm: float = 1.0  # added to it
    nearest_mm: float = 1e-3  # points behind a camera are not observed
    chunk_views: int = 16  # views per test; most points are observed in the first chunk
    min_alpha: float = 0.5  # minimum alpha of a pixel with a depth


SETTINGS = CoverageSettings()


@dataclass(frozen=True)
class Coverage:
    """Depth maps of the training views, rendered once for all test frames."""

    camera_from_world: Tensor  # [V, 4, 4]
    intrinsics: Tensor  # [V, 4] fx, fy, cx, cy in px of the depth maps
    depths: Tensor  # [V, h, w] mm
    sizes: Tensor  # [V, 2] width, height of each view's map (maps are padded to a common size)

    def observed(self, points: Tensor) -> Tensor:
        """Return bool [M]: world points [M, 3] (mm) that at least one training view observes unoccluded: they project
        into it no deeper than the surface rendered there, within 2 % + 1 mm.
        """
        observed = torch.zeros(len(points), dtype=torch.bool)
        chunks = -(-len(self.depths) // SETTINGS.chunk_views)
        for start in range(chunks):  # views far apart in time first: each chunk takes every chunks-th view
            unseen = torch.nonzero(~observed)[:, 0]
            if len(unseen) == 0:
                break
            views = torch.arange(len(self.depths))[start::chunks]
            observed[unseen] = self._observed_by(points[unseen], views).any(dim=0)
        return observed

    def _observed_by(self, points: Tensor, views: Tensor) -> Tensor:
        """Return bool [V', M] for the views with these indices."""
        pose = self.camera_from_world[views]
        local = torch.einsum("vij,mj->vmi", pose[:, :3, :3], points) + pose[:, None, :3, 3]  # [V', M, 3]
        depth = local[..., 2]
        fx, fy, cx, cy = self.intrinsics[views].T[..., None]  # each [V', 1]
        column, row = (place.floor().long() for place in project(local, fx, fy, cx, cy, nearest=SETTINGS.nearest_mm))
        width, height = self.sizes[views].T[..., None]
        inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        stride = self.depths.shape[2]
        index = (row * stride + column).clamp(0, self.depths[0].numel() - 1)
        surface = self.depths[views].flatten(1).gather(1, index)  # [V', M]
        return inside & (depth <= surface * (1 + SETTINGS.tolerance) + SETTINGS.tolerance_mm)


@torch.no_grad()
def observed_depths(scene: DrawableScene, frames: Sequence[Frame]) -> Coverage:
    """Render small depth maps of at most `max_views` training `frames`, instruments included."""
    chosen = [frames[index] for index in evenly_spaced(len(frames), SETTINGS.max_views)]
    cameras = [_small(frame.camera) for frame in chosen]
    maps = [_filled(scene.render(frame.state, camera)) for frame, camera in zip(chosen, cameras, strict=True)]
    height, width = max((len(depth) for depth in maps), default=1), max((depth.shape[1] for depth in maps), default=1)
    depths, views = torch.zeros(len(maps), height, width), torch.zeros(len(maps), 4, 4)
    for index, (depth, camera) in enumerate(zip(maps, cameras, strict=True)):
        depths[index, : depth.shape[0], : depth.shape[1]] = depth
        views[index] = torch.linalg.inv(camera.world_from_camera.cpu().double()).float()
    return Coverage(
        views,
        torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras]).reshape(-1, 4),
        depths,
        torch.tensor([[c.width, c.height] for c in cameras], dtype=torch.long).reshape(-1, 2),
    )


@torch.no_grad()
def unobserved_tissue(coverage: Coverage, scene: DrawableScene, frame: Frame) -> tuple[Tensor, Tensor]:
    """Return tissue in `frame` that no training view observed, and all its tissue: two bool masks [H, W].

    The surface is the scene's expected depth at the frame's state and camera, extrapolated from the nearest pixel where
    nothing is rendered. Instrument pixels (by the composited label) move with the state and are in neither mask.
    """
    camera = _small(frame.camera)
    rendering = scene.render(frame.state, camera, labels=True)
    tissue = torch.ones(camera.height, camera.width, dtype=torch.bool)
    if rendering.channels is not None:
        tissue = composited_labels(rendering, threshold_of(scene))[0].cpu() == 0
    centers = pixel_centers(camera.height, camera.width)
    points = unproject_world(centers, _filled(rendering), camera)  # [h, w, 3]
    unobserved = torch.zeros_like(tissue)
    unobserved[tissue] = ~coverage.observed(points[tissue])
    size = (frame.camera.width, frame.camera.height)
    return resize_mask(unobserved, *size), resize_mask(tissue, *size)


def _small(camera: Camera) -> Camera:
    """Return the camera at the resolution of the depth maps."""
    return camera.scaled(min(1.0, max(SETTINGS.scale, SETTINGS.min_side_px / min(camera.width, camera.height))))


def _filled(rendering: Rendering) -> Tensor:
    """Return the depth [h, w] mm on the CPU; pixels of an alpha below `min_alpha` have the nearest solid pixel's."""
    depth, hollow = rendering.depth.cpu().float(), (rendering.alpha.cpu() < SETTINGS.min_alpha).numpy()
    if not hollow.any() or hollow.all():
        return depth
    rows, columns = distance_transform_edt(hollow, return_distances=False, return_indices=True)
    return depth[torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]
