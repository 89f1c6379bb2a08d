"""The same view at another resolution."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor
from torch.nn.functional import interpolate

from neeco.raster.types import Camera


def resize_camera(camera: Camera, factor: float) -> Camera:
    """The same pinhole with `factor` times the pixels along each side (rounded to whole pixels, at least one)."""
    width, height = max(1, round(camera.width * factor)), max(1, round(camera.height * factor))
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=camera.cx * across,  # pixel centres lie at +0.5, so scaling needs no offset
        cy=camera.cy * down,
        width=width,
        height=height,
    )


def resize_image(image: Tensor, camera: Camera) -> Tensor:
    """Area-average an image [H, W, C] to the camera's size."""
    planes = image.permute(2, 0, 1)[None]
    return interpolate(planes, size=(camera.height, camera.width), mode="area")[0].permute(1, 2, 0)


def resize_mask(mask: Tensor, width: int, height: int) -> Tensor:
    """Nearest-neighbour resize of a bool mask [H, W]."""
    return interpolate(mask[None, None].float(), size=(height, width), mode="nearest-exact")[0, 0] > 0.5
