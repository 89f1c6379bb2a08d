"""Video processors of other endoscopes: how a camera renders the same light into other colours, tones and sharpness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Processor:
    """What another camera does to linear light (`gains`) and to the stored image."""

    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)  # exposure and white balance, linear light
    saturation: float = 1.0
    contrast: float = 1.0  # slope of the tone curve at mid-grey
    blur_px: float = 0.0  # standard deviation, at a height of 256 px
    noise: float = 1.0  # times the default sensor's standard deviations

    def develop(self, color: Tensor) -> Tensor:
        """Stored image [H, W, 3] in [0, 1] as this camera stores it."""
        image = color.numpy()
        if self.blur_px:
            image = cv2.GaussianBlur(image, (0, 0), self.blur_px * len(image) / 256)
        grey = image @ np.float32([0.2126, 0.7152, 0.0722])
        image = grey[..., None] + self.saturation * (image - grey[..., None])
        image = np.clip(image, 0, 1)
        curve = image**self.contrast / (image**self.contrast + (1 - image) ** self.contrast)  # 0.5 stays 0.5
        return torch.from_numpy(curve.astype(np.float32))
