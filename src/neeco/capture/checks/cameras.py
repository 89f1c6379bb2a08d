"""Cameras of many frames as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neeco.geometry.camera import Camera
from neeco.geometry.projection import project

MIN_DEPTH = 1e-3  # mm; points that are less deep are not in front of a camera


@dataclass(frozen=True)
class CameraArrays:
    """Cameras of F frames."""

    poses: np.ndarray  # [F, 4, 4] world_from_camera, OpenCV axes, mm
    intrinsics: np.ndarray  # [F, 4] fx fy cx cy, px
    sizes: np.ndarray  # [F, 2] width and height, px

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> CameraArrays:
        return cls(
            np.stack([camera.world_from_camera.double().numpy() for camera in cameras]),
            np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras]),
            np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64),
        )

    @property
    def centers(self) -> np.ndarray:
        """[F, 3] mm."""
        return self.poses[:, :3, 3]

    def __getitem__(self, rows: np.ndarray) -> CameraArrays:
        """The cameras of some frames."""
        return CameraArrays(self.poses[rows], self.intrinsics[rows], self.sizes[rows])

    def resized(self, sizes: np.ndarray) -> CameraArrays:
        """The cameras of images of other sizes [F, 2]."""
        factors = sizes / self.sizes
        return CameraArrays(self.poses, self.intrinsics * np.concatenate([factors, factors], 1), sizes)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns and rows [F, P] px and depths [F, P] mm of points [F, P, 3] or, of all frames, [1, P, 3] mm."""
        local = np.einsum("fpi,fij->fpj", points - self.centers[:, None], self.poses[:, :3, :3])
        fx, fy, cx, cy = self.intrinsics.T[..., None]  # each [F, 1]
        with np.errstate(all="ignore"):
            return *project(local, fx, fy, cx, cy, nearest=MIN_DEPTH), local[..., 2]

    def inside(self, u: np.ndarray, v: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return which projected points are in the images, bool [F, P]."""
        width, height = self.sizes.T[..., None]
        with np.errstate(invalid="ignore"):
            return (depth > MIN_DEPTH) & (u > 0) & (u < width) & (v > 0) & (v < height)

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Return which of points [F, P, 3] or [1, P, 3] each camera has in its image, bool [F, P]."""
        return self.inside(*self.project(points))
