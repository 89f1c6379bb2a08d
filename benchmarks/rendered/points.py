"""Sparse points as structure from motion would find them. float64, mm."""

from __future__ import annotations

import numpy as np

from rendered.motion import Array, Moment
from rendered.render import Drawing, Lens

POINTS, OUTLIERS, ON_INSTRUMENT = 4500, 0.015, 0.003  # how many, and what shares of them


class PointSampler:
    """Gathers sparse points as SfM would find them: on texture, from many frames, scene frame."""

    def __init__(self, frames: int, generator: np.random.Generator) -> None:
        self.each = -(-POINTS // frames)
        self.generator = generator
        self.positions: list[Array] = []
        self.colors: list[Array] = []

    def take(self, moment: Moment, drawing: Drawing, pixels: Array, lens: Lens) -> None:
        """Pick points of one frame: tissue where the image has texture, hardly ever the instrument. They err by as
        many pixels at every size."""
        grey = pixels.astype(np.float64).mean(-1)
        texture = np.hypot(*np.gradient(grey)) + 0.5
        texture[grey > 225] = 0  # highlights move; SfM throws them out
        parts = drawing.parts.numpy()
        texture[parts > 0] *= ON_INSTRUMENT * (parts == 0).sum() / max(1, (parts > 0).sum())
        chances = texture.ravel() / texture.sum()
        chosen = self.generator.choice(chances.size, min(self.each, chances.size // 4), replace=False, p=chances)
        rays = lens.rays().numpy()[chosen].astype(np.float64)
        depth = drawing.depth.numpy().ravel()[chosen, None].astype(np.float64)
        points = rays * depth
        pixel = Lens.focal / lens.focal  # against that of the smallest size
        points += self.generator.normal(0, 0.15 * pixel, points.shape)
        points += rays * self.generator.normal(0, 0.35 * pixel, depth.shape)  # worst along the line of sight
        wild = self.generator.random(len(points)) < OUTLIERS
        points[wild] += rays[wild] * self.generator.normal(0, 6.0, (int(wild.sum()), 1))
        pose = moment.scene_from_camera
        self.positions.append(points @ pose[:3, :3].T + pose[:3, 3])
        self.colors.append(pixels.reshape(-1, 3)[chosen] / 255)
