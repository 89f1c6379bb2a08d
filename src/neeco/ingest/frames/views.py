"""Values that the stages of an ingest exchange about chosen frames: images, cameras, a reconstruction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from neeco.capture.model import REFERENCE_PIXELS
from neeco.geometry.lens import Lens

MIN_POINT_IMAGES, MAX_POINT_ERROR_PX = 4, 1.2  # of points that are tissue: images that observe them, and misfit
StageProgress = Callable[[str, int, int], None]  # what, how many done, of how many (0: not known)


@dataclass(frozen=True, eq=False, kw_only=True)
class SfmResult:
    """A reconstruction by structure from motion, in a frame and unit of its own."""

    indices: np.ndarray  # [M] which of the images given got a camera
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    points: np.ndarray  # [P, 3]
    colors: np.ndarray  # [P, 3] uint8
    errors: np.ndarray  # [P] px
    lengths: np.ndarray  # [P] images that observe the point
    observations: np.ndarray  # [Q, 5] row of world_from_camera, point, x px, y px, number of the image's feature
    lens: Lens | None  # estimated; None where it was given
    reprojection_px: float

    def reliable_points(self) -> np.ndarray:
        """Return [P] bool: observed by enough images and well fitted."""
        return (self.lengths >= MIN_POINT_IMAGES) & (self.errors < MAX_POINT_ERROR_PX)


@dataclass(frozen=True, eq=False, kw_only=True)
class Views:
    """Chosen frames that have a camera, in the frame and unit of their cameras."""

    rows: np.ndarray  # [M] of the chosen frames
    frames: np.ndarray  # [M] numbers of the video frames
    times: np.ndarray  # [M] s, joint timeline
    episodes: np.ndarray  # [M] which of several recordings each is of
    world_from_camera: np.ndarray  # [M, 4, 4] OpenCV axes
    load: Callable[[int], np.ndarray]  # image uint8 [H, W, 3] of a row of these arrays, as `pinhole` projects it
    pinhole: Lens
    visible: np.ndarray | None = None  # bool [H, W], the field of view, where it has a border

    @property
    def reduced_pinhole(self) -> Lens:
        """The lens of the images `reduced`."""
        return Lens.of(self.pinhole.camera(np.eye(4)).within(REFERENCE_PIXELS))

    @property
    def reduced_border(self) -> np.ndarray | None:
        """Pixels of the images `reduced`, bool [h, w], at least in part beyond the field of view."""
        return None if self.visible is None else reduced(self.visible.astype(np.uint8) * 255) < 255


def reduced(image: np.ndarray) -> np.ndarray:
    """Return an image uint8 [H, W, 3] (or [H, W]) scaled down to REFERENCE_PIXELS, in which motion is looked for."""
    height, width = image.shape[:2]
    whole = Lens(width, width, width / 2, height / 2, (), (width, height)).camera(np.eye(4))
    small = whole.within(REFERENCE_PIXELS)
    size = small.width, small.height
    return image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
