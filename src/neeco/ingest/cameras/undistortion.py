"""Undistort the images and masks of a folder whose cameras state their lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from neeco.capture.images import write_image, write_labels
from neeco.capture.model import Frame
from neeco.errors import NeecoError
from neeco.geometry.lens import Border, Lens


@dataclass(frozen=True)
class Undistorted:
    """Frames as pinholes see them."""

    frames: tuple[Frame, ...]
    lens: Lens | None  # through which all of them were recorded; None: there is no distortion, or several lenses
    notes: list[str]


def undistort_frames(frames: Sequence[Frame], folder: Path, border: Border | None) -> Undistorted:
    """The frames, those whose cameras are distorted undistorted into `folder`, as PNG.

    border: of the round field of view in the images as recorded. Raises NeecoError for an image that cannot be read and
    a distortion that folds the image over, naming the image.
    """
    count = sum(bool(frame.camera.distortion) for frame in frames)
    if not count:
        return Undistorted(tuple(frames), None, [])
    first, *others = {Lens.of(frame.camera): None for frame in frames}
    lens = None if others else replace(first, border=border)
    note = f"of their {1 + len(others)} lenses none is kept" if lens is None else "their lens is kept"
    straight = [_undistort(frame, folder / str(order)) for order, frame in enumerate(frames)]
    return Undistorted(tuple(straight), lens, [f"{count} of {len(frames)} images are undistorted; {note}."])


def _undistort(frame: Frame, folder: Path) -> Frame:
    if not frame.camera.distortion:
        return frame
    lens = Lens.of(frame.camera)
    assert lens.size is not None
    try:
        pinhole = lens.pinhole(lens.size)
    except NeecoError as error:
        raise NeecoError(f"{frame.image_path}: {error}") from None
    # the parent's name stays: where two images share a stem it tells them apart
    image = folder / frame.image_path.parent.name / f"{frame.name}.png"
    pixels = lens.undistort(frame.load_image_bytes().numpy())
    write_image(image, torch.from_numpy(pixels.astype(np.float32) / 255))
    mask, mask_path = frame.load_mask(), None
    if mask is not None:
        mask_path = folder / "mask.png"
        write_labels(mask_path, torch.from_numpy(lens.undistort_mask(mask.numpy()).astype(np.uint8) * 255))
    camera = pinhole.camera(frame.camera.world_from_camera.numpy())
    return replace(frame, image_path=image, camera=camera, mask_path=mask_path)
