"""The camera of an image: a pinhole with OpenCV axes, optionally with distortion and an endoscope's round border."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.plausible import camera_fault
from neeco.geometry.rotations import as_pose, number_text, position_text

COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's distortion models


@dataclass(frozen=True)
class Camera:
    """A camera with OpenCV axes (x right, y down, z forward) and pixel centres at +0.5. Gradients reach the pose.

    It is a pinhole unless it has OpenCV's distortion or an endoscope's round border, black outside. With `learned_fx`
    an image of another size than the learned one shows the same picture, larger or smaller (`draw_through` in
    neeco.raster.resampling; `Scene.draw` sets it).

    Args:
        world_from_camera: rigid pose [4, 4] in mm; an array or nested lists become float32
        fx: focal length in px
        fy: focal length in px
        cx: principal point in px from the image's left edge
        cy: principal point in px from the image's upper edge
        width: of the image in px
        height: of the image in px
        near: mm; Gaussians whose mean is nearer render nothing
        distortion: OpenCV's k1, k2, p1, p2[, k3, ...]
        border: centre x, centre y and radius in px of what the lens shows; None: everything
        learned_fx: focal length in px of the images that Gaussians were learned from; None: of images like this one
        world_from_lamps: rigid pose [4, 4] in mm of the camera next to the lamps, where it is another one

    Raises NeecoError for a pose that is not rigid, a size that is not whole and positive, and other numbers that are
    not finite.

        neeco.Camera(np.eye(4), fx=290, fy=290, cx=160, cy=128, width=320, height=256)
    """

    world_from_camera: Tensor  # [4, 4] rigid, mm
    fx: float  # px
    fy: float
    cx: float  # px from the image's left edge
    cy: float  # px from its upper edge
    width: int  # px
    height: int
    near: float = 0.01  # mm; Gaussians whose mean is nearer render nothing
    distortion: tuple[float, ...] = ()  # k1, k2, p1, p2[, k3, ...]
    border: tuple[float, float, float] | None = None  # px: centre x, y and radius of what the lens shows
    learned_fx: float | None = None  # px, of the images that Gaussians were learned from; None: of ones like this
    # [4, 4] rigid, mm: the camera next to the lamps, where it is another one: a stereo scope has lamps once
    world_from_lamps: Tensor | None = None

    if TYPE_CHECKING:  # what may be given

        def __init__(
            self,
            world_from_camera: ArrayLike | Tensor,
            fx: float,
            fy: float,
            cx: float,
            cy: float,
            width: int,
            height: int,
            near: float = ...,
            distortion: tuple[float, ...] = ...,
            border: tuple[float, float, float] | None = ...,
            learned_fx: float | None = ...,
            world_from_lamps: Tensor | None = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        pose = as_pose(self.world_from_camera, "Camera.world_from_camera", torch.float32)
        object.__setattr__(self, "world_from_camera", pose)
        try:
            fault = camera_fault(self.fx, self.fy, self.cx, self.cy, self.width, self.height, near=self.near)
            finite = all(math.isfinite(number) for number in (*self.distortion, *(self.border or ())))
        except (TypeError, ValueError, OverflowError):
            raise NeecoError("Camera: expected numbers of px; correct them") from None
        if fault is not None:
            raise NeecoError(f"Camera: {fault[0]}; {fault[1]}")
        if len(self.distortion) not in COEFFICIENT_COUNTS:
            raise NeecoError(
                f"Camera.distortion: has {len(self.distortion)} coefficients; OpenCV has 4, 5, 8, 12 or 14"
            )
        if not finite or (self.border is not None and self.border[2] <= 0):
            raise NeecoError("Camera: distortion, border: must be finite, the radius positive; correct them")
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))

    def __repr__(self) -> str:
        lens = ", distorted" if self.distortion else ""
        size = f"{self.width}x{self.height} px, fx={number_text(self.fx)}, fy={number_text(self.fy)}"
        return f"Camera({size}, at {position_text(self.world_from_camera)}{lens})"

    def to(self, device: torch.device | str) -> Camera:
        """The same camera, its pose and that of its lamps on `device`."""
        lamps = None if self.world_from_lamps is None else self.world_from_lamps.to(device)
        return replace(self, world_from_camera=self.world_from_camera.to(device), world_from_lamps=lamps)

    @cached_property
    def camera_from_world(self) -> np.ndarray:
        """Inverse of the pose, [4, 4] float64 without gradient."""
        return np.linalg.inv(self.world_from_camera.detach().cpu().double().numpy())

    @property
    def is_pinhole(self) -> bool:
        """True without distortion and border: straight lines are straight."""
        return self.border is None and not any(self.distortion)

    @property
    def is_resampled(self) -> bool:
        """True if its image is resampled from another camera's (`draw_through` in neeco.raster.resampling)."""
        return self.learned_fx is not None or not self.is_pinhole

    def resized(self, width: int, height: int) -> Camera:
        """The same view in an image of width x height px; pixel centres lie at +0.5, so scaling needs no offset."""
        across, down = width / self.width, height / self.height
        border = self.border
        return replace(
            self,
            border=None if border is None else (border[0] * across, border[1] * down, border[2] * across),
            fx=self.fx * across,
            fy=self.fy * down,
            cx=self.cx * across,
            cy=self.cy * down,
            width=width,
            height=height,
        )

    def scaled(self, factor: float) -> Camera:
        """The same view with `factor` times the pixels along each side (rounded to whole pixels, at least one)."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def within(self, pixels: int) -> Camera:
        """The same view with at most about so many pixels."""
        factor = (pixels / (self.width * self.height)) ** 0.5
        return self if factor >= 1 else self.scaled(factor)
