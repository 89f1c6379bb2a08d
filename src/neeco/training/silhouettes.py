"""Silhouettes of instruments in the training images (instrument, tissue or unknown per pixel), and the loss of rendered
labels against them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

UNKNOWN, INSTRUMENT = 128, 255  # of stored values; tissue is 0


@dataclass(frozen=True, kw_only=True)
class SilhouetteSettings:
    """Weight of the loss, and the data for silhouettes."""

    weight: float = 0.1  # of the loss, relative to the photometric one
    # number of frames above which it decreases: many frames are sufficient evidence themselves
    few: int = 30
    min_share: float = 1e-4  # lower bound of rendered labels in logarithms
    n_views: int = 20  # training frames from which the classifier is learned


SILHOUETTES = SilhouetteSettings()


@dataclass(eq=False)
class Silhouettes:
    """Silhouettes of all training frames: values [H, W] uint8 each, UNKNOWN where images are ambiguous; `noise` of the
    tissue that they were compared with."""

    values: tuple[Tensor, ...]
    noise: float

    def instrument(self, index: int) -> Tensor:
        """Return the certainty of each pixel of frame `index` to show an instrument [H, W], in [0, 1]."""
        return ((self.values[index].float() - UNKNOWN) / (INSTRUMENT - UNKNOWN)).clamp(0, 1)

    def loss(self, index: int, label: Tensor) -> Tensor:
        """Return the weighted cross entropy [] of the rendered label [h, w] of frame `index` against its silhouette."""
        height, width = label.shape
        values = self.values[index].cpu().numpy().astype(np.float32)
        interpolation = cv2.INTER_AREA if width < values.shape[1] else cv2.INTER_LINEAR
        resized = cv2.resize(values, (width, height), interpolation=interpolation)
        certain = torch.from_numpy((resized - UNKNOWN) / (INSTRUMENT - UNKNOWN)).to(label)
        instrument, tissue = certain.clamp(0, 1), (-certain).clamp(0, 1)
        label = label.clamp(SILHOUETTES.min_share, 1 - SILHOUETTES.min_share)
        weight = SILHOUETTES.weight * min(1.0, SILHOUETTES.few / len(self.values))
        return -weight * (instrument * label.log() + tissue * (1 - label).log()).mean()

    def tensors(self) -> dict[str, Tensor]:
        """Return what a checkpoint holds of them."""
        sizes = torch.tensor([list(values.shape) for values in self.values])
        flat = torch.cat([values.flatten().cpu() for values in self.values])
        return {"values": flat, "sizes": sizes, "noise": torch.tensor(self.noise, dtype=torch.float64)}

    @classmethod
    def of_tensors(cls, tensors: dict[str, Tensor]) -> Silhouettes:
        """Return what `tensors` returned."""
        sizes: Sequence[Sequence[int]] = tensors["sizes"].tolist()
        parts = tensors["values"].cpu().split([height * width for height, width in sizes])
        return cls(tuple(part.view(*size) for part, size in zip(parts, sizes, strict=True)), float(tensors["noise"]))
