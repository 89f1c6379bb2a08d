"""How well every recorded frame is drawn: found out coarsely and bit by bit, so that nobody waits for it."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from neeco.evaluation.image_metrics import psnr, resize_camera
from neeco.evaluation.mask_folders import load_reference
from neeco.evaluation.mask_metrics import iou
from neeco.labels.drawing import draw
from neeco.raster.types import Camera
from neeco.viewer.source import Loaded

WIDTH = 320  # px at most, of the drawings that are compared
FIELD_WIDTH = 48  # px, of a field's, which take a hundred times as long
WORST = 8  # frames that are listed


@dataclass(frozen=True)
class Score:
    """How well one recorded frame is drawn."""

    psnr: float  # dB
    iou: float | None  # of all instruments together; None: nobody drew a true mask, or the scene has no labels


@torch.no_grad()
def score_frame(loaded: Loaded, index: int) -> Score:
    """What `neeco evaluate` would say of one frame of `loaded.frames`. Raises NeecoError for unreadable files."""
    frame = loaded.frames[index]
    counted = frame.load_mask()
    drawing = draw(loaded.scene, frame.state, frame.camera)
    overlap = None
    if drawing.parts is not None and loaded.capture is not None:
        reference = load_reference(loaded.capture, frame)
        if reference is not None:
            overlap = iou(drawing.parts > 0, reference.mask, counted)
    return Score(psnr(drawing.image, frame.load_image(), counted), overlap)


class Timeline:
    """The PSNR of every frame of a recording, at no more than WIDTH px, a frame at a time: first a few from everywhere,
    then those between them."""

    def __init__(self, loaded: Loaded) -> None:
        self.loaded = loaded
        self._left = spread_order(len(loaded.frames))[::-1]
        self._known: dict[int, float] = {}
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Is every frame known?"""
        return not self._left

    def advance(self) -> None:
        """Find out about one more frame; of one that cannot be read, nothing is known."""
        index = self._left.pop()
        value = coarse_psnr(self.loaded, index)
        if math.isfinite(value):
            with self._lock:
                self._known[index] = value

    @property
    def count(self) -> int:
        """How many frames are known."""
        return len(self._known)

    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames [K], rising, and their PSNR [K] in dB, as far as they are known."""
        with self._lock:
            frames = sorted(self._known)
            return np.array(frames, np.int64), np.array([self._known[k] for k in frames], np.float64)

    def worst(self) -> list[tuple[int, float]]:
        """(frame, PSNR) of the worst known frames, worst first; of neighbours, which look alike, only the worst."""
        frames, values = self.known()
        apart = max(1, len(self.loaded.frames) // (4 * WORST))
        chosen: list[tuple[int, float]] = []
        for k in np.argsort(values, kind="stable"):
            if all(abs(int(frames[k]) - other) >= apart for other, _ in chosen):
                chosen.append((int(frames[k]), float(values[k])))
            if len(chosen) == WORST:
                break
        return chosen


@torch.no_grad()
def coarse_psnr(loaded: Loaded, index: int) -> float:
    """PSNR in dB of one frame, drawn and photographed at no more than WIDTH px. Raises NeecoError."""
    frame = loaded.frames[index]
    camera = narrowed(frame.camera, WIDTH if loaded.scene.has_gaussians else FIELD_WIDTH)
    size = camera.width, camera.height
    photograph = cv2.resize(frame.load_image().numpy(), size, interpolation=cv2.INTER_AREA)
    mask = frame.load_mask()
    if mask is not None:
        mask = torch.from_numpy(cv2.resize(mask.numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
    drawn = loaded.scene.render(frame.state, camera).color.clamp(0, 1).cpu()
    return psnr(drawn, torch.from_numpy(photograph), mask)


def narrowed(camera: Camera, width: int) -> Camera:
    """The same view in an image of at most `width` px."""
    return camera if camera.width <= width else resize_camera(camera, width / camera.width)


def spread_order(count: int) -> list[int]:
    """0 to count - 1, so that any first few of them are from everywhere."""
    bits = max(1, (count - 1).bit_length())
    mirrored = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [k for k in mirrored if k < count]
