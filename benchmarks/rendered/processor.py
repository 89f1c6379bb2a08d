"""Video processors of other endoscopes: how a camera renders the same light into other colours, tones and sharpness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Processor:
    """What another camera does to linear light (`gains`) and to the stored image, and its focal length."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exposure and white balance, linear light
    focal: float = 1.0  # times that of the default lens
    saturation: float = 1.0
    contrast: float = 1.0  # slope of the tone curve at mid-grey
    blur_px: float = 0.0  # standard deviation, at a height of 256 px
    sharpening: float = 0.0  # gain of the unsharp mask
    noise: float = 1.0  # times the default sensor's standard deviations

    def develop(self, color: Tensor) -> Tensor:
        """Stored image [H, W, 3] in [0, 1] as this camera stores it."""
        image = color.numpy()
        if self.blur_px:
            image = cv2.GaussianBlur(image, (0, 0), self.blur_px * len(image) / 256)
        if self.sharpening:
            image = image + self.sharpening * (image - cv2.GaussianBlur(image, (0, 0), 1.2 * len(image) / 256))
        grey = image @ np.float32([0.2126, 0.7152, 0.0722])
        image = grey[..., None] + self.saturation * (image - grey[..., None])
        image = np.clip(image, 0, 1)
        curve = image**self.contrast / (image**self.contrast + (1 - image) ** self.contrast)  # 0.5 stays 0.5
        return torch.from_numpy(curve.astype(np.float32))


PROCESSORS = {
    "bright": Processor((1.7, 1.5, 1.65), 0.85, saturation=0.8, contrast=1.15, sharpening=0.7, noise=1.3),
    "warm": Processor((0.80, 0.60, 0.47), 1.2, saturation=1.2, contrast=0.9, blur_px=0.9, noise=2.5),
}
