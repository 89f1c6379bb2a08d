"""Cut-and-paste (Dwibedi et al., "Cut, Paste and Learn", 2017): labelled instruments over backgrounds without one."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from neeco.capture.images import image_files, read_image_bytes
from neeco.errors import NeecoError
from neeco.studies.downstream.samples import Example, RecordedSample, loaded

PASTED_IMAGES = 400
MARGIN = 0.02  # of the image's longer side: what is about an instrument (its shadow, its blur) is filled in, too
FILL_SIDE = 160  # px, the longer side at which holes are filled: what is put there is smooth
EDGE_SD = 0.8  # px, of the soft edge
MAX_TURN = 20.0  # degrees
MAX_ZOOM = 1.25  # larger or smaller
MAX_SHIFT = 0.15  # of a side
MAX_GAIN = 0.2  # of the pasted instrument's brightness


@dataclass(frozen=True)
class Backgrounds:
    """Images without an instrument: files, else the labelled frames with their instruments filled in.

    Where the camera stands still a pixel is filled by its median over the frames that show it; what none shows, and
    where the camera moves, by inpainting (Telea, 2004).
    """

    samples: tuple[RecordedSample, ...]
    files: tuple[Path, ...] = ()

    def __len__(self) -> int:
        return len(self.files or self.samples)

    def image(self, index: int, size: tuple[int, int]) -> np.ndarray:
        """The image uint8 [H, W, 3] of this number, at this size (width, height)."""
        if not self.files:
            return filled(*self._covered[index], self._plate)
        pixels = read_image_bytes(self.files[index]).numpy()
        return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

    @cached_property
    def _covered(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Each frame with what its instruments cover."""
        return [(example.image, covered(example)) for example in map(loaded, self.samples)]

    @cached_property
    def _plate(self) -> np.ndarray | None:
        """Median of all frames uint8 [H, W, 3], black where none shows a pixel; None where the camera moves."""
        poses = [sample.frame.camera.world_from_camera.numpy() for sample in self.samples]
        if len(poses) < 2 or not all(np.allclose(pose, poses[0], atol=1e-4) for pose in poses):
            return None
        chosen = self._covered[:: -(-len(self._covered) // 25)]  # a median of some is as good
        shown = np.stack([np.where(mask[..., None], np.nan, image) for image, mask in chosen])
        hidden = np.isnan(shown[..., 0]).all(0)
        shown[:, hidden] = 0
        return np.nanmedian(shown, axis=0).round().astype(np.uint8)


def covered(example: Example) -> np.ndarray:
    """bool [H, W]: an example's instruments and what is close to them."""
    reach = round(MARGIN * max(example.classes.shape))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate((example.classes > 0).astype(np.uint8), kernel) > 0


def filled(image: np.ndarray, hole: np.ndarray, plate: np.ndarray | None = None) -> np.ndarray:
    """`image` uint8 [H, W, 3] with its hole [H, W] filled from `plate` where that is not black, else inpainted."""
    left = hole
    if plate is not None:
        image = np.where((hole & plate.any(2))[..., None], plate, image)
        left = hole & ~plate.any(2)
    if not left.any() or left.all():
        return image
    height, width = left.shape
    scale = min(1.0, FILL_SIDE / max(height, width))
    small = max(1, round(width * scale)), max(1, round(height * scale))
    mask = cv2.resize(left.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST)
    mask = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    smooth = cv2.inpaint(cv2.resize(image, small, interpolation=cv2.INTER_AREA), mask, 3, cv2.INPAINT_TELEA)
    smooth = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(left[..., None], smooth, image)


@dataclass(frozen=True)
class PastedSample:
    """A labelled frame's instruments, flipped, turned, scaled and shifted, over a background; all by its number."""

    sources: tuple[RecordedSample, ...]
    backgrounds: Backgrounds
    number: int
    seed: int
    of: Hashable = field(default=None)  # what distinguishes it from those of other frames

    @property
    def name(self) -> str:
        return f"pasted{self.number:06d}"

    @property
    def key(self) -> Hashable:
        return "pasted", self.of, self.seed, self.number

    def load(self) -> Example:
        """Raises NeecoError where a frame cannot be read."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, self.number]))
        source = loaded(self.sources[rng.integers(len(self.sources))])
        size = source.classes.shape[::-1]
        background = self.backgrounds.image(int(rng.integers(len(self.backgrounds))), size)
        background = background[:, :: int(rng.choice([-1, 1]))]
        matrix = placement(size, rng)
        labels = np.stack([source.classes, source.instruments, np.zeros_like(source.classes)], 2)
        # a shaft goes on where the image that it is cut from ends
        how = cv2.BORDER_REPLICATE
        pixels = cv2.warpAffine(source.image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=how)
        labels = cv2.warpAffine(labels, matrix, size, flags=cv2.INTER_NEAREST, borderMode=how)
        classes, instruments = (np.ascontiguousarray(labels[..., k]) for k in range(2))
        alpha = cv2.GaussianBlur((classes > 0).astype(np.float32), (0, 0), EDGE_SD)[..., None]
        gain = rng.uniform(1 - MAX_GAIN, 1 + MAX_GAIN)
        image = alpha * pixels * gain + (1 - alpha) * background
        return Example(image.clip(0, 255).round().astype(np.uint8), classes, instruments)


def placement(size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """[2, 3]: a random flip, turn, zoom and shift of an image of this size (width, height), px."""
    middle = np.array([(side - 1) / 2 for side in size])
    turn = cv2.getRotationMatrix2D((0, 0), rng.uniform(-MAX_TURN, MAX_TURN), MAX_ZOOM ** rng.uniform(-1, 1))[:, :2]
    linear = turn @ np.diag([rng.choice([-1.0, 1.0]), 1.0])
    shift = rng.uniform(-MAX_SHIFT, MAX_SHIFT, 2) * size
    return np.concatenate([linear, (middle + shift - linear @ middle)[:, None]], 1)


def pasted_samples(
    samples: Sequence[RecordedSample], folder: Path | None, seed: int, count: int = PASTED_IMAGES
) -> tuple[PastedSample, ...]:
    """`count` images of these labelled frames' instruments. folder: of backgrounds; None: the frames, filled in."""
    files = () if folder is None else background_files(folder)
    backgrounds = Backgrounds(tuple(samples), files)
    of = (tuple(sample.key for sample in samples), folder)
    return tuple(PastedSample(tuple(samples), backgrounds, number, seed, hash(of)) for number in range(count))


def background_files(folder: Path) -> tuple[Path, ...]:
    """The images of a folder. Raises NeecoError where it has none."""
    if not folder.is_dir():
        raise NeecoError(f"--backgrounds {folder}: no such folder; give a folder of images without an instrument")
    files = image_files(folder)
    if not files:
        raise NeecoError(f"--backgrounds {folder}: has no image; give a folder of images without an instrument")
    return files
