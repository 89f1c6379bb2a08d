"""Batches of training images at a model's input size: which images, when, and as tensors with their targets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.studies.downstream.samples import Example, LeastRecentlyUsed, Sample
from neeco.synthesis.augmentation import Outline, augment, moved


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
        found = []
        for outlines in self.outlines:
            ends = np.array([(*points.min(0), *points.max(0)) for _, points in outlines], np.float64).reshape(-1, 4)
            boxes = np.concatenate([(ends[:, :2] + ends[:, 2:]) / 2, ends[:, 2:] - ends[:, :2]], 1)
            found.append((boxes, np.array([number for number, _ in outlines], np.int64)))
        return found


IMAGES = LeastRecentlyUsed[TrainingImage]()


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
    """Draws samples from sources without end. A source is shuffled anew after each pass.

    sources: recorded frames where there are any, then the synthetic ones, of which each has an equal share. Where there
    are both, synthetic ones are drawn until `real_alone_from`, then recorded ones alone. The seed decides the order.
    augmented: whether a batch is to be strongly augmented.
    """

    real_alone_from = 0.6  # share of the steps after which recorded frames alone are learned

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
