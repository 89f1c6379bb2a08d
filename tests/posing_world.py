"""A textured rod with two jaws that turns and opens before a grey wall, as found in a video: its shaft is known, its
roll and its jaws are not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from neeco.capture.model import Capture, Frame, FromVideo, Instrument, InstrumentState, PointCloud, State, Uncertainty
from neeco.capture.readers import read_capture
from neeco.capture.writer import write_capture
from neeco.geometry.camera import Camera
from neeco.ingest.posing.posed_capture import prepare

WIDTH, HEIGHT, FOCAL = 160, 120, 200.0
RADIUS, LENGTH, HINGE = 3.0, 24.0, 9.0  # mm
JAW_MM = 1.0  # half as wide as a jaw is
NAME, JOINT = "rod", "jaw_angle"


@dataclass(frozen=True, eq=False)
class PosingWorld:
    """rolls and jaws [F] rad: the truth; masks bool [F, H, W]."""

    root: Path
    capture: Capture
    rolls: np.ndarray
    jaws: np.ndarray
    masks: np.ndarray


def posing_world(root: Path, count: int = 40) -> PosingWorld:
    """A capture as `neeco ingest` makes one from a video and the shaft's diameter, but for what posing measures."""
    times = np.arange(count) / 25
    rolls = 0.9 * np.sin(2.2 * times)
    jaws = 0.5 + 0.4 * np.sin(3.0 * times + 1)
    texture = gaussian_filter(np.random.default_rng(3).normal(size=(120, 120)), 2.0, mode="wrap")
    texture = 120 + 60 * texture / texture.std()
    images, masks, frames = [], [], []
    for frame in range(count):
        origin = np.array([4 * np.sin(times[frame]), 3 * np.cos(1.3 * times[frame]), 75.0])
        direction = np.array([1.0, 0.15 * np.sin(1.7 * times[frame]), 0.35])
        direction /= np.linalg.norm(direction)
        across = np.cross(direction, -origin)
        across /= np.linalg.norm(across)
        towards = np.cross(across, direction)
        x = np.cos(rolls[frame]) * towards + np.sin(rolls[frame]) * across
        image, mask = _draw(origin, np.stack([x, np.cross(direction, x), direction], -1), jaws[frame], texture)
        images.append(image)
        masks.append(mask)
        pose = np.eye(4)  # of no meaning about the shaft
        pose[:3, :3], pose[:3, 3] = np.stack([across, np.cross(direction, across), direction], -1), origin
        unsure = Uncertainty((0.2, 0.2, 1.0), (1.0, 1.0, 180.0))
        state = State({NAME: InstrumentState(pose, {}, None, unsure)}, float(times[frame]))
        camera = Camera(torch.eye(4), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
        frames.append(Frame(Path(f"{frame:06d}.png"), camera, state, "train"))
    instrument = Instrument(NAME, from_video=FromVideo(2 * RADIUS, LENGTH))
    points = PointCloud(np.array([[0.0, 0.0, 140.0]], np.float32), np.array([[0.5, 0.5, 0.5]], np.float32))
    write_capture(Capture(root, tuple(frames), (instrument,), points), root, images=images)
    return PosingWorld(root, read_capture(root), rolls, jaws, np.stack(masks))


def measured_world(root: Path) -> PosingWorld:
    """The same with what its images tell of roll and jaws."""
    world = posing_world(root)
    prepare(world.root, {NAME: lambda frame: world.masks[frame]})
    return world


def _draw(origin: np.ndarray, axes: np.ndarray, jaw: float, texture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One image uint8 [H, W, 3] and where the instrument is in it; axes [3, 3]: its x, y, z in the camera's."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1) @ axes
    center = origin @ axes
    # where a ray meets the cylinder about z
    a = (rays[..., :2] ** 2).sum(-1)
    b = -(rays[..., :2] * center[:2]).sum(-1)
    root = b**2 - a * ((center[:2] ** 2).sum() - RADIUS**2)
    depth = (-b - np.sqrt(np.maximum(root, 0))) / a
    points = depth[..., None] * rays - center
    on_rod = (root > 0) & (points[..., 2] < HINGE)
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    row, column = (points[..., 2] * 4).astype(int) % 120, np.floor(azimuth / (2 * np.pi) * 120).astype(int) % 120
    image = np.full((HEIGHT, WIDTH), 90.0)
    image[on_rod] = texture[row, column][on_rod]
    mask = on_rod.astype(np.uint8)
    for side in (-1, 1):
        along = np.linspace(0, LENGTH - HINGE, 40)
        bent = np.stack([0 * along, side * np.sin(jaw / 2) * along, HINGE + np.cos(jaw / 2) * along], -1)
        seen = bent @ axes.T + origin
        pixels = seen[:, :2] / seen[:, 2:] * FOCAL + (WIDTH / 2, HEIGHT / 2)
        thick = round(2 * JAW_MM * FOCAL / float(seen[:, 2].mean()))
        for canvas, color in ((image, 200.0), (mask, 1)):
            cv2.polylines(canvas, [np.round(pixels).astype(np.int32)], False, color, thick)
    return np.repeat(image.clip(0, 255).astype(np.uint8)[..., None], 3, 2), mask.astype(bool)
