"""Training data of a downstream model: conditions, labelled frames, cut-and-paste (Dwibedi et al., "Cut, Paste and
Learn", 2017), and batches at the input size."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.images import image_files, read_image_bytes
from neeco.studies.downstream.samples import CACHE, Cache, Example, RecordedSample, Sample
from neeco.synthesis.augmentation import Outline, augment, moved

RESERVED = REAL, STRONG, PASTE, PERMUTED = "real", "strong", "paste", "permuted"
BASELINES = (REAL, f"{REAL}+{STRONG}")  # without synthetic images; the better one is the reference
GOLDEN_RATIO = (5**0.5 - 1) / 2
IMAGES = Cache()  # of training images; in a common cache, the larger examples would evict them


@dataclass(frozen=True)
class Condition:
    """The training data of a model: a sum of terms, `SET+real+strong` (docs/downstream.md); `term in condition` tests
    for one. sets: names of data sets."""

    name: str
    sets: tuple[str, ...] = ()

    def __contains__(self, word: str) -> bool:
        return word in self.name.split("+")


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """Parse a condition such as `kinematic+real+strong`. Raises NeecoError for an unknown term, or missing images."""
    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            reserved = ", ".join(RESERVED)
            raise NeecoError(f"--conditions {name}: {word!r} is neither {reserved} nor a set; name it in --sets")
    condition = Condition(name, tuple(word for word in words if word in sets))
    lacks_real = REAL not in condition and (PASTE in condition or not condition.sets)
    if len(set(words)) < len(words) or lacks_real or (PERMUTED in condition and not condition.sets):
        rule = "requires real or a set; paste requires real, permuted requires a set, and terms must be unique"
        raise NeecoError(f"--conditions {name}: {rule}; correct it")
    return condition


def default_conditions(sets: Sequence[str]) -> list[str]:
    """Return the baselines and cut-and-paste; then each set alone, strongly augmented (recommended for other
    recordings), with labelled frames (recommended for the same recording), and with permuted labels."""
    used = ("", f"+{STRONG}", f"+{REAL}", f"+{REAL}+{PERMUTED}")
    return [*BASELINES, f"{REAL}+{PASTE}", *(name + words for name in sets for words in used)]


def labelled_count(word: str, frames: int) -> int:
    """Return the number of labelled frames, of `frames`, for a value of `--num-real`. Raises NeecoError."""
    if word == "all":
        return frames
    if not word.isdecimal():
        raise NeecoError(f"--num-real: {word!r} is invalid; give a number of labelled frames, or all")
    if int(word) > frames:
        raise NeecoError(f"--num-real: must be at most {frames}, the labelled frames (got {word}); use all")
    return int(word)


def labelled_frames(frames: int, count: int, fold: int) -> list[int]:
    """Choose `count` of `frames` recorded frames to label in a fold, in increasing order.

    The selection is nested for increasing counts, and the same for every condition and model of a fold: an additive
    golden-ratio sequence with a random start per fold, which is evenly spaced for any count (Steinhaus' three-gap
    theorem); if a frame is already chosen, the next free one is used.
    """
    start = np.random.default_rng(np.random.SeedSequence([fold, 0])).random()
    free = np.ones(frames, bool)
    for k in range(count):
        place = int((start + k * GOLDEN_RATIO) % 1 * frames)
        after = np.flatnonzero(np.roll(free, -place))
        free[(place + after[0]) % frames] = False
    return np.flatnonzero(~free).tolist()


@dataclass(frozen=True)
class Backgrounds:
    """Images without an instrument: files, else the labelled frames with their instruments replaced, for a still camera
    by each pixel's median over the frames that observe it, otherwise by inpainting (Telea, 2004); and how many images
    are pasted over them, and the ranges of their random transforms."""

    samples: tuple[RecordedSample, ...]
    files: tuple[Path, ...] = ()
    _: KW_ONLY
    images: int = 400
    margin: float = 0.02  # margin around an instrument (shadow, blur) that is inpainted, relative to the longer side
    fill_side: int = 160  # px, longer side at which holes are inpainted, because the result is smooth
    edge_sd: float = 0.8  # standard deviation in px of the soft edge
    max_turn: float = 20.0  # limit on the turn in degrees
    max_zoom: float = 1.25  # limit on the zoom, as a ratio up or down
    max_shift: float = 0.15  # limit on the shift, as a share of a side
    max_gain: float = 0.2  # limit on the relative change of the pasted instrument's brightness

    def __len__(self) -> int:
        return len(self.files or self.samples)

    def image(self, index: int, size: tuple[int, int]) -> np.ndarray:
        """Return the image of this index, uint8 [H, W, 3], at this size (width, height)."""
        if not self.files:
            return self._filled(CACHE.load(self.samples[index]))
        return cv2.resize(read_image_bytes(self.files[index]), size, interpolation=cv2.INTER_AREA)

    def _filled(self, example: Example) -> np.ndarray:
        """Return the image with its instruments replaced."""
        image, hole = example.image, self._covered(example)
        if self._median is not None:
            image = np.where((hole & self._median.any(2))[..., None], self._median, image)
            hole = hole & ~self._median.any(2)
        if not hole.any() or hole.all():
            return image
        height, width = hole.shape
        scale = min(1.0, self.fill_side / max(height, width))
        small = max(1, round(width * scale)), max(1, round(height * scale))
        mask = cv2.resize(hole.astype(np.uint8), small, interpolation=cv2.INTER_NEAREST)
        mask = cv2.dilate(mask, np.ones((3, 3), np.uint8))
        smooth = cv2.inpaint(cv2.resize(image, small, interpolation=cv2.INTER_AREA), mask, 3, cv2.INPAINT_TELEA)
        return np.where(hole[..., None], cv2.resize(smooth, (width, height)), image)

    def _covered(self, example: Example) -> np.ndarray:
        """Return the mask of an example's instruments with a margin, bool [H, W]."""
        reach = round(self.margin * max(example.classes.shape))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        return cv2.dilate((example.classes > 0).astype(np.uint8), kernel) > 0

    @cached_property
    def _median(self) -> np.ndarray | None:
        """Median of the frames, uint8 [H, W, 3], black where none observes the tissue; None if the camera moves."""
        poses = [sample.frame.camera.world_from_camera.numpy() for sample in self.samples]
        if len(poses) < 2 or not all(np.allclose(pose, poses[0], atol=1e-4) for pose in poses):
            return None
        examples = [CACHE.load(sample) for sample in self.samples[:: -(-len(self.samples) // 25)]]  # at most 25
        tissue = np.stack([np.where(self._covered(item)[..., None], np.nan, item.image) for item in examples])
        tissue[:, np.isnan(tissue[..., 0]).all(0)] = 0
        return np.nanmedian(tissue, axis=0).round().astype(np.uint8)


@dataclass(frozen=True)
class PastedSample:
    """A labelled frame's instruments, flipped, rotated, scaled and shifted, over a background; seeded by its number."""

    backgrounds: Backgrounds
    number: int
    seed: int
    source_key: int  # hash of the labelled frames and backgrounds

    @property
    def name(self) -> str:
        return f"pasted{self.number:06d}"

    @property
    def key(self) -> Hashable:
        return "pasted", self.source_key, self.seed, self.number

    def load(self) -> Example:
        """Raises NeecoError if a frame cannot be read."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, self.number]))
        sources, settings = self.backgrounds.samples, self.backgrounds
        source = CACHE.load(sources[rng.integers(len(sources))])
        size = source.classes.shape[::-1]
        background = self.backgrounds.image(int(rng.integers(len(self.backgrounds))), size)
        background = background[:, :: int(rng.choice([-1, 1]))]
        middle = np.array([(side - 1) / 2 for side in size])
        turn, zoom = rng.uniform(-settings.max_turn, settings.max_turn), settings.max_zoom ** rng.uniform(-1, 1)
        linear = cv2.getRotationMatrix2D((0, 0), turn, zoom)[:, :2] @ np.diag([rng.choice([-1.0, 1.0]), 1.0])
        shift = rng.uniform(-settings.max_shift, settings.max_shift, 2) * size
        matrix = np.concatenate([linear, (middle + shift - linear @ middle)[:, None]], 1)
        # replicated borders continue a shaft beyond the source image
        edge = cv2.BORDER_REPLICATE
        pixels = cv2.warpAffine(source.image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=edge)
        classes = cv2.warpAffine(source.classes, matrix, size, flags=cv2.INTER_NEAREST, borderMode=edge)
        alpha = cv2.GaussianBlur((classes > 0).astype(np.float32), (0, 0), settings.edge_sd)[..., None]
        gain = rng.uniform(1 - settings.max_gain, 1 + settings.max_gain)
        image = alpha * pixels * gain + (1 - alpha) * background
        return Example(image.clip(0, 255).round().astype(np.uint8), classes)


def pasted_samples(samples: Sequence[RecordedSample], folder: Path | None, seed: int) -> tuple[PastedSample, ...]:
    """Return images of these labelled frames' instruments. folder: of backgrounds; None: the inpainted frames."""
    backgrounds = Backgrounds(tuple(samples), () if folder is None else background_files(folder))
    key = hash((tuple(sample.key for sample in samples), folder))
    return tuple(PastedSample(backgrounds, number, seed, key) for number in range(backgrounds.images))


def background_files(folder: Path) -> tuple[Path, ...]:
    """Return the images of a folder. Raises NeecoError if it has none."""
    files = image_files(folder) if folder.is_dir() else ()
    if not files:
        raise NeecoError(f"--backgrounds {folder}: contains no images; give a folder of images without instruments")
    return files


@dataclass(frozen=True)
class TrainingImage:
    """One image at a model's input size, with its targets. Resized by area: pixels at edges belong to both sides."""

    image: np.ndarray  # uint8 [3, h, w]
    shares: np.ndarray  # uint8 [C, h, w], of 255: each class's share of the pixel's valid area
    valid: np.ndarray  # uint8 [1, h, w], of 255: the valid share of the pixel
    outlines: tuple[Outline, ...]  # class and float32 [n, 2] corners x, y of its border pixels in [0, 1]

    @property
    def bytes(self) -> int:
        """Size in memory, bytes."""
        arrays = (self.image, self.shares, self.valid, *(points for _, points in self.outlines))
        return sum(array.nbytes for array in arrays)


@dataclass(frozen=True)
class Batch:
    """Images of one step with their targets, on the model's device."""

    images: Tensor  # [B, 3, h, w] float32 in [0, 1]
    shares: Tensor  # [B, C + 1, h, w]: share of each class, 0 tissue, in each pixel
    valid: Tensor  # [B, h, w] in [0, 1]: the valid share of the pixel
    outlines: tuple[tuple[Outline, ...], ...]  # of each image, as in `TrainingImage`

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return each image's boxes [n, 4] (centre x, y, width, height; relative to its sides) and their classes."""
        boxes_and_classes = []
        for outlines in self.outlines:
            ends = np.array([(*points.min(0), *points.max(0)) for _, points in outlines], np.float64).reshape(-1, 4)
            boxes = np.concatenate([(ends[:, :2] + ends[:, 2:]) / 2, ends[:, 2:] - ends[:, :2]], 1)
            boxes_and_classes.append((boxes, np.array([number for number, _ in outlines], np.int64)))
        return boxes_and_classes


def training_image(sample: Sample, size: tuple[int, int], classes: int, outlines: bool = False) -> TrainingImage:
    """Return the sample at this size (width, height), cached. outlines: whether to include them, for boxes."""
    return IMAGES.get((sample.key, size, classes, outlines), lambda: shrink(sample.load(), size, classes, outlines))


def shrink(example: Example, size: tuple[int, int], classes: int, outlines: bool = False) -> TrainingImage:
    """Return an example at a model's input size (width, height). classes: number of classes; outlines: as above."""
    whole = np.stack([example.classes == k + 1 for k in range(classes)], 2).astype(np.float32)  # [H, W, C]
    weight = np.ones(whole.shape[:2], np.float32) if example.valid is None else example.valid.astype(np.float32)
    shares = cv2.resize(whole * weight[..., None], size, interpolation=cv2.INTER_AREA).reshape(*size[::-1], classes)
    valid = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    shares = shares / np.maximum(valid, 1e-6)[..., None]
    return TrainingImage(
        np.ascontiguousarray(cv2.resize(example.image, size, interpolation=cv2.INTER_AREA).transpose(2, 0, 1)),
        np.ascontiguousarray((shares.clip(0, 1) * 255).round().astype(np.uint8).transpose(2, 0, 1)),
        (valid * 255).round().astype(np.uint8)[None],
        tuple(example.outlines()) if outlines else (),
    )


def collate(images: Sequence[TrainingImage], device: torch.device, rng: torch.Generator | None = None) -> Batch:
    """Return the batch of these images. rng: on that device, for strong augmentation; None: not augmented."""
    arrays = [np.stack([getattr(item, name) for item in images]) for name in ("image", "shares", "valid")]
    planes = torch.from_numpy(np.concatenate(arrays, 1)).to(device).float() / 255  # [B, 3 + C + 1, h, w]
    outlines = [item.outlines for item in images]
    if rng is not None:
        planes, matrices = augment(planes, rng)
        if any(outlines):
            pairs = zip(outlines, matrices.double().cpu().numpy(), strict=True)
            outlines = [moved(image_outlines, matrix) for image_outlines, matrix in pairs]
    shares = planes[:, 3:-1]
    colors = planes[:, :3].contiguous(memory_format=torch.channels_last)
    tissue = 1 - shares.sum(1, keepdim=True)
    return Batch(colors, torch.cat([tissue, shares], 1), planes[:, -1], tuple(outlines))


class BatchSampler:
    """Endless sampler of recorded and synthetic samples. Every source is shuffled after each pass; synthetic sources
    have equal shares. With both, synthetic samples are drawn until `real_alone_from`, then only recorded ones.
    augmented: whether batches are strongly augmented."""

    real_alone_from = 0.6  # share of the steps from which only recorded frames are drawn

    def __init__(
        self, real: Sequence[Sample], synthetic: Sequence[Sequence[Sample]] = (), *, seed: int, augmented: bool = False
    ) -> None:
        self.sources = [source for source in (real, *synthetic) if source]
        self.augmented = augmented
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))
        self._orders = [self._shuffled(source) for source in self.sources]
        self._real = int(bool(real))
        self._turn = 0

    def draw(self, count: int, done: float) -> list[Sample]:
        """Return the next `count` samples. done: completed share of the training, in [0, 1]."""
        real, synthetic = self._orders[: self._real], self._orders[self._real :]
        orders = real if real and (done >= self.real_alone_from or not synthetic) else synthetic
        self._turn += count
        return [next(orders[turn % len(orders)]) for turn in range(self._turn - count, self._turn)]

    def _shuffled(self, source: Sequence[Sample]) -> Iterator[Sample]:
        while True:
            for index in self._rng.permutation(len(source)).tolist():
                yield source[index]
