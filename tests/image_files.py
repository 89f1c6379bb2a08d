"""Images as floats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neeco.capture.images import read_pixels


def read_image(path: Path, size: tuple[int, int] | None = None, background: float = 1.0) -> Tensor:
    """An image as float32 [H, W, 3] in [0, 1]."""
    pixels = read_pixels(path, size, background)
    return torch.from_numpy(pixels / np.float32(255) if pixels.dtype == np.uint8 else pixels)
