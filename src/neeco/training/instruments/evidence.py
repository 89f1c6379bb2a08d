"""Where the instruments are, before anything is known of them: what a scene of tissue alone cannot explain.

A short static fit explains the tissue; each image's residual is the evidence. No mask, CAD or label is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from neeco.capture.model import Frame
from neeco.raster import rasterize
from neeco.raster.pinhole import project
from neeco.scene.scene import Scene
from neeco.scene.training_views import TrainingViews

FLOOR, RANGE = 0.04, 0.06  # residual at which evidence begins, and over which it saturates (images in [0, 1])


@dataclass(frozen=True)
class Evidence:
    """F frames' residuals as soft masks, and what is needed to look points up in them, on one device.

    H and W are the largest of the frames' heights and widths; beyond its own image a frame has no evidence.
    """

    hits: Tensor  # [F, H, W] in [0, 1]
    depths: Tensor  # [F, H, W] mm, of the tissue; inf where there is none
    camera_from_world: Tensor  # [F, 4, 4]
    intrinsics: Tensor  # [F, 4] fx, fy, cx, cy
    frames: tuple[Frame, ...]

    @cached_property
    def distance(self) -> float:
        """Median distance from camera to tissue, mm: the scale of the scene."""
        return float(self.depths[self.depths.isfinite() & (self.depths > 0)].median())

    @cached_property
    def sizes(self) -> Tensor:
        """[F, 2] width and height px of each frame's image."""
        sizes = [[frame.camera.width, frame.camera.height] for frame in self.frames]
        return torch.tensor(sizes, device=self.device)

    @property
    def device(self) -> torch.device:
        """Where everything is looked up."""
        return self.hits.device

    def subset(self, index: Tensor) -> Evidence:
        """The frames `index` [M] alone."""
        index = index.to(self.device)
        frames = tuple(self.frames[i] for i in index.tolist())
        return Evidence(
            self.hits[index], self.depths[index], self.camera_from_world[index], self.intrinsics[index], frames
        )

    def look_up_camera(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Evidence at camera-frame points [F, Q, 3], and whether each is in the image and before the tissue: both
        [F, Q]."""
        z = points[..., 2]
        fx, fy, cx, cy = (column[:, None] for column in self.intrinsics.unbind(1))
        u, v = project(points, fx, fy, cx, cy)
        height, width = self.hits.shape[1:]
        own_width, own_height = self.sizes[:, :1], self.sizes[:, 1:]
        inside = (z > 0.01 * self.distance) & (u >= 0) & (u < own_width) & (v >= 0) & (v < own_height)
        column, row = u.nan_to_num().clamp(0, width - 1).long(), v.nan_to_num().clamp(0, height - 1).long()
        place = (torch.arange(len(self.frames), device=self.device)[:, None] * height + row) * width + column
        inside &= z < 1.02 * self.depths.view(-1)[place]
        return self.hits.view(-1)[place], inside


@torch.no_grad()
def gather_evidence(scene: Scene, views: TrainingViews, most: int = 120) -> Evidence:
    """Residuals of a tissue-only `scene` against at most `most` training images, evenly picked, on its
    device.

    Where a mask is False there is no evidence.
    """
    frames = views.frames
    step = max(1, -(-len(frames) // most))
    picked = list(range(0, len(frames), step))
    hits, depths = [], []
    for index in picked:
        frame = frames[index]
        rendering = rasterize(scene.at(frame.state), frame.camera)
        residual = (rendering.color - views.target(index)).abs().mean(-1)
        mask = views.mask(index)
        if mask is not None:
            residual = residual * mask
        smooth = torch.nn.functional.avg_pool2d(residual[None, None], 3, 1, 1)[0, 0]
        hits.append(((smooth - FLOOR) / RANGE).clamp(0, 1))
        depths.append(torch.where(rendering.alpha > 0.5, rendering.depth, torch.full_like(rendering.depth, torch.inf)))
    cameras, device = [frames[i].camera for i in picked], views.device
    return Evidence(
        _stacked(hits, 0.0),
        _stacked(depths, torch.inf),
        torch.stack([torch.linalg.inv(camera.world_from_camera.double()).float() for camera in cameras]).to(device),
        torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], device=device),
        tuple(frames[i] for i in picked),
    )


def _stacked(images: list[Tensor], beyond: float) -> Tensor:
    """Images [H_i, W_i] of any sizes as one [F, H, W], filled up with `beyond` at the right and below."""
    height, width = max(image.shape[0] for image in images), max(image.shape[1] for image in images)
    stacked = images[0].new_full((len(images), height, width), beyond)
    for place, image in zip(stacked, images, strict=True):
        place[: image.shape[0], : image.shape[1]] = image
    return stacked
