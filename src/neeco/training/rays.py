"""Every pixel of the training frames as a ray, to be taken at random."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neeco.capture.model import Frame
from neeco.scene.nerfies.render import Rays, directions_of


class RayTable:
    """All pixels of frames of any size. images [H, W, 3] uint8, masks [H, W] bool or None, one per frame."""

    def __init__(self, frames: Sequence[Frame], images: Sequence[Tensor], masks: Sequence[Tensor | None]) -> None:
        self.pixels = torch.cat([image.flatten(0, 1) for image in images])  # [P, 3]
        self.counted: Tensor | None = None  # [P], where the loss counts
        if any(mask is not None for mask in masks):
            whole = [
                torch.ones(image.shape[:2], dtype=torch.bool) if mask is None else mask
                for image, mask in zip(images, masks, strict=True)
            ]
            self.counted = torch.cat([mask.flatten() for mask in whole])
        cameras = [frame.camera for frame in frames]
        self.sizes = torch.tensor([[camera.width, camera.height] for camera in cameras])
        ends = self.sizes.prod(1).cumsum(0)
        self.starts = torch.cat([torch.zeros(1, dtype=torch.long), ends[:-1]])
        self.poses = torch.stack([camera.world_from_camera.float() for camera in cameras])
        self.intrinsics = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras])
        self.times = torch.tensor([frame.state.time for frame in frames], dtype=torch.float64)

    def sample(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor, Tensor | None]:
        """`count` pixels of frames, each at random: their rays, colours [R, 3] in [0, 1] and which of them count."""
        frames = torch.randint(len(self.times), (count,), generator=generator)
        place = (torch.rand(count, 2, generator=generator) * self.sizes[frames]).long()
        place = torch.minimum(place, self.sizes[frames] - 1)
        index = self.starts[frames] + place[:, 1] * self.sizes[frames, 0] + place[:, 0]
        centres = place.float() + 0.5
        directions = directions_of(centres[:, 0], centres[:, 1], self.intrinsics[frames], self.poses[frames, :3, :3])
        rays = Rays(self.poses[frames, :3, 3], directions, self.times[frames])
        counted = None if self.counted is None else self.counted[index]
        return rays, self.pixels[index].float() / 255, counted
