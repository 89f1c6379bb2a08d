"""Pixelwise: a downstream model, name `pixelwise`; it tells classes apart by the colour of each pixel alone."""

import numpy as np
from torch import nn

from neeco.studies.downstream.model import TorchModel


class Pixelwise(TorchModel):
    model = "pixelwise"
    predicts = "masks"
    image_size = 64
    multiple = 1
    steps = 200
    batch = 4
    learning_rate = 0.05

    @classmethod
    def missing_requirement(cls):
        return None

    def build(self, classes):
        return nn.Sequential(nn.Conv2d(3, 8, 1), nn.ReLU(), nn.Conv2d(8, classes + 1, 1))

    def loss(self, module, batch):
        logits = module(batch.images)
        return (nn.functional.cross_entropy(logits, batch.shares, reduction="none") * batch.valid).mean()

    def predictions(self, module, images, sizes):
        shares = [
            nn.functional.interpolate(logits[None], size)[0] for logits, size in zip(module(images), sizes, strict=True)
        ]
        return [share.argmax(0).cpu().numpy().astype(np.uint8) for share in shares]
