"""`unet`: MONAI's residual U-Net (Kerfoot et al., "Left-ventricle quantification using residual U-Net", 2018)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from neeco.experiments.downstream.model import Prediction, lacking
from neeco.experiments.downstream.samples import Example
from neeco.experiments.downstream.torch_training import TorchModel

CHANNELS = (16, 32, 64, 128, 256)


class UNet(TorchModel):
    """Tells the class of every pixel. Learns by Dice and cross-entropy together (Isensee et al., nnU-Net, 2021)."""

    model = "unet"
    answers = "masks"
    side = 160
    multiple = 16
    steps = 400
    batch = 8
    learning_rate = 3e-3

    @classmethod
    def unmet(cls) -> str | None:
        return lacking("monai")

    def build(self, classes: int) -> nn.Module:
        from monai.networks import nets

        strides = (2,) * (len(CHANNELS) - 1)
        return nets.UNet(2, 3, classes + 1, CHANNELS, strides, num_res_units=1, act="relu", norm="batch")

    def loss(self, module: Any, images: Tensor, examples: Sequence[Example]) -> Tensor:
        logits = module(images)  # [B, C + 1, h, w]
        target, counted = targets(examples, logits.shape[1], logits.shape[2:])
        target, counted = target.to(logits), counted.to(logits)
        entropy = nn.functional.cross_entropy(logits, target, reduction="none")  # [B, h, w]
        probabilities, wanted = logits.softmax(1)[:, 1:] * counted[:, None], target[:, 1:] * counted[:, None]
        both = (probabilities * wanted).sum((0, 2, 3))
        either = probabilities.sum((0, 2, 3)) + wanted.sum((0, 2, 3))
        dice = 1 - (2 * both + 1) / (either + 1)  # [C], over the batch: an image without the class says nothing alone
        return (entropy * counted).sum() / counted.sum().clamp(min=1) + dice.mean()

    def answer(self, module: Any, images: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Prediction]:
        probabilities = module(images).softmax(1).float().cpu().numpy()  # [B, C + 1, h, w]
        answers: list[Prediction] = []
        for shares, (height, width) in zip(probabilities, sizes, strict=True):
            whole = [cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR) for share in shares]
            answers.append(np.argmax(whole, axis=0).astype(np.uint8))
        return answers


def targets(examples: Sequence[Example], count: int, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """What to learn: the share of each class in every pixel [B, count, h, w], and what of it counts [B, h, w] in
    [0, 1]. Labels are shrunk by area: a pixel on an edge belongs to both sides. What does not count has no part in
    the pixel it shrinks into."""
    height, width = size
    shares, weights = [], []
    for example in examples:
        whole = np.eye(count, dtype=np.float32)[example.classes]  # [H, W, count]
        if example.share is not None:
            whole[..., 0], whole[..., 1] = 1 - example.share, example.share
        if example.counted is not None:
            whole *= example.counted[..., None]
        share = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, count)
        weight = share.sum(2) if example.counted is not None else np.ones((height, width), np.float32)
        shares.append(share / np.maximum(weight, 1e-6)[..., None])
        weights.append(weight)
    return torch.from_numpy(np.stack(shares)).permute(0, 3, 1, 2), torch.from_numpy(np.stack(weights))
