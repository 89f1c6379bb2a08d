"""The frames that a scene is learned from, with their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neeco.capture.model import Frame


@dataclass(frozen=True)
class TrainingViews:
    """Frames, and for each its image and its mask. Cameras and states stay where the frames have them."""

    frames: tuple[Frame, ...]
    images: tuple[Tensor, ...]  # [H, W, 3] uint8 each
    masks: tuple[Tensor | None, ...]  # [H, W] bool each, False where the loss does not look; None: it looks everywhere

    @classmethod
    def read(cls, frames: Sequence[Frame]) -> TrainingViews:
        """Load every frame's pixels. Raises NeecoError where a file cannot be read."""
        images = tuple((frame.load_image() * 255).round().to(torch.uint8) for frame in frames)
        return cls(tuple(frames), images, tuple(frame.load_mask() for frame in frames))

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def device(self) -> torch.device:
        """Where the pixels are."""
        return self.images[0].device

    def to(self, device: torch.device) -> TrainingViews:
        """The same views with their pixels on `device`."""
        masks = tuple(None if mask is None else mask.to(device) for mask in self.masks)
        return replace(self, images=tuple(image.to(device) for image in self.images), masks=masks)

    def target(self, index: int) -> Tensor:
        """The target image [H, W, 3] of one frame, float32 in [0, 1]."""
        return self.images[index].float() / 255
