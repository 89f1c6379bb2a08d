"""Cut-and-paste (Dwibedi et al., "Cut, Paste and Learn", 2017): labelled instruments over backgrounds without one."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.images import image_files, read_image_bytes
from neeco.studies.downstream.samples import Example, RecordedSample, loaded


@dataclass(frozen=True, kw_only=True)
class PasteSettings:
    """Images that are made, and how far instruments are moved in them."""

    images: int = 400
    margin: float = 0.02  # of the image's longer side: what is about an instrument (shadow, blur) is filled in, too
    fill_side: int = 160  # px, the longer side at which holes are filled: what is put there is smooth
    edge_sd: float = 0.8  # px, of the soft edge
    max_turn: float = 20.0  # degrees
    max_zoom: float = 1.25  # larger or smaller
    max_shift: float = 0.15  # of a side
    max_gain: float = 0.2  # of the pasted instrument's brightness


@dataclass(frozen=True)
class Backgrounds:
    """Images without an instrument: files, else the labelled frames with their instruments filled in.

    Where the camera stands still a pixel is filled by its median over the frames that show it; what none shows, and
    where the camera moves, by inpainting (Telea, 2004).
    """

    samples: tuple[RecordedSample, ...]
    files: tuple[Path, ...] = ()
    settings: PasteSettings = PasteSettings()

    def __len__(self) -> int:
        return len(self.files or self.samples)

    def image(self, index: int, size: tuple[int, int]) -> np.ndarray:
        """The image uint8 [H, W, 3] of this number, at this size (width, height)."""
        if not self.files:
            return self._filled(loaded(self.samples[index]))
        return cv2.resize(read_image_bytes(self.files[index]).numpy(), size, interpolation=cv2.INTER_AREA)

    def _filled(self, example: Example) -> np.ndarray:
        """The image with its instruments filled in."""
        image, hole = example.image, self._covered(example)
        if self._median is not None:
            image = np.where((hole & self._median.any(2))[..., None], self._median, image)
            hole = hole & ~self._median.any(2)
        if not hole.any() or hole.all():
            return image
        height, width = hole.shape
        scale = min(1.0, self.settings.fill_side / max(height, width))
        small = max(1, round(width * scale)), max(1, round(height * scale))
        mask = cv2.resize(hole.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST)
        mask = cv2.dilate(mask, np.ones((3, 3), np.uint8))
        smooth = cv2.inpaint(cv2.resize(image, small, interpolation=cv2.INTER_AREA), mask, 3, cv2.INPAINT_TELEA)
        return np.where(hole[..., None], cv2.resize(smooth, (width, height)), image)

    def _covered(self, example: Example) -> np.ndarray:
        """bool [H, W]: an example's instruments and what is close to them."""
        reach = round(self.settings.margin * max(example.classes.shape))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        return cv2.dilate((example.classes > 0).astype(np.uint8), kernel) > 0

    @cached_property
    def _median(self) -> np.ndarray | None:
        """Median of the frames uint8 [H, W, 3], black where none shows a pixel; None where the camera moves."""
        poses = [sample.frame.camera.world_from_camera.numpy() for sample in self.samples]
        if len(poses) < 2 or not all(np.allclose(pose, poses[0], atol=1e-4) for pose in poses):
            return None
        examples = [loaded(sample) for sample in self.samples[:: -(-len(self.samples) // 25)]]  # some are as good
        shown = np.stack([np.where(self._covered(item)[..., None], np.nan, item.image) for item in examples])
        shown[:, np.isnan(shown[..., 0]).all(0)] = 0
        return np.nanmedian(shown, axis=0).round().astype(np.uint8)


@dataclass(frozen=True)
class PastedSample:
    """A labelled frame's instruments, flipped, turned, scaled and shifted, over a background; all by its number."""

    backgrounds: Backgrounds
    number: int
    seed: int
    source_key: int  # what distinguishes it from those of other frames

    @property
    def name(self) -> str:
        return f"pasted{self.number:06d}"

    @property
    def key(self) -> Hashable:
        return "pasted", self.source_key, self.seed, self.number

    def load(self) -> Example:
        """Raises NeecoError where a frame cannot be read."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, self.number]))
        sources, settings = self.backgrounds.samples, self.backgrounds.settings
        source = loaded(sources[rng.integers(len(sources))])
        size = source.classes.shape[::-1]
        background = self.backgrounds.image(int(rng.integers(len(self.backgrounds))), size)
        background = background[:, :: int(rng.choice([-1, 1]))]
        matrix = _placement(size, rng, settings)
        # a shaft goes on where the image that it is cut from ends
        edge = cv2.BORDER_REPLICATE
        pixels = cv2.warpAffine(source.image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=edge)
        classes = cv2.warpAffine(source.classes, matrix, size, flags=cv2.INTER_NEAREST, borderMode=edge)
        alpha = cv2.GaussianBlur((classes > 0).astype(np.float32), (0, 0), settings.edge_sd)[..., None]
        gain = rng.uniform(1 - settings.max_gain, 1 + settings.max_gain)
        image = alpha * pixels * gain + (1 - alpha) * background
        return Example(image.clip(0, 255).round().astype(np.uint8), classes)


def _placement(size: tuple[int, int], rng: np.random.Generator, settings: PasteSettings) -> np.ndarray:
    """[2, 3]: a random flip, turn, zoom and shift of an image of this size (width, height), px."""
    middle = np.array([(side - 1) / 2 for side in size])
    turn, zoom = rng.uniform(-settings.max_turn, settings.max_turn), settings.max_zoom ** rng.uniform(-1, 1)
    linear = cv2.getRotationMatrix2D((0, 0), turn, zoom)[:, :2] @ np.diag([rng.choice([-1.0, 1.0]), 1.0])
    shift = rng.uniform(-settings.max_shift, settings.max_shift, 2) * size
    return np.concatenate([linear, (middle + shift - linear @ middle)[:, None]], 1)


def pasted_samples(samples: Sequence[RecordedSample], folder: Path | None, seed: int) -> tuple[PastedSample, ...]:
    """Images of these labelled frames' instruments. folder: of backgrounds; None: the frames, filled in."""
    backgrounds = Backgrounds(tuple(samples), () if folder is None else background_files(folder))
    key = hash((tuple(sample.key for sample in samples), folder))
    return tuple(PastedSample(backgrounds, number, seed, key) for number in range(backgrounds.settings.images))


def background_files(folder: Path) -> tuple[Path, ...]:
    """The images of a folder. Raises NeecoError where it has none."""
    files = image_files(folder) if folder.is_dir() else ()
    if not files:
        raise NeecoError(f"--backgrounds {folder}: has no image; give a folder of images without an instrument")
    return files
