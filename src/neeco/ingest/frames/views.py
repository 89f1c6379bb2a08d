"""What later stages know of the frames that were kept: their images, reduced, and the cameras that took them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from neeco.capture.model import REFERENCE_PIXELS
from neeco.geometry.camera import Camera
from neeco.geometry.lens import Lens

StageProgress = Callable[[str, int, int], None]  # what, how many done, of how many (0: not known)


@dataclass(frozen=True)
class SfmResult:
    """In SfM's own frame and unit."""

    indices: np.ndarray  # [M] which of the images given got a camera
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    points: np.ndarray  # [P, 3]
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] px
    lengths: np.ndarray  # [P] images that see the point
    observations: np.ndarray  # [Q, 5] row of world_from_camera, point, x px, y px, number of the image's feature
    lens: Lens | None  # estimated; None where it was given
    reprojection_px: float

    def reliable_points(self, length: int = 4, error: float = 1.2) -> np.ndarray:
        """[P] bool: seen by enough images and well fitted."""
        return (self.lengths >= length) & (self.errors < error)


def reduced(image: np.ndarray) -> np.ndarray:
    """An image uint8 [H, W, 3] (or [H, W]) of at most REFERENCE_PIXELS, as what moves is looked for in."""
    height, width = image.shape[:2]
    small = Camera(torch.eye(4), width, width, width / 2, height / 2, width, height).within(REFERENCE_PIXELS)
    size = small.width, small.height
    return image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
