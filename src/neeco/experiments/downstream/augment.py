"""Classical augmentation, of the condition `augment`: what a lab without drawn images would do. By MONAI."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from neeco.experiments.downstream.samples import Example

TURN = 0.35  # rad
SCALE = 0.2
SHIFT = 0.1  # of the image
BRIGHTNESS = 0.25
COLOUR = 0.1  # of each channel apart
GAMMA = (0.7, 1.4)
NOISE = 0.04
BLUR = (0.25, 1.5)  # px
SOMETIMES = 0.3


def augment(example: Example, rng: np.random.Generator) -> Example:
    """The example flipped, turned, scaled, shifted, and its colours, sharpness and noise changed at random.

    Labels move with the image; what comes from outside of it is black and does not count.
    """
    counted = np.ones(example.classes.shape) if example.counted is None else example.counted
    share = np.zeros(example.classes.shape) if example.share is None else example.share
    labels = np.stack([example.classes, example.instruments, counted, share]).astype(np.float32)  # [4, H, W]
    transform = _transform(example.classes.shape)
    transform.set_random_state(int(rng.integers(2**31)))
    image = np.moveaxis(example.image, 2, 0).astype(np.float32) / 255
    made = {name: np.asarray(value) for name, value in transform({"image": image, "labels": labels}).items()}
    gain = 1 + COLOUR * rng.uniform(-1, 1, (3, 1, 1))
    pixels = np.moveaxis((made["image"] * gain).clip(0, 1) * 255, 0, 2).round().astype(np.uint8)
    classes, instruments, counted, share = made["labels"]
    return Example(
        np.ascontiguousarray(pixels),
        classes.round().astype(np.uint8),
        instruments.round().astype(np.uint8),
        counted > 0.5,
        None if example.share is None else share,
    )


@cache
def _transform(size: tuple[int, int]) -> Any:
    from monai import transforms

    names = ["image", "labels"]
    return transforms.Compose(
        [
            transforms.RandFlipd(names, prob=0.5, spatial_axis=1),
            transforms.RandAffined(
                names,
                prob=1.0,
                rotate_range=TURN,
                scale_range=(SCALE, SCALE),
                translate_range=[SHIFT * side for side in size],
                mode=["bilinear", "nearest"],
                padding_mode="zeros",
            ),
            transforms.RandScaleIntensityd(["image"], factors=BRIGHTNESS, prob=1.0),
            transforms.RandAdjustContrastd(["image"], prob=SOMETIMES, gamma=GAMMA),
            transforms.RandGaussianSmoothd(["image"], sigma_x=BLUR, sigma_y=BLUR, prob=SOMETIMES),
            transforms.RandGaussianNoised(["image"], prob=SOMETIMES, std=NOISE),
        ]
    )
