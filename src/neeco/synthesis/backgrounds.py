"""Appearance of another operation: instruments over images of its tissue, in its light, in its frames' colours.

Half of a data set's images keep the scene's tissue, and half its colours, so that both are learned.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes
from neeco.capture.images import image_files, image_size, read_image_bytes
from neeco.geometry.camera import Camera
from neeco.raster import rasterize
from neeco.raster.reference import SH_C0
from neeco.raster.types import Gaussians
from neeco.synthesis.camera_effects import linear_to_srgb, srgb_to_linear
from neeco.synthesis.settings import Settings


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings:
    """Settings of background images, and of colour transfer from other images."""

    min_crop: float = 0.7  # minimum side of a crop, relative to the largest crop of this shape
    min_side_px: int = 32  # minimum side of an image: smaller ones are icons
    cached_images: int = 64  # decoded
    min_share: float = 0.02  # minimum share of a pixel for a known instrument colour
    shadow_blur_px: float = 1.5  # standard deviation of the blur of shadows extrapolated at the instrument's edge
    clear_tissue: float = 0.5  # minimum share of tissue in a pixel for measuring the shadow on it
    replaced: float = 0.5  # share of images with a background, and of those with transferred colours
    border: float = 12 / 255  # maximum brightness of an endoscope's black border
    dark: float = 1e-3  # minimum mean light, of white
    adaptation_range: tuple[float, float] = (0.25, 4.0)  # range of gains computed from other images
    shadow_range: tuple[float, float] = (0.2, 1.1)  # range of the light left in a shadow; above 1: rendering errors


IMAGES = BackgroundSettings()


@dataclass(frozen=True)
class ImageFolder:
    """Images of another operation."""

    files: tuple[Path, ...]

    @classmethod
    def of(cls, folder: str | Path, setting: str) -> ImageFolder:
        """Return the images in a folder named by a setting, sorted by name. Raises NeecoError if there is none, or one
        is too small or unreadable."""
        place, option = Path(folder), setting.replace("_", "-")
        if not place.is_dir():
            raise NeecoError(f"--{option}: {folder}: no such folder; give one with images of another operation")
        files = image_files(place)
        if not files:
            raise NeecoError(f"--{option}: {folder}: has no image; give .png or .jpg files")
        for file in files:
            if min(image_size(file)) < IMAGES.min_side_px:
                raise NeecoError(f"--{option}: {file}: is smaller than {IMAGES.min_side_px} px; leave it out")
        return cls(files)

    def digest(self) -> str:
        """Return the SHA-256 of the files' content, in order."""
        content = b"".join(hashlib.sha256(read_bytes(file, "an image")).digest() for file in self.files)
        return hashlib.sha256(content).hexdigest()

    def crop(self, number: int, rng: Generator, width: int, height: int) -> np.ndarray:
        """Sample a background, float32 [height, width, 3] in [0, 1]: a random crop of an image, possibly mirrored,
        resized. Raises NeecoError where the file cannot be read."""
        image = _DECODED(self.files[number])
        rows, columns = image.shape[:2]
        scale = rng.uniform(IMAGES.min_crop, 1) * min(columns / width, rows / height)
        size = max(1, int(scale * width)), max(1, int(scale * height))
        left, top = (int(rng.integers(whole - part + 1)) for whole, part in zip((columns, rows), size, strict=True))
        crop = image[top : top + size[1], left : left + size[0]]
        crop = crop[:: rng.choice((1, -1)), :: rng.choice((1, -1))]
        way = cv2.INTER_AREA if scale > 1 else cv2.INTER_LINEAR
        return cv2.resize(np.ascontiguousarray(crop), (width, height), interpolation=way).astype(np.float32) / 255


_DECODED = lru_cache(maxsize=IMAGES.cached_images)(read_image_bytes)


@dataclass(frozen=True)
class Colors:
    """Mean [3] and standard deviation [3] of the stored colours of an image, without its black border."""

    mean: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray) -> Colors:
        """Return the colours of an image [H, W, 3] in [0, 1]."""
        lit = image[image.max(2) > IMAGES.border]
        if not len(lit):
            lit = image.reshape(-1, 3)
        return cls(lit.mean(0), lit.std(0))

    def given_to(self, image: np.ndarray) -> np.ndarray:
        """Return an image [H, W, 3] with these colours (Reinhard et al., "Color transfer", 2001, in RGB)."""
        colors = Colors.of(image)
        gains = np.clip(self.deviation / np.maximum(colors.deviation, IMAGES.dark), *IMAGES.adaptation_range)
        return np.clip((image - colors.mean) * gains + self.mean, 0, 1).astype(np.float32)


@lru_cache(maxsize=4096)
def _colors_of_file(file: Path) -> Colors:
    return Colors.of(read_image_bytes(file).astype(np.float32) / 255)


@dataclass(frozen=True)
class Appearance:
    """A background, its file name, the light on the instruments over it, and colours; None: as recorded.

    The mean light of a background differs from that of the scene's tissue because of the tissue itself, and of camera
    and lamps, which affect instruments as well: these are multiplied per channel by the ratio to the power of
    `adaptation`.
    """

    source: str | None = None
    background: Tensor | None = None  # [H, W, 3] in [0, 1]
    adaptation: float = 0.0  # in [0, 1]
    colors: Colors | None = None

    def over_background(self, layers: Layers) -> Tensor:
        """Return the image [H, W, 3] of these layers over the background."""
        assert self.background is not None
        share = layers.share.clamp(min=IMAGES.min_share)[..., None].numpy()
        alone = np.clip(layers.instruments.numpy() / share, 0, 1)
        images = (self.background, layers.tissue)
        background, tissue = (srgb_to_linear(image.numpy()).mean((0, 1)) + IMAGES.dark for image in images)
        gains = np.clip((background / tissue) ** self.adaptation, *IMAGES.adaptation_range)
        alone = linear_to_srgb(srgb_to_linear(alone) * gains)
        return replace(layers, instruments=torch.from_numpy((alone * share).astype(np.float32))).over(self.background)


@dataclass(frozen=True)
class Appearances:
    """The appearances of a data set."""

    backgrounds: ImageFolder | None = None
    frames: ImageFolder | None = None  # whose colours half of the images take on

    @classmethod
    def of(cls, settings: Settings) -> Appearances:
        """Return the appearances that settings describe. Raises NeecoError for a folder without images."""
        folders = {name: ImageFolder.of(folder, name) for name, folder in settings.image_folders().items()}
        return cls(folders.get("backgrounds"), folders.get("match_colors"))

    def draw(self, rng: Generator, width: int, height: int) -> Appearance:
        """Sample the appearance of an image. Raises NeecoError where a background cannot be read."""
        replaced, adaptation, place, matched, frame = rng.random(5)
        appearance = Appearance()
        if self.frames is not None and matched < IMAGES.replaced:
            file = self.frames.files[int(frame * len(self.frames.files))]
            appearance = replace(appearance, colors=_colors_of_file(file))
        if self.backgrounds is None or replaced >= IMAGES.replaced:
            return appearance
        number = int(place * len(self.backgrounds.files))
        background = torch.from_numpy(self.backgrounds.crop(number, rng, width, height))
        source = self.backgrounds.files[number].name
        return replace(appearance, source=source, background=background, adaptation=adaptation)


ALL_AS_RECORDED = Appearances()


@dataclass(frozen=True)
class Layers:
    """Layers of a rendering: image is about instruments + (1 - share) * shadow * tissue."""

    instruments: Tensor  # [H, W, 3] in [0, 1], times their share of the pixel
    share: Tensor  # [H, W] in [0, 1], of instruments in a pixel
    shadow: Tensor  # [H, W] factor on the tissue's light by the instruments' shadow
    tissue: Tensor  # [H, W, 3] in [0, 1], without instruments and shadow

    def over(self, background: Tensor) -> Tensor:
        """Return the image [H, W, 3] over a `background` [H, W, 3]."""
        return (self.instruments + ((1 - self.share) * self.shadow)[..., None] * background).clamp(0, 1)


@torch.no_grad()
def split(gaussians: Gaussians, owners: Tensor, camera: Camera, image: Tensor, share: Tensor) -> Layers:
    """Split the rendering `image` [H, W, 3] of posed Gaussians into layers, on the CPU.

    owners [N]: -1 tissue, else an instrument; share [H, W]: of instruments in each pixel. The shadow is the smoothed
    ratio of tissue with the instruments to tissue without; under instruments it is that of the nearest tissue.
    """
    of_tissue = owners < 0
    black = gaussians.sh.clone()
    black[of_tissue] = 0
    black[of_tissue, 0] = -0.5 / SH_C0
    instruments = rasterize(replace(gaussians, sh=black, background=None), camera).color.clamp(0, 1).cpu()
    instruments = instruments * (share > 0)[..., None]  # unlabelled components are not part of the layer
    tissue = rasterize(gaussians.select(of_tissue), camera).color.clamp(0, 1).cpu()
    clear = ((1 - share) * (share < IMAGES.clear_tissue)).numpy()
    behind = (image - instruments).clamp(0, 1)
    lit = tissue.mean(2).numpy() * clear
    ratio = (_smoothed(behind.mean(2).numpy() * (clear > 0)) + IMAGES.dark) / (_smoothed(lit) + IMAGES.dark)
    shadow = torch.from_numpy(np.clip(ratio, *IMAGES.shadow_range).astype(np.float32))
    return Layers(instruments, share, shadow, tissue)


def _smoothed(plane: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(plane, (0, 0), IMAGES.shadow_blur_px)
