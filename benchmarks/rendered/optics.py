"""An endoscope's optics: radial distortion and a round border. Pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rendered.motion import Array
from rendered.render import Lens

DISTORTION = (-0.24, 0.055, 0.0006, -0.0004, 0.0)  # OpenCV's k1, k2, p1, p2, k3
RADIUS = 0.68  # of the field of view, in image heights
SOFT = 0.004  # of the border's edge, in image heights
BLACK = 2.5 / 255  # of the border, sRGB
INVERSIONS = 40  # steps of a fixed point


@dataclass(frozen=True)
class Optics(Lens):
    """A camera of the same focal length whose image is distorted and shown in a circle."""

    @staticmethod
    def of(lens: Lens) -> Optics:
        """The optics before a pinhole's sensor."""
        return Optics(lens.width, lens.height, lens.focal)

    def rays_through(self, u: Tensor, v: Tensor) -> Tensor:
        """Directions [M, 3] with z = 1 of positions u, v [M] px of the distorted image."""
        rays = super().rays_through(u, v)
        x, y = wanted = rays[:, :2].double().numpy().T
        for _ in range(INVERSIONS):
            seen = distort(x, y)
            x, y = x + wanted[0] - seen[0], y + wanted[1] - seen[1]
        rays[:, :2] = torch.from_numpy(np.stack([x, y], -1)).float()
        return rays

    def add_border(self, color: Tensor) -> Tensor:
        """An image [H, W, 3], sRGB, with the dark border."""
        share = torch.sigmoid((RADIUS * self.height - self._off_middle()) / (SOFT * self.height))[..., None]
        return color * share + BLACK * (1 - share)

    def visible(self) -> Array:
        """bool [H, W]: which pixels of the pinhole image show what lies inside the border."""
        x, y = Lens(self.width, self.height, self.focal).rays()[:, :2].double().numpy().T
        distance = np.hypot(*distort(x, y)) * self.focal
        return (distance < (RADIUS - 3 * SOFT) * self.height).reshape(self.height, self.width)

    def calibration(self) -> str:
        """The calibration as OpenCV writes it (YAML); its principal point counts from the first pixel's centre."""
        matrix = [self.focal, 0.0, self.width / 2 - 0.5, 0.0, self.focal, self.height / 2 - 0.5, 0.0, 0.0, 1.0]
        return f"""%YAML:1.0
---
image_width: {self.width}
image_height: {self.height}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {matrix}
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: {list(DISTORTION)}
"""

    def _off_middle(self) -> Tensor:
        v, u = torch.meshgrid(torch.arange(self.height) + 0.5, torch.arange(self.width) + 0.5, indexing="ij")
        return torch.hypot(u - self.width / 2, v - self.height / 2)


def distort(x: Array, y: Array) -> tuple[Array, Array]:
    """Where the distorted image shows the ray (x, y, 1), in focal lengths from its middle (OpenCV's model)."""
    k1, k2, p1, p2, k3 = DISTORTION
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    aside_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
    aside_y = p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return x * radial + aside_x, y * radial + aside_y
