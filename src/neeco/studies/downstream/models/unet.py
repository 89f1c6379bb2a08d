"""`unet`: a residual U-Net (Kerfoot et al., "Left-ventricle quantification using residual U-Net", 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from neeco.studies.downstream.model import TorchModel
from neeco.studies.downstream.results import Prediction
from neeco.studies.downstream.training_data import Batch


class ResidualUnit(nn.Module):
    """A residual convolution with batch normalisation and ReLU; the input is projected if its shape changes.

    last: without normalisation and ReLU, for the network's output.
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1, last: bool = False) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.rest = nn.Identity() if last else nn.Sequential(nn.BatchNorm2d(outputs), nn.ReLU())
        same = inputs == outputs and stride == 1
        self.shortcut: nn.Module = nn.Identity() if same else nn.Conv2d(inputs, outputs, 3, stride, 1)

    def forward(self, features: Tensor) -> Tensor:
        return self.rest(self.convolution(features)) + self.shortcut(features)


class ResidualUNet(nn.Module):
    """Images [B, 3, h, w] to logits [B, classes, h, w]; sides are multiples of 2 ** (levels - 1)."""

    def __init__(self, classes: int, channels: Sequence[int]) -> None:
        super().__init__()
        *levels, _ = channels
        down = [ResidualUnit(inputs, outputs, 2) for inputs, outputs in pairwise([3, *levels])]
        self.down = nn.ModuleList([*down, ResidualUnit(channels[-2], channels[-1])])
        self.up = nn.ModuleList()
        below = channels[-1]
        for k, outputs in enumerate([*reversed(levels[:-1]), classes], 1):
            transposed = nn.ConvTranspose2d(below + levels[-k], outputs, 3, 2, 1, output_padding=1)
            unit = ResidualUnit(outputs, outputs, last=k == len(levels))
            self.up.append(nn.Sequential(transposed, nn.BatchNorm2d(outputs), nn.ReLU(), unit))
            below = outputs

    def forward(self, images: Tensor) -> Tensor:
        features, skipped = images, []
        for unit in self.down:
            features = unit(features)
            skipped.append(features)
        features = skipped.pop()
        for unit in self.up:
            features = unit(torch.cat([skipped.pop(), features], 1))
        return features


class UNet(TorchModel):
    """Predicts the class of every pixel. Loss: Dice plus cross-entropy (Isensee et al., nnU-Net, 2021)."""

    model = "unet"
    predicts = "masks"
    image_size = 160
    multiple = 16
    steps = 1000  # training steps, needed with strong augmentation; 400 are sufficient without it
    batch = 8
    learning_rate = 3e-3
    channels = (16, 32, 64, 128, 256)  # channels per level; every level but the last halves the resolution

    def build(self, classes: int) -> nn.Module:
        return ResidualUNet(classes + 1, self.channels)

    def loss(self, module: Any, batch: Batch) -> Tensor:
        logits = module(batch.images)  # [B, C + 1, h, w]
        entropy = nn.functional.cross_entropy(logits, batch.shares, reduction="none")  # [B, h, w]
        valid = batch.valid
        predicted, labelled = logits.softmax(1)[:, 1:] * valid[:, None], batch.shares[:, 1:] * valid[:, None]
        both = (predicted * labelled).sum((0, 2, 3))
        either = predicted.sum((0, 2, 3)) + labelled.sum((0, 2, 3))
        dice = 1 - (2 * both + 1) / (either + 1)  # [C], over the batch: single images may lack a class
        return (entropy * valid).sum() / valid.sum().clamp(min=1) + dice.mean()

    def predictions(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        probabilities = module(images).softmax(1).float().cpu().numpy()  # [B, C + 1, h, w]
        masks: list[Prediction] = []
        for shares, (height, width) in zip(probabilities, sizes, strict=True):
            whole = [cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) for share in shares]
            masks.append(np.argmax(whole, axis=0).astype(np.uint8))
        return masks
