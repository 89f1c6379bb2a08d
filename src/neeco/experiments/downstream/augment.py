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
    labels = {"classes": example.classes, "instruments": example.instruments}
    labels["counted"] = np.ones(example.classes.shape) if example.counted is None else example.counted
    data: dict[str, Any] = {name: array[None].astype(np.float32) for name, array in labels.items()}
    data["share"] = (example.classes > 0 if example.share is None else example.share)[None].astype(np.float32)
    data["image"] = np.moveaxis(example.image, 2, 0).astype(np.float32) / 255
    transform = _transform(example.classes.shape)
    transform.set_random_state(int(rng.integers(2**31)))
    made = {name: np.asarray(value) for name, value in transform(data).items()}
    gain = 1 + COLOUR * rng.uniform(-1, 1, (3, 1, 1))
    image = np.moveaxis((made["image"] * gain).clip(0, 1) * 255, 0, 2).round().astype(np.uint8)
    counted = made["counted"][0] > 0.5
    return Example(
        np.ascontiguousarray(image),
        made["classes"][0].round().astype(np.uint8),
        made["instruments"][0].round().astype(np.uint8),
        counted,
        None if example.share is None else made["share"][0],
    )


@cache
def _transform(size: tuple[int, int]) -> Any:
    from monai import transforms

    names = ["image", "share", "classes", "instruments", "counted"]
    return transforms.Compose(
        [
            transforms.RandFlipd(names, prob=0.5, spatial_axis=1),
            transforms.RandAffined(
                names,
                prob=1.0,
                rotate_range=TURN,
                scale_range=(SCALE, SCALE),
                translate_range=[SHIFT * side for side in size],
                mode=["bilinear", "bilinear", "nearest", "nearest", "nearest"],
                padding_mode="zeros",
            ),
            transforms.RandScaleIntensityd(["image"], factors=BRIGHTNESS, prob=1.0),
            transforms.RandAdjustContrastd(["image"], prob=SOMETIMES, gamma=GAMMA),
            transforms.RandGaussianSmoothd(["image"], sigma_x=BLUR, sigma_y=BLUR, prob=SOMETIMES),
            transforms.RandGaussianNoised(["image"], prob=SOMETIMES, std=NOISE),
        ]
    )
