"""A shaft with a head of another colour that turns about a trocar, before tissue, as a scope with a lamp sees it."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from neeco.geometry.lines import unit
from neeco.ingest.shaft.axis import ShaftVideo

WIDTH, HEIGHT, FOCAL, FRAMES, RATE = 160, 120, 142.0, 24, 12.0
INTRINSICS = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
RADIUS, HEAD, FINER = 3.0, 16.0, 2  # mm, mm, samples of a pixel each way
TROCAR = np.array([70.0, 55.0, -20.0])
SHAFT, TIP = np.array([0.10, 0.10, 0.12]), np.array([0.55, 0.5, 0.42])  # light


@dataclass
class ShaftWorld:
    """still: the scope stands still; `images` uint8 [F, h, w, 3] and `masks`, and the truth in the cameras' frames."""

    still: bool = False
    frames: int = FRAMES
    reach: float = 1.0  # by which the cameras move farther
    even: bool = False  # the head has the shaft's colour
    wrist: float = 0.0  # mm between shaft and head, of the shaft's colour and thinner
    images: np.ndarray = field(init=False)
    masks: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.times = np.arange(self.frames) / RATE
        generator = np.random.default_rng(3)
        noise = generator.normal(0, 1, (2 * HEIGHT, 2 * WIDTH)).astype(np.float32)
        texture = 2 * cv2.GaussianBlur(noise, (0, 0), 2.0) + 5 * cv2.GaussianBlur(noise, (0, 0), 6.0)
        self.tissue = np.clip((0.30 + 0.06 * texture)[..., None] * [1.3, 0.6, 0.5], 0.03, 0.9)
        drawn = [self._draw(frame) for frame in range(self.frames)]
        self.images, self.masks = (np.stack(part) for part in zip(*drawn, strict=True))

    def camera(self, frame: int) -> np.ndarray:
        """world_from_camera [4, 4]."""
        pose = np.eye(4)
        if not self.still:
            pose[:3, 3] = [4 * np.sin(1.1 * self.times[frame]), 3 * np.cos(1.7 * self.times[frame]), 0]
            pose[:3, 3] *= self.reach
        return pose

    def line(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Where the shaft ends [3] mm, and its direction [3], in the camera's frame."""
        time = self.times[frame]
        end = np.array([-2 + 9 * np.sin(1.3 * time), -3 + 7 * np.sin(2.1 * time + 1), 62 + 6 * np.sin(1.7 * time)])
        direction = unit(end - TROCAR)
        end = end + 6 * np.sin(2.3 * time) * direction
        return end - self.camera(frame)[:3, 3], direction

    def scene(self, trocar: bool = True, unit_mm: float = 1.0) -> ShaftVideo:
        """What `find_shaft` is told; unit_mm: of the cameras' places, which is then not known."""
        cameras = np.stack([self.camera(frame) for frame in range(self.frames)])
        cameras[:, :3, 3] /= unit_mm
        return ShaftVideo(
            world_from_camera=cameras,
            times=self.times,
            episodes=np.zeros(self.frames),
            radius=RADIUS,
            intrinsics=INTRINSICS,
            trocar=trocar,
            scaled=unit_mm == 1.0,
        )

    def _draw(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        y, x = (np.mgrid[: HEIGHT * FINER, : WIDTH * FINER] + 0.5) / FINER
        rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones(x.shape)], -1)
        end, axis = self.line(frame)
        depth, light, part = np.full(x.shape, np.inf), np.zeros((*x.shape, 3)), np.zeros(x.shape, bool)
        parts = [(RADIUS, -300.0, 0.0, SHAFT), (0.85 * RADIUS, 0.0, self.wrist, SHAFT)]
        parts += [(0.7 * RADIUS, self.wrist, self.wrist + HEAD, SHAFT if self.even else TIP)]
        for radius, low, high, color in parts:
            across = rays - (rays @ axis)[..., None] * axis
            offset = end - (end @ axis) * axis
            a, b, c = (across**2).sum(-1), across @ offset, offset @ offset - radius**2
            root = b**2 - a * c
            near = (b - np.sqrt(np.maximum(root, 0))) / a
            along = near * (rays @ axis) - end @ axis
            hit = (root > 0) & (near > 0) & (along > low) & (along < high) & (near < depth)
            normal = (near[..., None] * rays - end - along[..., None] * axis) / radius
            facing = np.maximum(-(normal * unit(rays)).sum(-1), 0)
            light = np.where(hit[..., None], color * (0.15 + facing[..., None]), light)
            depth, part = np.where(hit, near, depth), part | hit
        shift = np.zeros(2) if self.still else self.camera(frame)[:2, 3] * FOCAL / 100
        matrix = np.array([[1, 0, shift[0] + WIDTH / 2], [0, 1, shift[1] + HEIGHT / 2]], np.float32)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        behind = cv2.warpAffine(self.tissue.astype(np.float32), matrix, (WIDTH, HEIGHT), flags=flags)
        behind = behind.repeat(FINER, 0).repeat(FINER, 1)
        light = np.where(part[..., None], light, behind)
        pixels = light.reshape(HEIGHT, FINER, WIDTH, FINER, 3).mean((1, 3))
        coded = 255 * cv2.GaussianBlur(pixels, (0, 0), 0.5).clip(0, 1) ** (1 / 2.2)
        coded += np.random.default_rng(frame).normal(0, 1.5, coded.shape)
        covered = part.reshape(HEIGHT, FINER, WIDTH, FINER).mean((1, 3))
        return np.clip(np.rint(coded), 0, 255).astype(np.uint8), covered > 0.5
