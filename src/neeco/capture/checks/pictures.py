"""Images and masks of a capture, reduced to the sizes at which checks compare them: each file is read once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from neeco.capture.images import byte_pixels
from neeco.capture.model import Frame

Size = tuple[int, int]  # width and height, px
Result = TypeVar("Result")


def in_threads(function: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Return `list(map(function, *arguments))`, computed in threads: Pillow, OpenCV and NumPy let others run."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, *arguments))


class Pictures:
    """Reduced images and masks, kept from when the files were checked or read on demand."""

    def __init__(self) -> None:
        self._images: dict[tuple[Path, Size], np.ndarray] = {}
        self._masks: dict[tuple[Path, Size], np.ndarray] = {}

    def keep(self, frame: Frame, pixels: np.ndarray, mask: np.ndarray | None, sizes: Iterable[Size]) -> None:
        """Reduce a frame's pixels [H, W, 3], uint8 or in [0, 1], and its mask bool [H, W] to some sizes."""
        for size in sizes:
            self._images[frame.image_path, size] = _reduced(byte_pixels(pixels), size)
            if mask is not None and frame.mask_path is not None:
                self._masks[frame.mask_path, size] = _reduced(mask.astype(np.float32), size)

    def image(self, frame: Frame, size: Size) -> np.ndarray:
        """A frame's image, uint8 [h, w, 3]. Raises NeecoError when it cannot be read."""
        key = frame.image_path, size
        if key not in self._images:
            self._images[key] = _reduced(byte_pixels(frame.load_pixels()), size)
        return self._images[key]

    def mask(self, frame: Frame, size: Size) -> np.ndarray | None:
        """Share of each pixel that counts, float32 [h, w]; None where the frame has no mask. Raises NeecoError."""
        if frame.mask_path is None:
            return None
        key = frame.mask_path, size
        if key not in self._masks:
            mask = frame.load_mask_pixels()
            assert mask is not None
            self._masks[key] = _reduced(mask.astype(np.float32), size)
        return self._masks[key]


def _reduced(image: np.ndarray, size: Size) -> np.ndarray:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
