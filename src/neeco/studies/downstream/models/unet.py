"""`unet`: MONAI's residual U-Net (Kerfoot et al., "Left-ventricle quantification using residual U-Net", 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from neeco.studies.downstream.model import TorchModel, missing_packages
from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.scores import Prediction


class UNet(TorchModel):
    """Predicts the class of every pixel. Loss: Dice plus cross-entropy (Isensee et al., nnU-Net, 2021)."""

    model = "unet"
    predicts = "masks"
    image_size = 160
    multiple = 16
    steps = 400
    batch = 8
    learning_rate = 3e-3
    channels = (16, 32, 64, 128, 256)  # of the levels, each half as large as the one before

    @classmethod
    def missing_requirement(cls) -> str | None:
        return missing_packages("monai")

    def build(self, classes: int) -> nn.Module:
        from monai.networks import nets

        strides = (2,) * (len(self.channels) - 1)
        return nets.UNet(2, 3, classes + 1, self.channels, strides, num_res_units=1, act="relu", norm="batch")

    def loss(self, module: Any, images: Tensor, examples: Sequence[Example]) -> Tensor:
        logits = module(images)  # [B, C + 1, h, w]
        target, weight = (values.to(logits) for values in targets(examples, logits.shape[1], logits.shape[2:]))
        entropy = nn.functional.cross_entropy(logits, target, reduction="none")  # [B, h, w]
        predicted, labelled = logits.softmax(1)[:, 1:] * weight[:, None], target[:, 1:] * weight[:, None]
        both = (predicted * labelled).sum((0, 2, 3))
        either = predicted.sum((0, 2, 3)) + labelled.sum((0, 2, 3))
        dice = 1 - (2 * both + 1) / (either + 1)  # [C], over the batch: single images may lack a class
        return (entropy * weight).sum() / weight.sum().clamp(min=1) + dice.mean()

    def predictions(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        probabilities = module(images).softmax(1).float().cpu().numpy()  # [B, C + 1, h, w]
        found: list[Prediction] = []
        for shares, (height, width) in zip(probabilities, sizes, strict=True):
            whole = [cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) for share in shares]
            found.append(np.argmax(whole, axis=0).astype(np.uint8))
        return found


def targets(examples: Sequence[Example], count: int, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The share of each class in every pixel [B, count, h, w], and the valid share of every pixel [B, h, w] in [0, 1].

    Labels are shrunk by area: a pixel on an edge belongs to both sides. Invalid pixels do not contribute.
    """
    height, width = size
    shares, weights = [], []
    for example in examples:
        whole = np.eye(count, dtype=np.float32)[example.classes]  # [H, W, count]
        if example.coverage is not None:
            whole[..., 0], whole[..., 1] = 1 - example.coverage, example.coverage
        if example.valid is not None:
            whole *= example.valid[..., None]
        share = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, count)
        weight = share.sum(2) if example.valid is not None else np.ones((height, width), np.float32)
        shares.append(share / np.maximum(weight, 1e-6)[..., None])
        weights.append(weight)
    return torch.from_numpy(np.stack(shares)).permute(0, 3, 1, 2), torch.from_numpy(np.stack(weights))
