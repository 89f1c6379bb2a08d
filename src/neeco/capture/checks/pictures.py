"""One pass over a capture's images and masks: faults of each file, and reduced images for the comparisons."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.checks.settings import SETTINGS
from neeco.capture.images import Hidden, byte_pixels, measure_hidden
from neeco.capture.model import Frame, evenly_spaced
from neeco.capture.points import measured_sample
from neeco.capture.readers.parsed import Parsed

Result = TypeVar("Result")


@dataclass(kw_only=True)
class Picture:
    """A frame's image and mask, decoded once. Errors name files without their folders."""

    digest: bytes | None = None  # of the pixels; None when not readable
    image: np.ndarray | None = None  # uint8 [h, w, 3], at most SETTINGS.compared_width px wide; None: not used
    mask: np.ndarray | None = None  # float32 [h, w], share of each pixel that counts; None: all
    uniform: bool = False  # one colour
    hidden: Hidden | None = None  # content hidden by the mask; None: no usable mask
    image_error: str = ""
    mask_error: str = ""


def in_threads(function: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """Return `list(map(function, *arguments))`, computed in threads: Pillow, OpenCV and NumPy release the GIL."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return list(pool.map(function, *arguments))


def compared_rows(parsed: Parsed) -> np.ndarray:
    """Return the frames [F] whose images are compared with points and states."""
    return np.array(evenly_spaced(len(parsed.frames), SETTINGS.max_images))


def read_pictures(parsed: Parsed) -> list[Picture]:
    """Decode the image and the mask of every frame."""
    compared = set(compared_rows(parsed).tolist())
    points = measured_sample(parsed.points)
    return in_threads(partial(_read, parsed, compared, points), range(len(parsed.frames)))


def resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an image area-averaged to (width, height)."""
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _read(parsed: Parsed, compared: set[int], points: np.ndarray, row: int) -> Picture:
    frame, picture, pixels = parsed.frames[row], Picture(), None
    try:
        pixels = frame.load_pixels()
        picture.digest = hashlib.blake2b(pixels.tobytes(), digest_size=16).digest()
        picture.uniform = bool((pixels[0] == pixels[0, 0]).all() and (pixels == pixels[0, 0]).all())
        if row in compared:
            picture.image = resized(byte_pixels(pixels), reduced_size(frame))
    except NeecoError as error:
        picture.image_error = str(error).replace(str(frame.image_path), frame.image_path.name)
    try:
        counted = frame.load_mask()
        mask = None if counted is None else counted.numpy()
        if mask is not None and not mask.any():
            picture.mask_error = "ignores every pixel; invert it (black is ignored), or write 255 instead of 1"
        elif mask is not None and pixels is not None:
            camera = None if row in parsed.without_camera else frame.camera
            picture.hidden = measure_hidden(pixels, mask, camera, points)
            picture.mask = resized(mask.astype(np.float32), reduced_size(frame)) if row in compared else None
    except NeecoError as error:
        picture.mask_error = str(error).replace(str(frame.mask_path), frame.mask_path.name if frame.mask_path else "")
    return picture


def reduced_size(frame: Frame) -> tuple[int, int]:
    """Return (width, height) px to which a frame's image is reduced."""
    factor = min(1.0, SETTINGS.compared_width / frame.camera.width)
    return round(frame.camera.width * factor), max(1, round(frame.camera.height * factor))
