"""The lens of a recording: images are undistorted at ingest; the lens is kept to render images as it shows them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.plausible import center_fault, focal_fault
from neeco.geometry.camera import Camera

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
BORDER = ("cx", "cy", "radius")

Border = tuple[float, float, float]  # centre x, y and radius, px


@dataclass(frozen=True)
class Lens:
    """Intrinsics, distortion and field of view of a lens. Pixel centres are at +0.5."""

    fl_x: float  # px
    fl_y: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2[, k3, ...]; empty: a pinhole
    size: tuple[int, int] | None = None  # (width, height) of the images it was measured on; None: unknown
    border: Border | None = field(default=None, kw_only=True)  # of a round field of view

    @property
    def distorted(self) -> bool:
        return any(self.distortion)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fl_x, fl_y, cx, cy."""
        return self.fl_x, self.fl_y, self.cx, self.cy

    def camera(self, world_from_camera: np.ndarray) -> Camera:
        """Camera of a lens without distortion at a pose [4, 4], OpenCV axes."""
        assert self.size is not None
        assert not self.distorted
        return Camera(torch.from_numpy(world_from_camera.copy()), *self.intrinsics, *self.size)

    def distorted_camera(self, pinhole: Camera) -> Camera:
        """The camera with this lens that recorded what `pinhole` shows after undistortion."""
        assert self.size is not None
        fx, fy, cx, cy = self.intrinsics
        width, height = self.size
        camera = replace(pinhole, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
        return replace(camera, distortion=self.distortion, border=self.border)

    @classmethod
    def of(cls, camera: Camera) -> Lens:
        """The lens of a camera."""
        size = camera.width, camera.height
        return cls(camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion, size, border=camera.border)

    def to_json(self) -> dict[str, Any]:
        """The `lens` block of transforms.json: w and h, px, and the intrinsics."""
        assert self.size is not None
        return {"w": self.size[0], "h": self.size[1], **self.intrinsics_json()}

    def intrinsics_json(self) -> dict[str, Any]:
        """Intrinsics fl_x, fl_y, cx, cy, px, and where given k1, k2, p1, p2, k3 ... and border {cx, cy, radius}, px."""
        values: dict[str, Any] = dict(zip(INTRINSICS, self.intrinsics, strict=True))
        values |= dict(zip(COEFFICIENT_NAMES, self.distortion, strict=False))
        return values if self.border is None else values | {"border": dict(zip(BORDER, self.border, strict=True))}

    def check_size(self, size: tuple[int, int], source: object) -> None:
        """Raise NeecoError naming `source` when the lens was measured on images of another size (width, height)."""
        if self.size is not None and self.size != tuple(size):
            measured, actual = "x".join(map(str, self.size)), "x".join(map(str, size))
            raise NeecoError(
                f"{source}: calibrated on {measured} images, the video is {actual}; calibrate at the video's size, or "
                "scale fl_x, fl_y, cx, cy and the size if the video was only resized"
            )
        fault = center_fault(self.cx, self.cy, *size) or focal_fault(self.fl_x, self.fl_y, *size)
        if fault is not None:
            raise NeecoError(f"{source}: {fault[0]}; {fault[1]}")

    def pinhole(self, size: tuple[int, int]) -> Lens:
        """Pinhole of undistorted images (width, height), zoomed so that every pixel is defined. Raises NeecoError when
        the distortion folds the image over."""
        if not self.distorted:
            return Lens(*self.intrinsics, (), size)
        matrix, _ = cv2.getOptimalNewCameraMatrix(self._matrix(), self._coefficients(), size, 0.0)
        fl_x, fl_y, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        pinhole = Lens(fl_x, fl_y, cx + 0.5, cy + 0.5, (), size)
        if not (0.2 < fl_x / self.fl_x < 5 and 0.2 < fl_y / self.fl_y < 5) or self._folds(pinhole, size):
            listed = ", ".join(f"{value:g}" for value in self.distortion)
            raise NeecoError(f"lens: distortion {listed} folds the image over; calibrate again")
        return pinhole

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Undistort an image uint8 [H, W, 3] (or [H, W]) to that of `pinhole`, bilinear."""
        return self._remap(image, cv2.INTER_LINEAR)

    def undistort_mask(self, mask: np.ndarray) -> np.ndarray:
        """Undistort a mask bool [H, W] to that of `pinhole`."""
        return self._remap(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0

    def _remap(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        if not self.distorted:
            return image
        maps = _maps(self, (image.shape[1], image.shape[0]))
        return cv2.remap(image, *maps, interpolation, borderMode=cv2.BORDER_CONSTANT)

    def _folds(self, pinhole: Lens, size: tuple[int, int]) -> bool:
        """Return True if anywhere in the undistorted image a ray farther out is not distorted farther out."""
        x = np.array([-pinhole.cx, size[0] - pinhole.cx]) / pinhole.fl_x
        y = np.array([-pinhole.cy, size[1] - pinhole.cy]) / pinhole.fl_y
        r2 = np.linspace(0, np.hypot(np.abs(x).max(), np.abs(y).max()), 200) ** 2
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *[0.0] * 8)[:8]
        with np.errstate(all="ignore"):
            distorted = np.sqrt(r2) * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return not bool((np.diff(distorted) > 0).all())

    def _matrix(self) -> np.ndarray:
        """K [3, 3] in OpenCV's convention: the first pixel's centre at 0."""
        return np.array([[self.fl_x, 0, self.cx - 0.5], [0, self.fl_y, self.cy - 0.5], [0, 0, 1]])

    def _coefficients(self) -> np.ndarray:
        return np.array(self.distortion, dtype=np.float64)


@lru_cache(maxsize=4)
def _maps(lens: Lens, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    new = lens.pinhole(size)._matrix()
    return cv2.initUndistortRectifyMap(lens._matrix(), lens._coefficients(), None, new, size, cv2.CV_32FC1)
