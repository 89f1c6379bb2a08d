"""Training data of a downstream model: conditions in words, labelled frames, cut-and-paste (Dwibedi et al., "Cut, Paste
and Learn", 2017), batches at its input size."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
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
BASELINES = (REAL, f"{REAL}+{STRONG}")  # without synthetic images: the better of them is the reference
GOLDEN_RATIO = (5**0.5 - 1) / 2
IMAGES = Cache()  # of training images; in one with the examples, which are larger, they would be evicted


@dataclass(frozen=True)
class Condition:
    """The training data of a model: a sum of words, `SET+real+strong` (docs/downstream.md), of which `word in
    condition` asks for one. sets: names of data sets."""

    name: str
    sets: tuple[str, ...] = ()

    def __contains__(self, word: str) -> bool:
        return word in self.name.split("+")


def parse_condition(name: str, sets: Collection[str]) -> Condition:
    """`kinematic+real+strong`. Raises NeecoError for a word that is none of `sets` nor known, or a lack of images."""
    words = name.split("+")
    for word in words:
        if word not in RESERVED and word not in sets:
            reserved = ", ".join(RESERVED)
            raise NeecoError(f"--conditions {name}: {word!r} is neither {reserved} nor a set; name it in --sets")
    condition = Condition(name, tuple(word for word in words if word in sets))
    lacks_real = REAL not in condition and (PASTE in condition or not condition.sets)
    if len(set(words)) < len(words) or lacks_real or (PERMUTED in condition and not condition.sets):
        rule = "real or a set is needed, paste needs real, permuted needs a set, and no word stands twice"
        raise NeecoError(f"--conditions {name}: {rule}; correct it")
    return condition


def default_conditions(sets: Sequence[str]) -> list[str]:
    """The baselines and cut-and-paste; then each set alone, alone and strongly augmented (the recipe for another
    recording), with labelled frames (the one for the same), and with labels of other images."""
    used = ("", f"+{STRONG}", f"+{REAL}", f"+{REAL}+{PERMUTED}")
    return [*BASELINES, f"{REAL}+{PASTE}", *(name + words for name in sets for words in used)]


def labelled_count(word: str, frames: int) -> int:
    """Return the number of labelled frames, of so many, that a word of `--num-real` means. Raises NeecoError."""
    if word == "all":
        return frames
    if not word.isdecimal():
        raise NeecoError(f"--num-real: {word!r} is neither a number of labelled frames nor all")
    if int(word) > frames:
        raise NeecoError(f"--num-real: {word} labelled frames are asked for, the capture has {frames}; use all")
    return int(word)


def labelled_frames(frames: int, count: int, fold: int) -> list[int]:
    """Choose the `count` of so many recorded frames that are labelled in a fold, in their order.

    Those of a smaller count are among those of a larger one, and the same for every condition and model of a fold: the
    additive recurrence of the golden ratio from a start of the fold's own, whose first points are spread evenly
    whatever their number (Steinhaus' three-gap theorem); of a frame taken already the next one.
    """
    start = np.random.default_rng(np.random.SeedSequence([fold, 0])).random()
    free = np.ones(frames, bool)
    for k in range(count):
        place = int((start + k * GOLDEN_RATIO) % 1 * frames)
        after = np.flatnonzero(np.roll(free, -place))
        free[(place + after[0]) % frames] = False
    return np.flatnonzero(~free).tolist()


@dataclass(frozen=True, kw_only=True)
class PasteSettings:
    """Images that are made, and how far instruments are moved in them."""

    images: int = 400
    margin: float = 0.02  # margin about an instrument (shadow, blur) that is filled in, as a share of the longer side
    fill_side: int = 160  # length in px of the longer side at which holes are filled: the filling is smooth
    edge_sd: float = 0.8  # standard deviation in px of the soft edge
    max_turn: float = 20.0  # limit on the turn in degrees
    max_zoom: float = 1.25  # limit on the zoom, as a ratio up or down
    max_shift: float = 0.15  # limit on the shift, as a share of a side
    max_gain: float = 0.2  # limit on the relative change of the pasted instrument's brightness


@dataclass(frozen=True)
class Backgrounds:
    """Images without an instrument: files, else the labelled frames with their instruments filled in: where the camera
    stands still by each pixel's median over the frames that show it, elsewhere by inpainting (Telea, 2004)."""

    samples: tuple[RecordedSample, ...]
    files: tuple[Path, ...] = ()
    settings: PasteSettings = PasteSettings()

    def __len__(self) -> int:
        return len(self.files or self.samples)

    def image(self, index: int, size: tuple[int, int]) -> np.ndarray:
        """The image uint8 [H, W, 3] of this number, at this size (width, height)."""
        if not self.files:
            return self._filled(CACHE.load(self.samples[index]))
        return cv2.resize(read_image_bytes(self.files[index]), size, interpolation=cv2.INTER_AREA)

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
        examples = [CACHE.load(sample) for sample in self.samples[:: -(-len(self.samples) // 25)]]  # some are as good
        tissue = np.stack([np.where(self._covered(item)[..., None], np.nan, item.image) for item in examples])
        tissue[:, np.isnan(tissue[..., 0]).all(0)] = 0
        return np.nanmedian(tissue, axis=0).round().astype(np.uint8)


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
        source = CACHE.load(sources[rng.integers(len(sources))])
        size = source.classes.shape[::-1]
        background = self.backgrounds.image(int(rng.integers(len(self.backgrounds))), size)
        background = background[:, :: int(rng.choice([-1, 1]))]
        middle = np.array([(side - 1) / 2 for side in size])
        turn, zoom = rng.uniform(-settings.max_turn, settings.max_turn), settings.max_zoom ** rng.uniform(-1, 1)
        linear = cv2.getRotationMatrix2D((0, 0), turn, zoom)[:, :2] @ np.diag([rng.choice([-1.0, 1.0]), 1.0])
        shift = rng.uniform(-settings.max_shift, settings.max_shift, 2) * size
        matrix = np.concatenate([linear, (middle + shift - linear @ middle)[:, None]], 1)
        # a shaft goes on where the image that it is cut from ends
        edge = cv2.BORDER_REPLICATE
        pixels = cv2.warpAffine(source.image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=edge)
        classes = cv2.warpAffine(source.classes, matrix, size, flags=cv2.INTER_NEAREST, borderMode=edge)
        alpha = cv2.GaussianBlur((classes > 0).astype(np.float32), (0, 0), settings.edge_sd)[..., None]
        gain = rng.uniform(1 - settings.max_gain, 1 + settings.max_gain)
        image = alpha * pixels * gain + (1 - alpha) * background
        return Example(image.clip(0, 255).round().astype(np.uint8), classes)


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


@dataclass(frozen=True)
class TrainingImage:
    """One image at a model's input size, with its targets. Shrunk by area: a pixel on an edge belongs to both sides."""

    image: np.ndarray  # uint8 [3, h, w]
    shares: np.ndarray  # uint8 [C, h, w], of 255: each class's share of the pixel's valid area
    valid: np.ndarray  # uint8 [1, h, w], of 255: the share of the pixel that is learned
    outlines: tuple[Outline, ...]  # class and float32 [n, 2] corners x, y of its border pixels in [0, 1]

    @property
    def bytes(self) -> int:
        """Its size in memory."""
        arrays = (self.image, self.shares, self.valid, *(points for _, points in self.outlines))
        return sum(array.nbytes for array in arrays)


@dataclass(frozen=True)
class Batch:
    """Images of one step with their targets, on the model's device."""

    images: Tensor  # [B, 3, h, w] float32 in [0, 1]
    shares: Tensor  # [B, C + 1, h, w]: of each class, 0 tissue, in each pixel
    valid: Tensor  # [B, h, w] in [0, 1]: the share of the pixel that is learned
    outlines: tuple[tuple[Outline, ...], ...]  # of each image, as `TrainingImage` has them

    def boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return each image's boxes [n, 4] (centre x, y, width, height; shares of its sides) and their classes."""
        boxes_and_classes = []
        for outlines in self.outlines:
            ends = np.array([(*points.min(0), *points.max(0)) for _, points in outlines], np.float64).reshape(-1, 4)
            boxes = np.concatenate([(ends[:, :2] + ends[:, 2:]) / 2, ends[:, 2:] - ends[:, :2]], 1)
            boxes_and_classes.append((boxes, np.array([number for number, _ in outlines], np.int64)))
        return boxes_and_classes


def training_image(sample: Sample, size: tuple[int, int], classes: int, outlines: bool = False) -> TrainingImage:
    """The sample at this size (width, height), kept for as long as there is room. outlines: with them, for boxes."""
    return IMAGES.get((sample.key, size, classes, outlines), lambda: shrink(sample.load(), size, classes, outlines))


def shrink(example: Example, size: tuple[int, int], classes: int, outlines: bool = False) -> TrainingImage:
    """An example at a model's input size (width, height). classes: how many there are. outlines: with them."""
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
    """The batch of these images; rng (of that device): strongly augmented at random by it."""
    arrays = [np.stack([getattr(item, name) for item in images]) for name in ("image", "shares", "valid")]
    planes = torch.from_numpy(np.concatenate(arrays, 1)).to(device).float() / 255  # [B, 3 + C + 1, h, w]
    outlines = [item.outlines for item in images]
    if rng is not None:
        planes, matrices = augment(planes, rng)
        if any(outlines):
            placed = zip(outlines, matrices.double().cpu().numpy(), strict=True)
            outlines = [moved(some, matrix) for some, matrix in placed]
    shares = planes[:, 3:-1]
    colors = planes[:, :3].contiguous(memory_format=torch.channels_last)
    tissue = 1 - shares.sum(1, keepdim=True)
    return Batch(colors, torch.cat([tissue, shares], 1), planes[:, -1], tuple(outlines))


class BatchSampler:
    """Draws samples from sources without end, each shuffled anew after a pass: recorded frames, and synthetic ones, of
    which each has an equal share. Where there are both, synthetic ones are drawn until `real_alone_from`, then recorded
    ones alone. augmented: whether a batch is to be strongly augmented."""

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
        """Return the next `count` samples. done: share of the training that is done, in [0, 1]."""
        real, synthetic = self._orders[: self._real], self._orders[self._real :]
        orders = real if real and (done >= self.real_alone_from or not synthetic) else synthetic
        self._turn += count
        return [next(orders[turn % len(orders)]) for turn in range(self._turn - count, self._turn)]

    def _shuffled(self, source: Sequence[Sample]) -> Iterator[Sample]:
        while True:
            for index in self._rng.permutation(len(source)).tolist():
                yield source[index]
