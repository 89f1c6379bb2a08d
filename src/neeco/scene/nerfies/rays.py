"""Every pixel of the training frames as a ray, to be taken at random."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.scene.nerfies.render import Rays, directions_of
from neeco.scene.training_views import TrainingViews


class RayTable:
    """All pixels of frames of any size, on the views' device."""

    def __init__(self, views: TrainingViews) -> None:
        device = views.device
        self.pixels = torch.cat([image.flatten(0, 1) for image in views.images]).to(device)  # [P, 3]
        self.counted: Tensor | None = None  # [P], where the loss counts
        if any(mask is not None for mask in views.masks):
            whole = [
                torch.ones(image.shape[:2], dtype=torch.bool, device=image.device) if mask is None else mask
                for image, mask in zip(views.images, views.masks, strict=True)
            ]
            self.counted = torch.cat([mask.flatten() for mask in whole]).to(device)
        cameras = [frame.camera for frame in views.frames]
        self.sizes = torch.tensor([[camera.width, camera.height] for camera in cameras], device=device)
        ends = self.sizes.prod(1).cumsum(0)
        self.starts = torch.cat([ends.new_zeros(1), ends[:-1]])
        self.poses = torch.stack([camera.world_from_camera.float() for camera in cameras]).to(device)
        self.intrinsics = torch.tensor(
            [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras], device=device
        )
        self.times = torch.tensor([frame.state.time for frame in views.frames], dtype=torch.float64, device=device)

    def sample(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor, Tensor | None]:
        """`count` pixels of frames, each at random: their rays, colours [R, 3] in [0, 1] and which of them count."""
        device = generator.device
        frames = torch.randint(len(self.times), (count,), generator=generator, device=device)
        place = (torch.rand(count, 2, generator=generator, device=device) * self.sizes[frames]).long()
        place = torch.minimum(place, self.sizes[frames] - 1)
        index = self.starts[frames] + place[:, 1] * self.sizes[frames, 0] + place[:, 0]
        centres = place.float() + 0.5
        directions = directions_of(centres[:, 0], centres[:, 1], self.intrinsics[frames], self.poses[frames, :3, :3])
        rays = Rays(self.poses[frames, :3, 3], directions, self.times[frames])
        counted = None if self.counted is None else self.counted[index]
        return rays, self.pixels[index].float() / 255, counted
